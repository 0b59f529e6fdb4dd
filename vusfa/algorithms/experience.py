"""The transitions that an agent has made, as a graph, and shortest paths in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from vusfa.errors import ConfigError
from vusfa.scenes.paths import ShortestPaths

__all__ = ["ExperienceGraph", "merge_graphs", "passing_weights"]

#: Seen states of a scene up to which labels are looked up in a table of all its shortest paths.
TABULATED = 256


def passing_weights(distance: Tensor) -> Tensor:
    r"""Weight of each state, so that states are drawn as walks to the goal from uniform starts pass them.

    A walk from distance D passes one state at each distance d from D to 1; which of the n_d states at d is
    taken to be uniform:

    .. math::
        w(s) = \frac{1}{n_d} \sum_{D \ge d} \frac{n_D}{D}, \qquad d = d(s)

    The few states near a goal are on every walk's path: uniform draws of states hardly ever show them.

    Args:
        distance: (N,) int64, of every state, 1 or more.

    Returns:
        (N,) float32, not normalized.

    >>> passing_weights(torch.tensor([1, 2, 2]))  # 1 / 1 + 2 / 2 at distance 1; 2 / 2, shared by two, at 2
    tensor([2.0000, 0.5000, 0.5000])
    """
    number = distance.bincount().float()
    walks = number / torch.arange(len(number)).clamp(min=1)
    return (walks.flip(0).cumsum(0).flip(0) / number)[distance]


class ExperienceGraph:
    """Which state followed each state and action that an agent has tried, and which scene each state is in.

    Transitions are taken to be deterministic: of two outcomes of one action the later one counts. What the
    agent has not tried is not in the graph. Nothing is read of the scenes themselves.

    Args:
        num_states, num_actions: of the world; ids are below them.

    >>> graph = ExperienceGraph(num_states=4, num_actions=2)
    >>> tried = {"state_id": torch.tensor([[0], [1], [0]]), "scene_id": torch.zeros(3, dtype=torch.int64),
    ...          "action": torch.tensor([0, 0, 1]), "next": {"state_id": torch.tensor([[1], [3], [0]])}}
    >>> graph.extend(TensorDict(tried, [3]))
    >>> graph.successor.tolist(), graph.num_transitions
    ([[1, 0], [3, -1], [-1, -1], [-1, -1]], 3)
    >>> graph.steps_to(torch.tensor([3]))  # state 2 was never seen, and nothing leads from 3 to itself
    (tensor([0, 1, 3]), tensor([[2, 1, 0]]))
    """

    def __init__(self, num_states: int, num_actions: int) -> None:
        self.successor = torch.full((num_states, num_actions), -1)
        self.scene_of = torch.full((num_states,), -1)
        self._scenes: dict[int, tuple[Tensor, Tensor, ShortestPaths]] = {}
        self._goals = torch.empty(0, dtype=torch.int64)

    @property
    def num_transitions(self) -> int:
        """Pairs of state and action that have been tried."""
        return int((self.successor >= 0).sum())

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collector's batch of any shape: ``state_id``, ``action``, ``scene_id``, and the next
        ``state_id``."""
        state = batch.get("state_id")[..., -1].cpu()
        following = batch.get(("next", "state_id"))[..., -1].cpu()
        action, scene = batch.get("action").cpu(), batch.get("scene_id").cpu()
        new = self.successor[state, action] != following
        if not new.any():
            return
        self.successor[state[new], action[new]] = following[new]
        self.scene_of[state[new]] = scene[new]
        self.scene_of[following[new]] = scene[new]
        for number in scene[new].unique().tolist():
            self._scenes.pop(number, None)
        self._find_goals()

    def _find_goals(self) -> None:
        """States that a transition from another state leads to."""
        state, action = (self.successor >= 0).nonzero(as_tuple=True)
        following = self.successor[state, action]
        self._goals = following[following != state].unique()

    def steps_to(self, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Number of steps of the shortest known path from every seen state of a scene.

        Args:
            goals: (G,) int64, seen states of one scene.

        Returns:
            the scene's seen states, (N,) int64, and the steps to each goal, (G, N) int64; -1 where no known
            path leads.

        Raises:
            ValueError: a goal that was not seen, or goals of several scenes.
        """
        scene = self.scene_of[goals].unique()
        if len(scene) != 1 or int(scene) < 0:
            raise ValueError(f"goals {goals[:5].tolist()} are not seen states of one scene")
        states, _, paths = self._scene(int(scene))
        return states, paths.to_goals(torch.searchsorted(states, goals)).long()

    def _scene(self, scene: int) -> tuple[Tensor, Tensor, ShortestPaths]:
        """A scene's seen states (N,), the places of their successors among these (N, A), -1 where unknown,
        and the shortest paths of this graph."""
        if scene not in self._scenes:
            states = (self.scene_of == scene).nonzero().squeeze(-1)
            following = self.successor[states]
            place = torch.where(following < 0, -1, torch.searchsorted(states, following))
            self._scenes[scene] = states, place, ShortestPaths(place.numpy())
        return self._scenes[scene]

    def sample(self, num_goals: int, batch_size: int, path_share: float = 0.5) -> TensorDict:
        """Pairs of a state and a goal, and the first steps of all shortest known paths between them.

        Args:
            num_goals: goals drawn from all that the agent has arrived at.
            batch_size: pairs; rounded down to as many of each goal.
            path_share: share of the states that are drawn by :func:`passing_weights`, the others uniformly.

        Returns:
            ``state_id`` (n, 1), ``goal_id``, ``scene_id``, ``steps_to_goal`` (n,) int64, 1 or more, and
            ``best_action`` (n, A) bool; sorted by scene and goal.

        Raises:
            ValueError: no transition is known that leads to another state.
        """
        if not len(self._goals):
            raise ValueError("no transition is known; extend() first")
        goals = self._goals[torch.randint(len(self._goals), (num_goals,))].sort().values
        goals = goals[self.scene_of[goals].argsort(stable=True)]
        parts = []
        for scene in self.scene_of[goals].unique().tolist():
            chosen = goals[self.scene_of[goals] == scene]
            states, steps = self.steps_to(chosen)
            _, place, _ = self._scene(scene)
            for goal, distance in zip(chosen, steps, strict=True):
                drawn = _draw(distance, batch_size // num_goals, path_share)
                ahead = torch.where(place[drawn] < 0, -1, distance[place[drawn]])  # -1: no known path
                ahead = torch.where(ahead < 0, len(states), ahead)
                parts.append(
                    {
                        "state_id": states[drawn].unsqueeze(-1),
                        "goal_id": goal.expand(len(drawn)),
                        "scene_id": torch.full((len(drawn),), scene),
                        "steps_to_goal": distance[drawn],
                        "best_action": ahead == ahead.amin(-1, keepdim=True),
                    }
                )
        columns = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        return TensorDict(columns, [len(columns["goal_id"])])

    def label(self, state: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        r"""Shortest known paths of given pairs.

        Args:
            state, goal: (\*B,) int64.

        Returns:
            their length, (\*B,) int64, 0 where none is known or the state is the goal; and the first steps of
            all of them, (\*B, A) bool.
        """
        rows, ends = state.reshape(-1).cpu(), goal.reshape(-1).cpu()
        steps = torch.zeros_like(rows)
        best = torch.zeros(len(rows), self.successor.shape[1], dtype=torch.bool)
        scene = torch.where(self.scene_of[rows] == self.scene_of[ends], self.scene_of[ends], -1)
        for number in scene[scene >= 0].unique().tolist():
            row = (scene == number).nonzero().squeeze(-1)
            states, place, paths = self._scene(number)
            if len(states) <= TABULATED:
                _ = paths.table  # in which between() looks paths up from now on
            here, there = (torch.searchsorted(states, ids[row]) for ids in (rows, ends))
            steps[row] = length = paths.between(here, there).clamp(min=0)
            following = place[here]
            ahead = paths.between(following.clamp(min=0).flatten(), there.repeat_interleave(best.shape[1]))
            ahead = ahead.view_as(following)
            known = (following >= 0) & (ahead >= 0)
            best[row] = known & (ahead == length.unsqueeze(-1) - 1)
        return steps.view(state.shape), best.view(*state.shape, -1)

    def state_dict(self) -> dict[str, Any]:
        """Transitions and scenes of states."""
        return {"successor": self.successor, "scene_of": self.scene_of}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ConfigError: it is of a world with another number of states or actions.
            ValueError: it is not what :meth:`state_dict` gave.
        """
        successor, scene_of = state["successor"], state["scene_of"]
        if successor.shape != self.successor.shape or scene_of.shape != self.scene_of.shape:
            raise ConfigError(
                f"transitions of {tuple(successor.shape)} states and actions do not fit"
                f" {tuple(self.successor.shape)}"
            )
        if bool(((successor < -1) | (successor >= len(successor))).any()):
            raise ValueError(f"transitions to states that are not among {len(successor)}")
        known, action = (successor >= 0).nonzero(as_tuple=True)
        if bool((scene_of[known] < 0).any() or (scene_of[known] != scene_of[successor[known, action]]).any()):
            raise ValueError("transitions between states of different or unknown scenes")
        self.successor, self.scene_of = successor.clone(), scene_of.clone()
        self._scenes.clear()
        self._find_goals()


def merge_graphs(states: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The ``state_dict`` of a graph with the transitions of all of them."""
    return {name: torch.stack([state[name] for state in states]).amax(0) for name in states[0]}


def _draw(distance: Tensor, number: int, path_share: float) -> Tensor:
    """Draw places of states (number,), sorted, from those with a distance of 1 or more."""
    reached = (distance > 0).nonzero().squeeze(-1)
    on_path = round(number * path_share)
    weighted = passing_weights(distance[reached]).multinomial(max(on_path, 1), replacement=True)[:on_path]
    uniform = torch.randint(len(reached), (number - on_path,))
    return reached[torch.cat([weighted, uniform])].sort().values
