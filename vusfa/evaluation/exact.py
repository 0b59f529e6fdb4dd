"""Exact metrics of policies of one frame, computed instead of sampled.

The actions of such a policy depend on the state and the goal alone, so its episodes towards a goal are a
Markov chain on the scene's graph (:mod:`vusfa.scenes.markov`). With h_k(s) the probability of reaching the
goal within k actions from s, h_k - h_{k-1} is that of an episode of k actions, and the expectation of a
metric follows from the joint distribution of an episode's length and its shortest path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.evaluation.episodes import Episodes
from vusfa.evaluation.metrics import METRICS, metrics_within
from vusfa.scenes import SceneSet, check_home
from vusfa.scenes.markov import arrival_by_step, goals_at_once

__all__ = [
    "ExactGoals",
    "ExpectedWalks",
    "exact_goals",
    "expected_walks",
    "join_walks",
    "sampled_walks",
    "uniform_probabilities",
    "walks_within",
]

#: From ids of states, goals and scenes, (R,) each, to the probabilities (R, A) of the actions.
Probabilities = Callable[[Tensor, Tensor, Tensor], Tensor]
#: Of goals of one scene: its index, columns (6, G) of :class:`ExpectedWalks`, and (2, N) the sums of
#: ``from_start`` over them, and their number.
WalksWithin = tuple[int, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class ExactGoals:
    """One row per goal, expectations over all starts that it can be reached from.

    Args:
        scene: (G,) int64, index of the scene.
        goal: (G,) int64, state id within its scene.
        metrics: by name, (G,) float64 each: ``success_500``, ``success_100``, ``spl``.
    """

    scene: Tensor
    goal: Tensor
    metrics: Mapping[str, Tensor]

    def __post_init__(self) -> None:
        columns = {"scene": self.scene, "goal": self.goal, **self.metrics}
        shapes = {name: tuple(column.shape) for name, column in columns.items()}
        if len(set(shapes.values())) != 1 or self.scene.ndim != 1:
            raise ValueError(f"the columns of a table of goals must all be (G,); they are {shapes}")


def uniform_probabilities(num_actions: int) -> Probabilities:
    """The random walk's :data:`Probabilities`."""
    return lambda state, goal, scene: torch.full((len(state), num_actions), 1 / num_actions)


class ExpectedWalks(NamedTuple):
    """Expectations over episodes of at most K actions, per goal, over all starts that can reach it.

    Each is (G,) float64 but for the last; NaN for a goal without a start.

    Attributes:
        length: actions; a failure counts as K.
        success: probability of success.
        arrived_length: actions of successful episodes, 0 for a failure.
        arrived_shortest: shortest paths of successful episodes, 0 for a failure.
        shortest: shortest paths.
        spl: success weighted by path length.
        from_start: (S,) float64, success from each state of all scenes, mean over the goals that it can
            reach; NaN where there is none.
    """

    length: Tensor
    success: Tensor
    arrived_length: Tensor
    arrived_shortest: Tensor
    shortest: Tensor
    spl: Tensor
    from_start: Tensor

    def length_ratio_of(self, goals: Tensor) -> float:
        """Length of successful episodes over their shortest paths: a ratio of means over some of the goals.

        Args:
            goals: (G,) bool.
        """
        arrived = (column[goals].nansum() for column in (self.arrived_length, self.arrived_shortest))
        return torch.div(*arrived).item()

    @property
    def length_ratio(self) -> float:
        """The same over all goals."""
        return self.length_ratio_of(torch.ones_like(self.success, dtype=torch.bool))


@torch.no_grad()
def expected_walks(
    probabilities: Probabilities | None, scenes: SceneSet, goals: Tensor, max_steps: int = MAX_STEPS
) -> ExpectedWalks:
    r"""Expected length, success and SPL of episodes, with T the actions until the goal and K ``max_steps``:
    E[min(T, K)], P(T <= K), E[T; T <= K].

    Args:
        probabilities: of actions; None for a random walk.
        scenes: the world.
        goals: (G,) global ids, scene by scene.
        max_steps: K.

    >>> walks = expected_walks(None, SceneSet.bundled(["bathroom"]), torch.tensor([3, 90]))
    >>> 500 > walks.length.mean().item() > 10 * walks.shortest.mean().item() > 10
    True
    >>> walks.spl.mean().item() < walks.success.mean().item() < walks.from_start.max().item() < 1
    True
    """
    probabilities = probabilities or uniform_probabilities(scenes.num_actions)
    scene_of = scenes.scene_id.to(goals.device)[goals]
    parts = [goals[scene_of == index] for index in scene_of.unique().tolist()]
    return join_walks([walks_within(probabilities, scenes, part, max_steps) for part in parts], scenes)


@torch.no_grad()
def walks_within(
    probabilities: Probabilities, scenes: SceneSet, goals: Tensor, max_steps: int = MAX_STEPS
) -> WalksWithin:
    """:func:`expected_walks` to goals (G,), one or more, of one scene, as :func:`join_walks` takes them.

    >>> rooms, goals = SceneSet.bundled(["bathroom"]), torch.tensor([3, 90])
    >>> parts = [walks_within(uniform_probabilities(4), rooms, part) for part in goals.split(1)]
    >>> torch.equal(join_walks(parts, rooms).spl, expected_walks(None, rooms, goals).spl)
    True
    """
    index = int(scenes.scene_id[goals[0]])
    scene, here, parts = scenes.scenes[index], goals - int(scenes.offsets[index]), []
    sums = torch.zeros(2, scene.num_states, dtype=torch.float64)
    for block, chance, shortest, arrival in _distributions(probabilities, scenes, index, here, max_steps):
        steps = torch.arange(chance.shape[1], dtype=torch.float64)[:, None]
        ways = torch.arange(chance.shape[2], dtype=torch.float64)
        success = chance.sum((1, 2))
        arrived = (chance * steps).sum((1, 2))
        length = arrived + max_steps * (1 - success)
        spl = (chance * (ways / torch.maximum(steps, ways).clamp(min=1))).sum((1, 2))
        parts.append(torch.stack([length, success, arrived, (chance * ways).sum((1, 2)), shortest, spl]))
        starts = scene.distances_to(block) > 0
        sums += torch.stack([(arrival * starts).sum(0), starts.sum(0)])
    return index, torch.cat(parts, 1), sums


def join_walks(parts: Sequence[WalksWithin], scenes: SceneSet) -> ExpectedWalks:
    """The walks to the goals of all parts, one after the other."""
    summed = torch.zeros(2, scenes.num_states, dtype=torch.float64)
    for index, _, sums in parts:
        summed[:, int(scenes.offsets[index]) : int(scenes.offsets[index + 1])] += sums
    return ExpectedWalks._make([*torch.cat([columns for _, columns, _ in parts], 1), summed[0] / summed[1]])


def sampled_walks(episodes: Episodes, scenes: SceneSet, goals: Tensor) -> ExpectedWalks:
    """Means over episodes in place of the expectations of :func:`expected_walks`, for agents of several
    frames.

    Args:
        episodes: of :func:`~vusfa.evaluation.evaluate`.
        scenes: the world.
        goals: (G,) global ids.

    >>> from vusfa.evaluation import evaluate
    >>> from vusfa.modules import make_agent
    >>> rooms, goals = SceneSet.bundled(["bathroom"]), torch.tensor([3, 90])
    >>> actor = make_agent("gvf", scenes=rooms, hidden_size=8).get_policy_operator()
    >>> walks = sampled_walks(evaluate(actor, rooms, goals, max_steps=9), rooms, goals)
    >>> bool((walks.spl <= walks.success).all()), walks.from_start.shape
    (True, torch.Size([176]))
    """
    offsets = scenes.offsets.cpu()[episodes.scene]
    number = torch.full((scenes.num_states,), -1)
    number[goals.cpu()] = torch.arange(len(goals))

    def mean(values: Tensor, rows: Tensor, size: int) -> Tensor:
        sums = torch.zeros(2, size, dtype=torch.float64)
        sums.index_add_(1, rows, torch.stack([values.double(), torch.ones_like(values).double()]))
        return sums[0] / sums[1]

    success, length, shortest = episodes.success, episodes.length, episodes.shortest
    parts = METRICS["spl"].parts(episodes)
    assert parts is not None, "SPL is defined for all episodes"
    columns = (length, success, success * length, success * shortest, shortest, parts[0])
    goal = number[episodes.goal + offsets]
    means = [mean(column, goal, len(goals)) for column in columns]
    from_start = mean(success, episodes.start + offsets, scenes.num_states)
    return ExpectedWalks._make([*means, from_start])


@torch.no_grad()
def exact_goals(
    probabilities: Probabilities,
    scenes: SceneSet,
    *,
    within: Sequence[int] = (500, 100),
    max_steps: int = MAX_STEPS,
    at_once: int | None = None,
) -> ExactGoals:
    """Every state of every scene as a goal, from every start that it can be reached from.

    Args:
        probabilities: of actions; those of an agent of one frame are its
            :meth:`TabularPolicy.probabilities`.
        scenes: the world.
        within: numbers of actions to give the success within.
        max_steps: actions allowed in a walk.
        at_once: goals that are computed together; what suits the processor when not given.

    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> exact_goals(uniform_probabilities(4), rooms).metrics["success_500"].shape
    torch.Size([176])
    """
    metrics = [metric for metric in metrics_within(within, max_steps) if metric.exact]
    rows = []
    for index, scene in enumerate(scenes.scenes):
        longest = scene.longest_path
        weights = _outcomes(longest, max_steps)
        scores = torch.stack([_score(metric.parts(weights)) for metric in metrics])
        scores = scores.view(len(metrics), max_steps + 1, longest + 1)
        every = torch.arange(scene.num_states)
        for goals, chance, shortest, _ in _distributions(
            probabilities, scenes, index, every, max_steps, at_once
        ):
            values = torch.einsum("gkd,mkd->mg", chance, scores)
            kept = ~shortest.isnan()
            rows.append([column[kept] for column in (torch.full_like(goals, index), goals, *values)])
    scene_id, goal, *columns = (torch.cat(column) for column in zip(*rows, strict=True))
    return ExactGoals(scene_id, goal, {m.name: column for m, column in zip(metrics, columns, strict=True)})


def _score(parts: tuple[Tensor, Tensor] | None) -> Tensor:
    assert parts is not None, "an exact metric reads success, length and shortest alone"
    return parts[0].to(torch.float64).nan_to_num()  # 0 / 0 where an episode begins at its goal: there is none


def _outcomes(longest: int, max_steps: int) -> Episodes:
    """A successful episode of each length 0 to ``max_steps`` and each shortest path 0 to ``longest``."""
    length = torch.arange(max_steps + 1).repeat_interleave(longest + 1)
    shortest = torch.arange(longest + 1).repeat(max_steps + 1)
    none, yes = torch.zeros_like(length), torch.ones_like(length, dtype=torch.bool)
    return Episodes(none, none, none, yes, length, shortest, none, ~yes, ("",), max_steps)


def _distributions(
    probabilities: Probabilities,
    scenes: SceneSet,
    index: int,
    goals: Tensor,
    max_steps: int,
    at_once: int | None = None,
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Of a scene's goals, in blocks: ids (g,); the probability (g, K + 1, D) that an episode arrives with its
    k-th action and its shortest path has d; the mean shortest path (g,), NaN for a goal that no start
    reaches; the probability (g, N) of arriving within K actions from each state."""
    check_home(getattr(probabilities, "__self__", None), scenes)  # of a TabularPolicy's method
    scene, first = scenes.scenes[index], int(scenes.offsets[index])
    size, longest = scene.num_states, scene.longest_path
    for block in goals.split(at_once or goals_at_once(size)) if len(goals) else ():
        count = len(block)
        state = torch.arange(size).repeat(count) + first
        goal = block.repeat_interleave(size) + first
        acts = probabilities(state, goal, torch.full_like(state, index)).view(count, size, -1)
        shortest = scene.distances_to(block).to(torch.int64)
        starts = shortest > 0
        # Starts of one goal that are equally far are summed: one sparse product per action.
        bins = torch.arange(count)[:, None] * (longest + 1) + shortest.clamp(min=0)
        place = starts.flatten().nonzero().squeeze(1)
        entries = np.ones(len(place)), (bins.flatten()[place].numpy(), place.numpy())
        binned = sparse.csr_matrix(entries, shape=(count * (longest + 1), count * size))
        chance = torch.zeros(count, max_steps + 1, longest + 1, dtype=torch.float64)
        walks = islice(arrival_by_step(scene.graph, acts, block), max_steps + 1)
        for k, (before, now) in enumerate(pairwise(walks), 1):
            chance[:, k] = torch.from_numpy(binned @ (now - before).flatten().numpy()).view(count, -1)
        number = starts.sum(1)
        mean = (shortest * starts).sum(1) / number.double()
        yield block, chance / number[:, None, None], mean, now
