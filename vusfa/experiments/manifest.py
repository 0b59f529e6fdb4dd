"""Manifests: the episodes of an evaluation, with the start and goal of each and the seed of the actions.

``manifests/bundled.npz`` belongs to the bundled rooms: every state of every room is a goal, with ten starts.
Five unseen goals per room are held out to choose checkpoints (``validation``); no table counts them.
:func:`make_manifest` makes manifests of other rooms, and made this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vusfa.envs.goals import resolve_goals
from vusfa.errors import ResultError
from vusfa.evaluation.starts import episode_starts
from vusfa.files import write_npz
from vusfa.reading import read_npz
from vusfa.scenes import SceneSet

__all__ = [
    "BUNDLED_MANIFEST",
    "Manifest",
    "draw_goals",
    "make_manifest",
    "read_manifest",
    "write_manifest",
]

BUNDLED_MANIFEST = Path(__file__).parent / "manifests" / "bundled.npz"

#: The columns of a manifest: kinds of dtype, and dimensions.
_COLUMNS = {
    "start": ("iu", 1),
    "goal": ("iu", 1),
    "validation": ("b", 1),
    "seed": ("iu", 0),
    "fingerprint": ("U", 0),
}


@dataclass(frozen=True, eq=False)
class Manifest:
    """Episodes; columns (n,) on the CPU.

    Attributes:
        start, goal: int64, global state ids in the manifest's scenes.
        validation: bool, an episode for the choice of checkpoints.
        seed: of the actions.
        fingerprint: of the scenes.
    """

    start: Tensor
    goal: Tensor
    validation: Tensor
    seed: int
    fingerprint: str

    def episodes(self, scenes: SceneSet, validation: bool = False) -> tuple[Tensor, Tensor]:
        """Starts and goals (m,): those to report, or those for the choice of checkpoints.

        Raises:
            ResultError: other scenes than the manifest's.
        """
        if scenes.fingerprint != self.fingerprint:
            raise ResultError(
                f"the manifest of episodes is of other scenes (fingerprint {self.fingerprint[:12]}, and these"
                f" have {scenes.fingerprint[:12]}); make one for these with make_manifest"
            )
        rows = self.validation == validation
        return self.start[rows], self.goal[rows]


def make_manifest(
    scenes: SceneSet,
    trained: Tensor,
    *,
    episodes_per_goal: int = 10,
    validation_goals: int = 5,
    seed: int = 0,
) -> Manifest:
    """Draw the episodes of a set of scenes.

    Args:
        scenes: the world.
        trained: (G,) global ids of the trained goals, which are no validation goals.
        episodes_per_goal: starts per goal, drawn uniformly among those that can reach it.
        validation_goals: per scene, drawn from its other reachable states.
        seed: of these draws, and of the actions.

    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> manifest = make_manifest(rooms, torch.tensor([3]))
    >>> len(manifest.goal), int(manifest.validation.sum()), 3 in manifest.goal[manifest.validation]
    (1760, 50, False)
    """
    generator = torch.Generator().manual_seed(seed)
    every = resolve_goals(scenes, "all")
    held_out = draw_goals(scenes, every[~torch.isin(every, trained.cpu())], validation_goals, generator)
    start, goal = episode_starts(scenes, every, episodes_per_goal, generator=generator)
    return Manifest(start, goal, torch.isin(goal, held_out), seed, scenes.fingerprint)


def draw_goals(scenes: SceneSet, goals: Tensor, per_scene: int, generator: torch.Generator) -> Tensor:
    """At most so many of the goals (G,), global ids, per scene; scene by scene.

    >>> rooms, generator = SceneSet.bundled(["bathroom", "kitchen"]), torch.Generator().manual_seed(0)
    >>> draw_goals(rooms, torch.tensor([3, 5, 7, 300]), 2, generator).shape
    torch.Size([3])
    """
    chosen, scene = [], scenes.scene_id.cpu()[goals]
    for index in range(scenes.num_scenes):
        here = goals[scene == index]
        chosen.append(here[torch.randperm(len(here), generator=generator)[:per_scene]])
    return torch.cat(chosen)


def write_manifest(path: str | Path, manifest: Manifest) -> Path:
    """Write a manifest (.npz), atomically; ids as 32-bit integers."""
    columns = {name: getattr(manifest, name).numpy().astype(np.int32) for name in ("start", "goal")}
    others = {"seed": np.asarray(np.int64(manifest.seed)), "fingerprint": np.array(manifest.fingerprint)}
    return write_npz(path, {**columns, "validation": manifest.validation.numpy(), **others})


def read_manifest(path: str | Path = BUNDLED_MANIFEST) -> Manifest:
    """Read a manifest; the bundled rooms' when none is named.

    Raises:
        ResultError: the file is missing or damaged.

    >>> manifest = read_manifest()
    >>> start, goal = manifest.episodes(SceneSet.bundled())
    >>> len(goal), len(manifest.episodes(SceneSet.bundled(), validation=True)[0])
    (16920, 200)
    """
    content = read_npz(path)
    for name, (kinds, dims) in _COLUMNS.items():
        column = content.get(name)
        if column is None or column.dtype.kind not in kinds or column.ndim != dims:
            held = "missing" if column is None else f"{column.dtype} of shape {column.shape}"
            raise ResultError(f"{path}: {name!r} is {held}; it is no manifest of episodes")
    start, goal, validation = (torch.from_numpy(content[name]) for name in ("start", "goal", "validation"))
    if not len(start) == len(goal) == len(validation):
        raise ResultError(
            f"{path}: 'start', 'goal' and 'validation' have {len(start)}, {len(goal)} and {len(validation)}"
            f" entries; it is no manifest of episodes"
        )
    start, goal = start.to(torch.int64), goal.to(torch.int64)
    return Manifest(start, goal, validation, int(content["seed"]), str(content["fingerprint"]))
