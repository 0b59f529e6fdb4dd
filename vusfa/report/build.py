"""Write a report: the page and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vusfa.errors import ConfigError
from vusfa.report.content import Options, Row, add_pictures, gather
from vusfa.report.page import page_weight, write_page, write_tables
from vusfa.report.run_scenes import open_scenes
from vusfa.report.runs import LoggedRun

__all__ = ["write_report"]


def write_report(
    runs: Sequence[LoggedRun], out: str | Path, options: Options | None = None
) -> tuple[list[Path], dict[str, list[Row]]]:
    """Write the page, and its tables as CSV to a folder beside it, ``PAGE_tables``.

    Args:
        runs: what to report.
        out: the page; its folder is created if necessary.
        options: see :class:`~vusfa.report.content.Options`.

    Returns:
        the paths, the page first, and the tables.

    Raises:
        ConfigError: no runs, runs that do not belong together, or a page over its size limit.
        VusfaError: a scene or a checkpoint cannot be read.
    """
    options, out = options or Options(), Path(out)
    scenes = open_scenes(runs, options.scenes)
    content, tables = gather(runs, options, scenes)
    weight, most = page_weight(content), options.megabytes * 1e6
    if weight > most:
        raise ConfigError(
            f"the page has {weight / 1e6:.1f} MB without pictures, more than megabytes="
            f"{options.megabytes:g}; give fewer goals_per_scene, seeds or walks, or more megabytes"
        )
    options.tell("pictures")
    # the id of a state and the end of its picture take up to 16 bytes
    states = sum(scene["states"] for scene in content["scenes"].values())
    room = max(0, int(most - weight) - 16 * states - 1000)
    shown = content["agents"] or content["maps"]  # nothing else shows pictures
    add_pictures(content, scenes, room if shown else 0)
    page = write_page(out, content)
    return [page, *write_tables(out.with_name(f"{out.stem}_tables"), tables)], tables
