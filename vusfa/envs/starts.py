"""Distribution of start states: uniform over the states that can reach the goal in more than 0 steps.

The goals of one strongly connected component share one list of starts, so memory grows with the number of
states, not with its square. A start is an index into the list that skips the goal itself. Random integers go
in, states come out; integers from 0..2**62-1 modulo a count below 2**24 are uniform to within 1e-11.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from vusfa.errors import GoalError
from vusfa.scenes import SceneSet
from vusfa.scenes.graph import steps_to_goals, strong_components

__all__ = [
    "DRAW_LIMIT",
    "GoalTable",
    "StartCache",
    "StartTable",
    "draw_goals",
    "draw_starts",
    "path_table",
    "paths_from",
    "start_table",
]

DRAW_LIMIT = 2**62
#: Shortest paths that are looked up in one table; of more, each is asked of the scenes when it is wanted.
MAX_PATHS = 1 << 28


class GoalTable(NamedTuple):
    """Facts about goals, one entry per goal (G,), or per row (*B,) after :meth:`take`; int64.

    Attributes:
        goal: global state id.
        scene: index of its scene.
        first: where the list of its starts begins in :attr:`StartTable.members`.
        starts: number of states an episode can begin at.
        rank: the goal's own position in its list, to be skipped.
        origin: the actions from state s to the goal stand at ``s + origin`` of the goals' flat table of
            shortest paths (:func:`path_table`).
    """

    goal: Tensor
    scene: Tensor
    first: Tensor
    starts: Tensor
    rank: Tensor
    origin: Tensor

    def take(self, slot: Tensor) -> GoalTable:
        """The entries of some goals, by their position in the table."""
        return GoalTable(*(column[slot] for column in self))


class StartTable(NamedTuple):
    """Tables of a sampler of episodes.

    Attributes:
        goals: the goals, in the order given.
        members: (M,) int64, global ids, for each distinct set of starts one sorted list.
        order: (G,) int64, positions of the goals, scene by scene.
        scene_first, scene_goals: (K,) int64, for the K scenes that have goals: where its goals begin in
            ``order``, and how many they are.
    """

    goals: GoalTable
    members: Tensor
    order: Tensor
    scene_first: Tensor
    scene_goals: Tensor


class StartCache(dict[int, tuple[Tensor, dict[int, Tensor]]]):
    """Of scenes, by their index: the component of each state (N,), and of each component that has a goal the
    states that reach it."""


def start_table(
    graphs: Sequence[Tensor],
    offsets: Tensor,
    goals: Tensor,
    names: Sequence[str],
    known: StartCache | None = None,
) -> StartTable:
    """Find the starts of every goal.

    Args:
        graphs: for each scene (N, A) integers, -1 = blocked.
        offsets: (n_scenes + 1,) int64, the global id of each scene's first state.
        goals: (G,) int64 global ids, G at least 1; repeats are allowed.
        names: of the scenes, for the message.
        known: what was found before about the same graphs; added to.

    Raises:
        GoalError: no other state can reach a goal.

    >>> corridor = torch.tensor([[1, -1], [2, 0], [-1, 1]])  # right, left
    >>> table = start_table([corridor], torch.tensor([0, 3]), torch.tensor([1]), ["corridor"])
    >>> draw_starts(table.members, table.goals.take(torch.tensor([0, 0])), torch.tensor([10, 11])).tolist()
    [0, 2]
    """
    scene = torch.bucketize(goals, offsets, right=True) - 1
    first, starts, rank = (torch.zeros_like(goals) for _ in range(3))
    lists: list[Tensor] = []
    length, known = 0, StartCache() if known is None else known
    for index in scene.unique().tolist():
        of_scene = (scene == index).nonzero()[:, 0]
        offset = int(offsets[index])
        local = goals[of_scene] - offset
        if index not in known:
            known[index] = _component_of_state(graphs[index]), {}
        component, reached_by = known[index]
        for label in component[local].unique().tolist():
            slot = of_scene[component[local] == label]
            target = goals[slot] - offset
            if label not in reached_by:
                to_goal = steps_to_goals(graphs[index], int(target[0]))[0]
                reached_by[label] = (to_goal >= 0).nonzero()[:, 0]
            reaching = reached_by[label]
            if len(reaching) == 1:
                raise GoalError(
                    f"scene {names[index]!r}: no other state can reach goal {int(target[0])}"
                    f" (global id {int(goals[slot[0]])}); choose another goal, or look at the scene's islands"
                )
            first[slot] = length
            starts[slot] = len(reaching) - 1
            rank[slot] = torch.searchsorted(reaching, target)
            lists.append(reaching + offset)
            length += len(reaching)
    order = torch.argsort(scene, stable=True)
    size = offsets.diff()[scene]
    _, scene_goals = scene.unique(return_counts=True)
    return StartTable(
        goals=GoalTable(goals, scene, first, starts, rank, size.cumsum(0) - size - offsets[scene]),
        members=torch.cat(lists),
        order=order,
        scene_first=scene_goals.cumsum(0) - scene_goals,
        scene_goals=scene_goals,
    )


def _component_of_state(graph: Tensor) -> Tensor:
    """Strongly connected component of each state, (N,)."""
    label = torch.empty(len(graph), dtype=torch.int64)
    for index, states in enumerate(strong_components(graph)):
        label[torch.tensor(states)] = index
    return label


def draw_starts(members: Tensor, goals: GoalTable, draw: Tensor) -> Tensor:
    """Starts (*B,), global ids, of random integers.

    Args:
        members: (M,), of the :class:`StartTable`.
        goals: the goal of each row, columns (*B,).
        draw: (*B,) int64, uniform over 0..DRAW_LIMIT-1.
    """
    index = draw % goals.starts
    index = index + (index >= goals.rank)
    return members[goals.first + index]


def path_table(scenes: SceneSet, goals: GoalTable) -> Tensor | None:
    """Shortest paths to the goals (G,), from every state of each goal's scene, flat, goal after goal; None
    where they are more than :data:`MAX_PATHS`."""
    if int(scenes.offsets.diff()[goals.scene].sum()) > MAX_PATHS:
        return None
    parts: dict[int, Tensor] = {}
    for index in goals.scene.unique().tolist():
        slot = (goals.scene == index).nonzero()[:, 0]
        columns = scenes.scenes[index].distances_to(goals.goal[slot] - scenes.offsets[index])
        parts |= dict(zip(slot.tolist(), columns, strict=True))
    return torch.cat([parts[slot] for slot in range(len(goals.goal))])


def paths_from(distance: Tensor, goals: GoalTable, state: Tensor) -> Tensor:
    """Shortest paths (*B,) int64 from states to goals of the same scene in actions; -1: there is none.

    Args:
        distance: the goals' flat table, of :func:`path_table`.
        goals: the goal of each row, columns (*B,).
        state: (*B,) int64 global ids.
    """
    return distance[goals.origin + state].to(torch.int64)


def draw_goals(table: StartTable, scene_draw: Tensor, goal_draw: Tensor) -> GoalTable:
    """Goals, columns (*B,): uniform over the scenes that have any, then over the scene's goals.

    Args:
        table: the sampler's table.
        scene_draw, goal_draw: (*B,) int64, uniform over 0..DRAW_LIMIT-1, independent.
    """
    scene = scene_draw % len(table.scene_goals)
    position = table.scene_first[scene] + goal_draw % table.scene_goals[scene]
    return table.goals.take(table.order[position])
