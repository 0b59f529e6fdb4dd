"""Goal sets.

Wherever an argument or setting names goals, it takes one of these forms:

=================  =======================================================================================
``"paper"``        the paper's 20 in the paper's scenes (``manifests/paper.yaml``); five in any other scene,
                   the bundled rooms among them, chosen by :func:`spread_goals`
``"all"``          every state that some other state can reach
``"random:5"``     that many such states of each scene, drawn once and for all; "random:5:1" is another draw
``"my.yaml"``      a manifest: the names of scenes, each with a list of state ids within the scene
``[3, 180]``       global state ids, as a list or a tensor
``{"hall": [3]}``  the names of scenes, each with a list of state ids within the scene
=================  =======================================================================================
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import GoalError
from vusfa.limits import TABLE_STATES, brief, listing
from vusfa.reading import read_yaml
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.graph import shortest_path_distances, strong_components

__all__ = ["PAPER_MANIFEST", "GoalSpec", "read_manifest", "resolve_goals", "spread_goals"]

GoalSpec = str | PathLike[str] | Sequence[int] | Tensor | Mapping[str, Sequence[int]]

PAPER_MANIFEST = Path(__file__).parent / "manifests" / "paper.yaml"


def resolve_goals(scenes: SceneSet, goals: GoalSpec) -> Tensor:
    """Global state ids of goals, (G,) int64 on the CPU, scene by scene; ids stay in their order.

    Args:
        scenes: the world.
        goals: one of the forms in the table above.

    Raises:
        GoalError: an unknown form, scene or state, or no goal. Whether goals can be reached is not checked.

    >>> rooms = SceneSet.bundled(["bathroom", "kitchen"])
    >>> resolve_goals(rooms, "all").shape, resolve_goals(rooms, "random:3").shape
    (torch.Size([856]), torch.Size([6]))
    >>> resolve_goals(rooms, {"kitchen": [0, 5]}).tolist()
    [176, 181]
    >>> resolve_goals(rooms, {"attic": [0]})
    Traceback (most recent call last):
    ...
    vusfa.errors.GoalError: goals name the scene 'attic'; this set has bathroom, kitchen
    """
    if isinstance(goals, Tensor) or (isinstance(goals, Sequence) and not isinstance(goals, str)):
        return _checked_ids(scenes, goals)
    if isinstance(goals, Mapping):
        return _by_scene(scenes, goals, "goals")
    if not isinstance(goals, str | PathLike):
        raise GoalError(
            f"goals are {brief(goals)}; give a name, a file, state ids, or a dict of scene names to state ids"
        )
    text = fspath(goals)
    if text == "paper":
        return _paper(scenes)
    if text == "all":
        return torch.cat([_reachable(scene) + first for scene, first in _scenes_and_offsets(scenes)])
    if text.startswith("random:"):
        return _random(scenes, text)
    if Path(text).suffix in (".yaml", ".yml"):
        return _by_scene(scenes, read_manifest(text), text)
    raise GoalError(
        f"goals are {brief(text)}; give 'paper', 'all', 'random:5' (five per scene), a manifest (.yaml) or"
        f" state ids"
    )


def read_manifest(path: str | PathLike[str]) -> dict[str, list[int]]:
    """Read a YAML manifest: scene names, each with a list of state ids within the scene.

    Raises:
        GoalError: the file is missing, is not YAML, or holds anything else.

    >>> read_manifest(PAPER_MANIFEST)["bathroom_02"]
    [26, 37, 43, 53, 69]
    """
    content = read_yaml(path, GoalError, "write lines like 'bathroom: [26, 37]'")
    if not isinstance(content, dict) or not content:
        raise GoalError(f"{path}: holds no scenes; write lines like 'bathroom: [26, 37]'")
    for name, ids in content.items():
        if not isinstance(ids, list) or not all(type(i) is int for i in ids):
            raise GoalError(
                f"{path}: scene {brief(name)} has {brief(ids)}; give a list of state ids, like [26, 37]"
            )
    return {str(name): ids for name, ids in content.items()}


def spread_goals(scene: Scene, count: int) -> list[int]:
    """Goals spread over a scene: deterministic farthest-point selection on shortest paths.

    The first is the farthest from all others on average (of more than 4096 states, the farthest from the
    first state); each further one has the farthest nearest chosen goal. A distance is the mean of there and
    back, in actions; ties go to the lowest id. Goals are of the largest strongly connected part of the scene,
    so that each can be reached from every other.

    Args:
        scene: the scene.
        count: number of goals, at least 1.

    Returns:
        state ids within the scene, ascending.

    Raises:
        GoalError: the scene's largest part has fewer states.

    >>> corridor = torch.tensor([[1, -1], [2, 0], [3, 1], [4, 2], [-1, 3]])
    >>> spread_goals(Scene("corridor", corridor, torch.rand(5, 1, 2)), 3)
    [0, 2, 4]
    """
    part = torch.tensor(strong_components(scene.graph)[0])
    if not 1 <= count <= len(part):
        raise GoalError(
            f"scene {scene.name!r}: {count} goals asked for; its largest part has {len(part)} states"
        )

    def there_and_back(one: int) -> Tensor:
        there, state = scene.distances_to(part[one])[0], part[one : one + 1]
        return (there + shortest_path_distances(scene.graph, state)[0].to(torch.int64))[part]

    if len(part) <= TABLE_STATES:
        there = scene.distance[part][:, part].to(torch.int64)
        chosen = [int((there + there.T).sum(1).argmax())]
    else:
        chosen = [int(there_and_back(0).argmax())]
    nearest = there_and_back(chosen[0])
    while len(chosen) < count:
        nearest[chosen] = -1
        chosen.append(int((nearest == nearest.max()).nonzero()[0]))
        nearest = torch.minimum(nearest, there_and_back(chosen[-1]))
    return sorted(part[chosen].tolist())


def _scenes_and_offsets(scenes: SceneSet) -> list[tuple[Scene, int]]:
    return list(zip(scenes.scenes, scenes.offsets[:-1].tolist(), strict=True))


def _checked_ids(scenes: SceneSet, goals: Any) -> Tensor:
    ids = _as_tensor(goals, "goals")
    if ids.ndim != 1 or not len(ids):
        raise GoalError(
            f"goals have the shape {tuple(ids.shape)}; give at least one global state id, as a flat list"
        )
    if ids.is_floating_point() or ids.is_complex() or ids.dtype == torch.bool:
        raise GoalError(f"goals are of type {ids.dtype}; give integers, global state ids")
    wrong = ids[(ids < 0) | (ids >= scenes.num_states)]
    if len(wrong):
        raise GoalError(
            f"goal {int(wrong[0])} is out of range; {scenes} has the global ids 0..{scenes.num_states - 1}"
        )
    return ids.to(torch.int64)


def _as_tensor(goals: Any, source: str) -> Tensor:
    """Numbers as a tensor on the CPU; neither words nor truth values."""
    mixed = isinstance(goals, Sequence) and any(isinstance(goal, bool) for goal in goals)
    try:
        if mixed:
            raise TypeError("a truth value")
        return torch.as_tensor(goals).cpu()
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise GoalError(f"{source}: {brief(goals)} are no state ids; give integers, like [26, 37]") from error


def _by_scene(scenes: SceneSet, goals: Mapping[str, Any], source: str) -> Tensor:
    unknown = [name for name in goals if name not in scenes.names]
    if unknown:
        raise GoalError(f"{source} name the scene {unknown[0]!r}; this set has {listing(scenes.names)}")
    found = []
    for scene, first in _scenes_and_offsets(scenes):
        entry = goals.get(scene.name, [])
        ids = _as_tensor(entry, f"{source}: scene {scene.name!r}")
        if ids.ndim == 1 and not len(ids):
            continue
        if ids.ndim != 1 or ids.is_floating_point() or ids.is_complex() or ids.dtype == torch.bool:
            raise GoalError(
                f"{source}: scene {scene.name!r} has {brief(entry)}; give a list of state ids, like [26, 37]"
            )
        wrong = ids[(ids < 0) | (ids >= scene.num_states)]
        if len(wrong):
            raise GoalError(
                f"{source}: scene {scene.name!r} has no state {int(wrong[0])};"
                f" its states are 0..{scene.num_states - 1}"
            )
        found.append(ids.to(torch.int64) + first)
    if not found:
        raise GoalError(f"{source}: no goal is given; give at least one state id")
    return torch.cat(found)


def _paper(scenes: SceneSet) -> Tensor:
    manifest = read_manifest(PAPER_MANIFEST)
    goals = {}
    for scene in scenes.scenes:
        largest = len(strong_components(scene.graph)[0])
        goals[scene.name] = manifest.get(scene.name) or spread_goals(scene, min(5, largest))
    return _by_scene(scenes, goals, "goals 'paper'")


def _reachable(scene: Scene) -> Tensor:
    """States of a scene that another state leads to."""
    source = torch.arange(scene.num_states).unsqueeze(1).expand_as(scene.graph)
    entered = scene.graph[(scene.graph >= 0) & (scene.graph != source)]
    return entered.unique()


def _random(scenes: SceneSet, text: str) -> Tensor:
    numbers = text.split(":")[1:]
    if not all(number.isdecimal() for number in numbers) or len(numbers) > 2 or int(numbers[0]) < 1:
        raise GoalError(
            f"goals are {brief(text)}; write 'random:5' for five per scene, or 'random:5:1' for another draw"
        )
    count, draw = int(numbers[0]), int(numbers[1]) if len(numbers) == 2 else 0
    found = []
    for scene, first in _scenes_and_offsets(scenes):
        candidates = _reachable(scene)
        if len(candidates) < count:
            raise GoalError(
                f"goals are {brief(text)}, but only {len(candidates)} states of {scene.name!r} can be reached"
            )
        # Seeded by the scene's name: neither the order of the scenes nor the environment's seed changes the
        # goals, so that training, evaluation and every worker mean the same ones.
        generator = np.random.default_rng([draw, zlib.crc32(scene.name.encode())])
        chosen = generator.choice(len(candidates), count, replace=False)
        found.append(candidates[np.sort(chosen)] + first)
    return torch.cat(found)


def as_ids(name: str, value: Any, shape: Sequence[int], device: torch.device | None = None) -> Tensor:
    """Global ids as given to an environment, (*B,) int64: one for all rows, or one per row.

    Raises:
        GoalError: no whole numbers, or of another shape.

    >>> as_ids("goal", 3, [2])
    tensor([3, 3])
    """
    try:
        ids = torch.as_tensor(value, device=device)
        if not ids.is_floating_point() and ids.dtype != torch.bool:
            return ids.to(torch.int64).expand(torch.Size(shape))
    except (RuntimeError, TypeError, ValueError):
        pass
    raise GoalError(
        f"{name} is {brief(value)}; give whole numbers, one for all rows or of shape {list(shape)}"
    )


def check_ids(name: str, ids: Tensor, shape: Sequence[int], num_states: int) -> None:
    """Check ids of states that a tensordict holds.

    Raises:
        GoalError: another type or shape, or out of range.

    >>> check_ids("goal", torch.tensor([3, 9]), [2], num_states=9)
    Traceback (most recent call last):
    ...
    vusfa.errors.GoalError: goal 9 is out of range; the ids are 0..8
    """
    if ids.dtype != torch.int64 or tuple(ids.shape) != tuple(shape):
        raise GoalError(f"{name}_id is {ids.dtype} {list(ids.shape)}; give int64 {list(shape)}")
    wrong = ids[(ids < 0) | (ids >= num_states)]
    if wrong.numel():
        raise GoalError(f"{name} {int(wrong[0])} is out of range; the ids are 0..{num_states - 1}")
