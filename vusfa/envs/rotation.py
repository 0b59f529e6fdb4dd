"""Rotation of scenes: episodes begin in a few active scenes, which change while a training goes on.

Habitat's episode iterator groups episodes by scene for the same reason: a scene costs when it is entered, and
nothing while it is left alone. S slots hold one scene each and take turns: after ``stay / S`` frames the next
slot gets the next scene of a shuffled list. An episode that has begun is finished where it is.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.scenes import SceneSet

__all__ = ["Rotation", "SceneRotation"]


@dataclass(frozen=True)
class SceneRotation:
    """Settings of a rotation.

    Args:
        active: S, scenes in which episodes begin at a time.
        stay: frames of all environments together for which a scene is active.
        seed: of the order of the scenes.
        weights: how often scenes are active in relation to each other, by their names; 1 for those that are
            not named. A scene of weight 2 has twice as many stays, one of 0 has none.

    Raises:
        ConfigError: a number out of its range.
    """

    active: int
    stay: int = 100_000
    seed: int = 0
    weights: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.active < 1 or self.stay < self.active:
            raise ConfigError(
                f"env.active_scenes is {self.active} and env.scene_stay {self.stay}; give 1 or more, and at"
                " least as many frames as scenes"
            )
        for name, weight in self.weights.items():
            if not 0 <= weight < 1000:
                raise ConfigError(
                    f"env.scene_weights: {brief(name)} has {weight}; give 0 or more, below 1000"
                )


class Rotation:
    """The rotation of the scenes that have goals: a function of the number of frames, with no state.

    Args:
        settings: see :class:`SceneRotation`.
        scenes: the world.
        goals: (G,) global ids.

    Raises:
        ConfigError: more active scenes than there are; weights of unknown scenes, or that leave no scene.

    >>> rooms = SceneSet.bundled()
    >>> rotation = Rotation(SceneRotation(active=2, stay=1000), rooms, torch.tensor([0, 176, 580, 1260]))
    >>> [rotation.scenes_at(rotation.turn(frames)) for frames in (0, 499, 500, 1000)]
    [[3, 0], [3, 0], [2, 0], [2, 1]]
    """

    def __init__(self, settings: SceneRotation, scenes: SceneSet, goals: Tensor) -> None:
        if not isinstance(settings, SceneRotation):
            raise ConfigError(f"rotation is {brief(settings)}; give a SceneRotation")
        unknown = sorted(settings.weights.keys() - set(scenes.names))
        if unknown:
            raise ConfigError(f"env.scene_weights: there is no scene {brief(unknown[0])}; name the set's own")
        if settings.active > scenes.num_scenes:
            raise ConfigError(
                f"env.active_scenes is {settings.active} of {scenes.num_scenes} scenes; give fewer, or null"
                " for all of them"
            )
        self.settings = settings
        goals = goals.cpu()
        scene = scenes.scene_id.cpu()[goals]
        self._goals = goals[scene.argsort(stable=True)]
        names, counts = scene.unique(return_counts=True)
        ends = counts.cumsum(0).tolist()
        self._range = dict(zip(names.tolist(), itertools.pairwise([0, *ends]), strict=True))
        weight = np.array([settings.weights.get(scenes.names[index], 1.0) for index in self._range])
        if not weight.any():
            raise ConfigError("env.scene_weights leaves no scene; give one of them more than 0")
        self._known = np.array(list(self._range))[weight > 0]
        self._weight = weight[weight > 0] / weight[weight > 0].mean()
        self.active = min(settings.active, len(self._known))
        self._order: list[int] = self._known.tolist() if self.active == len(self._known) else []
        self._epochs = 0

    @property
    def rotates(self) -> bool:
        """Whether some scene that has goals is not active all the time."""
        return len(self._range) > self.active

    @property
    def rows_needed(self) -> int:
        """Environments with which every goal has one, where each keeps its goal."""
        return self.active * max(end - first for first, end in self._range.values())

    def turn(self, frames: int) -> int:
        """How many scenes have been replaced after so many frames."""
        return 0 if self.active == len(self._known) else frames * self.active // self.settings.stay

    def scenes_at(self, turn: int) -> list[int]:
        """The active scenes, slot by slot."""
        size = self.active
        last = [slot + size * ((turn + size - 1 - slot) // size) for slot in range(size)]
        while len(self._order) <= max(last):
            self._shuffle()
        return [self._order[place] for place in last]

    def goals_at(self, turn: int) -> tuple[Tensor, Tensor]:
        """The active goals, slot by slot, and how many each slot has (S,)."""
        ranges = [self._range[scene] for scene in self.scenes_at(turn)]
        counts = torch.tensor([end - first for first, end in ranges])
        return torch.cat([self._goals[first:end] for first, end in ranges]), counts

    def rows_at(self, turn: int, rows: Tensor) -> Tensor:
        """Places (*B,) among :meth:`goals_at` of the goals that rows keep, from their numbers (*B,): row i is
        of slot i modulo S, and the rows of a slot take its goals in turn."""
        _, counts = self.goals_at(turn)
        slot = rows % self.active
        return (counts.cumsum(0) - counts)[slot] + rows // self.active % counts[slot]

    def goals_between(self, frames: int, later: int) -> Tensor:
        """All goals that are active at some time between two numbers of frames, ascending."""
        turns = range(self.turn(frames), self.turn(later) + 1)
        return torch.cat([self.goals_at(turn)[0] for turn in turns]).unique()

    def _shuffle(self) -> None:
        """Append a round of all scenes. A fractional weight gives a scene one stay more in some rounds."""
        offset = np.random.default_rng(self.settings.seed).random(len(self._known))
        before, after = (np.floor(n * self._weight + offset) for n in (self._epochs, self._epochs + 1))
        stays = np.repeat(self._known, (after - before).astype(int))
        self._epochs += 1
        self._order += np.random.default_rng([self.settings.seed, self._epochs]).permutation(stays).tolist()
