"""The scenes of a report's runs, opened once and checked against the trainings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import torch

from vusfa.errors import ConfigError, SceneError
from vusfa.evaluation import Episodes
from vusfa.limits import listing
from vusfa.report.runs import LoggedRun
from vusfa.scenes import Scene, SceneSet
from vusfa.training.checkpoint import check_scenes, load_checkpoint

__all__ = ["open_scenes"]


def open_scenes(runs: Sequence[LoggedRun], given: SceneSet | None = None) -> dict[str, Scene]:
    """The scenes of all runs by name, checked against their trainings.

    Args:
        runs: of the report.
        given: the runs' scenes; opened from their checkpoints and settings by default.

    Raises:
        ConfigError: two runs have different scenes of one name, or a run has episodes of another scene.
        CheckpointError: a scene differs from that of the training.
        SceneError: a scene cannot be found.
    """
    found: dict[str, tuple[Scene, LoggedRun]] = {}
    opened = lru_cache(SceneSet.open)
    for run in runs:
        world = _world(run, given, opened)
        for scene in world.scenes if world else ():
            known, first = found.setdefault(scene.name, (scene, run))
            if known is not scene and not _equal(known, scene):
                raise ConfigError(
                    f"{first.folder} and {run.folder} have different scenes called {scene.name!r};"
                    " report them apart, or rename one (attribute 'scene')"
                )
        _check_episodes(run, world)
    return {name: scene for name, (scene, _) in found.items()}


def _world(
    run: LoggedRun, given: SceneSet | None, opened: Callable[[tuple[str, ...]], SceneSet]
) -> SceneSet | None:
    saved: dict[str, Any] = {"sources": run.scenes, "fingerprint": run.fingerprint}
    if run.checkpoint is not None and run.checkpoint.suffix != ".safetensors":
        saved = load_checkpoint(run.checkpoint)["scenes"]
    if given is not None:
        every = given.names if run.episodes is None else run.episodes.scene_names
        names = saved.get("names", every)
        missing = [name for name in names if name not in given.names]
        if missing:
            raise ConfigError(f"scenes: {run.folder} is of {missing[0]!r}, which is not among them; add it")
        world = SceneSet([given.scenes[given.scene_index(name)] for name in names])
    elif saved["sources"]:
        try:
            world = opened(tuple(saved["sources"]))
        except SceneError as error:
            mend = f"if the scenes of {run.folder} have moved, put them beside it or give them as scenes"
            raise SceneError(f"{error}; {mend}") from error
    else:
        return None
    if saved["fingerprint"]:
        check_scenes(run.folder, {"names": list(world.names), **saved}, world)
    return world


def _walked_in(part: Episodes, scene: Scene) -> bool:
    ids = torch.stack([part.start, part.goal])
    if int(ids.min()) < 0 or int(ids.max()) >= scene.num_states:
        return False
    return bool((scene.path_lengths(part.start, part.goal) == part.shortest).all())


def _equal(one: Scene, other: Scene) -> bool:
    return torch.equal(one.graph, other.graph) and torch.equal(one.features, other.features)


def _check_episodes(run: LoggedRun, world: SceneSet | None) -> None:
    """Refuse episodes of other scenes than the run's, found by their shortest paths."""
    if run.episodes is None or world is None:
        return
    for index, name in enumerate(run.episodes.scene_names):
        part = run.episodes.select(run.episodes.scene == index)
        scene = world.scenes[world.names.index(name)] if name in world.names else None
        if scene is None or not _walked_in(part, scene):
            raise ConfigError(
                f"{run.folder}: its episodes in {name!r} are of another scene than the run's"
                f" ({listing(world.names)}); evaluate the run again with vusfa evaluate"
            )
