"""``vusfa scenes render-rooms``: many rooms, or many renderings of some, into a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from vusfa.cli.render import Samples, Scalar, Threads, Width, find_plan, with_camera
from vusfa.cli.sources import Network, Weights
from vusfa.errors import ConfigError, VusfaError
from vusfa.limits import brief

if TYPE_CHECKING:
    from vusfa.experiments.room_split import RoomSplit
    from vusfa.sources.backbones import Backbone
    from vusfa.sources.render import Rendered
    from vusfa.sources.render.plan import Plan
    from vusfa.sources.render.variation import Variation

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("render-rooms")(render_rooms)


class _Job(NamedTuple):
    """A file to make."""

    target: Path
    draw: Callable[[], Plan]
    variation: Variation


def seed_numbers(words: list[str]) -> list[int]:
    """Seeds of words such as "7" and "1-60".

    Raises:
        ConfigError: a word is neither.

    >>> seed_numbers(["7", "1-3"])
    [7, 1, 2, 3]
    """
    numbers: list[int] = []
    for word in words:
        first, dash, last = word.partition("-")
        ends = [first, last] if dash else [first, first]
        if not all(end.isascii() and end.isdigit() and len(end) < 10 for end in ends):
            raise ConfigError(f"seeds: {word!r} is neither a number nor a range; write 7 or 1-60")
        low, high = map(int, ends)
        if not low <= high < low + 100_000:
            raise ConfigError(f"seeds: {word!r} must go upward, over at most 100,000 seeds")
        numbers += range(low, high + 1)
    return numbers


def _given(plan: Plan) -> Plan:
    return plan


def _drawn(kind: str, seed: int, cells: int | None) -> Callable[[], Plan]:
    """What draws a room; an unknown kind is an error now, before any work."""
    from vusfa.sources.render.kinds import programme
    from vusfa.sources.render.layout import layout

    programme(kind)
    return partial(layout, kind, seed, cells)


def _jobs_of(split: RoomSplit, folder: Path, kinds: list[str], seeds: list[int] | None) -> Iterator[_Job]:
    """Rooms of a split; of these kinds and seeds alone where some are given."""
    from vusfa.sources.render.variation import PLAIN

    for part in split.parts:
        for kind, seed, cells in split.rooms(part):
            if (not kinds or kind in kinds) and (seeds is None or seed in seeds):
                yield _Job(folder / f"{kind}-{seed}.h5", _drawn(kind, seed, cells), PLAIN)


def _jobs(
    folder: Path, plans: list[Path], kinds: list[str], seeds: list[int], cells: int | None, vary: list[str]
) -> Iterator[_Job]:
    from vusfa.sources.render.variation import PLAIN, load_variation

    for what, paths in (("plans", plans), ("changes", [Path(name) for name in vary])):
        if len({path.stem for path in paths}) < len(paths):
            raise ConfigError(f"two {what} have one name among {brief([str(path) for path in paths])}")
    changes = {Path(name).stem: load_variation(name) for name in vary} or {"": PLAIN}
    drawn: dict[str, Callable[[], Plan]] = {}
    for path in plans:
        drawn[path.stem] = partial(_given, find_plan(path))
    for seed in seeds:  # a stopped run has rooms of all kinds
        for kind in kinds:
            drawn[f"{kind}-{seed}"] = _drawn(kind, seed, cells)
    for name, draw in drawn.items():
        for change, variation in changes.items():
            yield _Job(folder / change / f"{name}.h5", draw, variation)


def _render(
    job: _Job,
    *,
    backbone: Callable[[], Backbone],
    width: int | None,
    samples: int | None,
    scalar: bool,
    threads: int | None,
    pictures: bool = True,
) -> Rendered:
    from vusfa.sources.compact import compact
    from vusfa.sources.render.backend import Backend
    from vusfa.sources.render.room import render_room

    job.target.parent.mkdir(parents=True, exist_ok=True)
    raw = job.target.with_name(f".{job.target.name}.raw.h5")
    rendered = render_room(
        with_camera(job.draw(), width, samples),
        raw,
        backbone=backbone(),
        backend=Backend("scalar_rgb") if scalar else None,
        threads=threads,
        variation=job.variation,
    )
    compact(raw, job.target, pictures)
    raw.unlink()
    return replace(rendered, path=job.target)


def render_rooms(
    folder: Annotated[
        Path, typer.Argument(help="Folder to fill; files that exist are kept.", show_default=False)
    ],
    plan: Annotated[
        list[Path] | None, typer.Option(help="Plans: YAML files, or names of bundled rooms.")
    ] = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(help="Kinds to draw rooms of: bathroom, bedroom, kitchen, living_room, hall."),
    ] = None,
    seeds: Annotated[
        list[str] | None, typer.Option(help="Random seeds for each kind: 1-60, or [1,2,7].")
    ] = None,
    cells: Annotated[
        int | None, typer.Option(help="Number of free places of drawn rooms; by default the kind's own.")
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Changes of the pictures, as for `vusfa scenes render`; each gets a folder."),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            help="A split into rooms to train in and to test in: unseen (docs/generalise.md), or a YAML file."
            " It says cells, width and samples; kind and seeds choose among its rooms. Pictures are not kept."
        ),
    ] = None,
    width: Width = None,
    samples: Samples = None,
    backbone: Network = "efficientnet-lite0",
    weights: Weights = None,
    scalar: Scalar = False,
    threads: Threads = None,
    launcher: Annotated[
        str,
        typer.Option(help="What renders: serial (one room after the other), local, slurm or ray."),
    ] = "serial",
    launcher_options: Annotated[
        list[str] | None, typer.Option(help="Options of the launcher: [address=HOST:6379,num_cpus=2].")
    ] = None,
) -> None:
    """Render many rooms into a folder, as small files (see `vusfa scenes compact`).

    Files are FOLDER/KIND-SEED.h5 and FOLDER/PLAN.h5, with --vary FOLDER/CHANGE/KIND-SEED.h5. If stopped, it
    resumes when the same command is given again; a room that cannot be rendered is reported at the end.

    Examples:

        vusfa scenes render-rooms rooms/small kind=[bathroom,hall] seeds=1-60 cells=20

        vusfa scenes render-rooms robust plan=[bathroom,kitchen] vary=[dimmer,camera,all]

        vusfa scenes render-rooms rooms/unseen split=unseen

        vusfa scenes render-rooms rooms/unseen split=unseen seeds=53-60
    """
    from vusfa.cli.progress import progress
    from vusfa.files import check_folder

    how: dict[str, Any] = {"width": width, "samples": samples, "scalar": scalar, "threads": threads}
    network_of: dict[str, Any] = {"name": backbone, "weights": weights}
    if split is not None:
        from vusfa.experiments.room_split import read_split
        from vusfa.scenes.feature_grid import parse_grid

        if plan or vary or not cells is width is samples is None:
            raise ConfigError("split says cells, width and samples; leave these, plan and vary out")
        rooms = read_split(split)
        jobs = list(_jobs_of(rooms, folder, kind or [], seed_numbers(seeds) if seeds else None))
        if not jobs:
            raise ConfigError(
                f"{split}: has no room of kind {brief(kind)} and seeds {brief(seeds)}; see its parts"
            )
        how |= {"width": rooms.width, "samples": rooms.samples, "pictures": False}
        network_of |= {"layer": rooms.layer, "grid": rooms.grid and parse_grid(rooms.grid)}
        check_folder(folder.absolute(), "the folder of the rooms")
        rooms.write(folder)
    elif bool(plan) == bool(kind):
        raise ConfigError("say what to render: plan=[FILE,...], or kind=[KIND,...] with seeds=1-60, or split")
    else:
        if plan and (seeds or cells is not None):
            raise ConfigError("seeds and cells belong to kind; a plan has both")
        numbers = seed_numbers(seeds or ["1"])
        jobs = list(_jobs(folder, plan or [], kind or [], numbers, cells, vary or []))
    waiting = [job for job in jobs if not job.target.exists()]
    if len(waiting) < len(jobs):
        typer.echo(f"{len(jobs) - len(waiting)} of {len(jobs)} files are there already", err=True)
    if not waiting:
        return
    from vusfa.cluster.cells import Cell, run_cells
    from vusfa.sources.backbones import load_backbone

    check_folder(folder.absolute(), "the folder of the rooms")
    if launcher != "serial" or launcher_options:
        work = partial(_render, backbone=partial(load_backbone, **network_of), **how)
        made = [Cell(job.target, partial(work, job)) for job in waiting]
        return run_cells(made, launcher, launcher_options or [])
    network = load_backbone(**network_of)
    failed: list[str] = []
    with progress("rendering", len(waiting), "rooms") as advance:
        for job in waiting:
            try:
                typer.echo(str(_render(job, backbone=lambda: network, **how)))
            except VusfaError as error:
                failed.append(f"{job.target}: {error}")
                typer.echo(f"error: {failed[-1]}", err=True)
            advance()
    if failed:
        raise ConfigError(
            f"{len(failed)} of {len(waiting)} rooms could not be rendered:\n  " + "\n  ".join(failed)
        )
