"""What a policy of one frame is worth, without drawing an episode.

Where an agent sees one frame and no more, its actions depend on the state and the goal alone: to each goal
its walk is a Markov chain on the scene's graph. With p(a | s, g) its probabilities and s.a where a leads,

    h_0(s) = 1 if s = g else 0,    h_k(s) = sum_a p(a | s, g) h_{k-1}(s.a),    h_k(g) = 1

is the chance of having met g within k actions from s. SPL is the sum over k of (h_k - h_{k-1}) d / max(d, k)
with d the shortest path (Anderson et al. 2018, eq. 1, in expectation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from vusfa.modules import Agent, action_logits, frozen
from vusfa.scenes import SceneSet

__all__ = [
    "ExactGoals",
    "ExpectedWalks",
    "agent_probabilities",
    "exact_goals",
    "expected_walks",
    "reach_step",
]

Probabilities = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class ExactGoals:
    """One row a goal, means over all starts that it can be reached from; every column a tensor (G,).

    Args:
        scene: int64, index of the scene.
        goal: int64, state id within its scene.
        success_100, success_500: float64, chance of meeting it within so many actions.
        spl: float64, of walks of at most 500 actions.
    """

    scene: Tensor
    goal: Tensor
    success_100: Tensor
    success_500: Tensor
    spl: Tensor

    def __post_init__(self) -> None:
        shapes = {field.name: tuple(getattr(self, field.name).shape) for field in fields(self)}
        if len(set(shapes.values())) != 1 or self.scene.ndim != 1:
            raise ValueError(f"the columns of a table of goals must all be (G,); they are {shapes}")


def reach_step(probability: Tensor, successor: Tensor, goal: Tensor, chance: Tensor) -> Tensor:
    """h_k of h_{k-1}: chances (G, N) of having met each goal within one action more.

    Args:
        probability: (G, N, A), of actions on the way to each goal.
        successor: (N, A) int64, where actions lead; a blocked one, to the state itself.
        goal: (G,) int64.
        chance: (G, N), before.

    >>> corridor, fair = torch.tensor([[0, 1], [0, 2], [1, 2]]), torch.full((1, 3, 2), 0.5)
    >>> goal, chance = torch.tensor([2]), torch.tensor([[0.0, 0.0, 1.0]])
    >>> for _ in range(3):
    ...     chance = reach_step(fair, corridor, goal, chance)
    >>> chance
    tensor([[0.3750, 0.6250, 1.0000]])
    """
    chance = (probability * chance[:, successor]).sum(-1)
    chance[torch.arange(len(goal), device=goal.device), goal] = 1
    return chance


def agent_probabilities(agent: Agent, greedy: bool = False) -> Probabilities:
    """The probabilities (R, A) of an agent's actions for ids of states, goals and scenes, (R,) each.

    Args:
        agent: one that sees one frame, by its id, and has no memory.
        greedy: all on the likeliest action.

    Raises:
        ValueError: another agent, whose walk is no Markov chain on the graph.
    """
    config = agent.config
    if config["history"] != 1 or config["observation"] != "index" or config["memory"] is not None:
        raise ValueError(
            "an exact evaluation needs an agent of one frame, without a memory, that reads ids; this one has"
            f" history={config['history']}, observation={config['observation']}, memory={config['memory']}"
        )

    def probabilities(state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        logits = action_logits(agent, state.unsqueeze(-1), goal, scene)
        if greedy:
            return torch.nn.functional.one_hot(logits.argmax(-1), logits.shape[-1]).to(logits.dtype)
        return logits.softmax(-1)

    return probabilities


class ExpectedWalks(NamedTuple):
    """Walks of at most K actions to goals: means over all starts that a goal can be reached from, (G,)
    float64 each.

    Attributes:
        length: actions; a walk that does not arrive counts with all K.
        success: chance of arriving.
        arrived_length: actions of walks that arrive, the others counting 0.
        arrived_shortest: actions of the shortest path from where walks that arrive began, the others 0.
        shortest: actions of the shortest path.
    """

    length: Tensor
    success: Tensor
    arrived_length: Tensor
    arrived_shortest: Tensor
    shortest: Tensor

    @property
    def length_ratio(self) -> float:
        """Actions of arriving walks over those of their shortest paths: a ratio of means over goals."""
        return (self.arrived_length.sum() / self.arrived_shortest.sum()).item()


@torch.no_grad()
def expected_walks(
    probabilities: Probabilities | None, scenes: SceneSet, goals: Tensor, max_steps: int = 500
) -> ExpectedWalks:
    r"""What walks to some goals come to in expectation; computed, not sampled. With T the actions until
    arrival, K ``max_steps`` and h_k the chance of having arrived within k,

    .. math:: E[\min(T, K)] = \sum_{k=0}^{K-1} (1 - h_k), \quad
              E[T; T \le K] = \sum_{k=1}^{K} k (h_k - h_{k-1})

    Args:
        probabilities: of actions, see :func:`agent_probabilities`; None for a random walk.
        scenes: the world.
        goals: (G,) global ids, scene by scene.
        max_steps: K.

    >>> walks = expected_walks(None, SceneSet.bundled(["bathroom"]), torch.tensor([3, 90]))
    >>> 500 > walks.length.mean().item() > 10 * walks.shortest.mean().item() > 10
    True
    """
    parts = []
    for index in range(len(scenes.scenes)):
        here = goals[scenes.scene_id[goals] == index] - int(scenes.offsets[index])
        chain = _chain(probabilities, scenes, index, here)
        chance, shortest = chain.arrived, chain.shortest
        length, arrived = torch.zeros_like(chance), torch.zeros_like(chance)
        for k in range(1, max_steps + 1):
            length += 1 - chance
            before, chance = chance, reach_step(chain.acts, chain.successor, here, chance)
            arrived += k * (chance - before)
        columns = (length, chance, arrived, chance * shortest, shortest.double())
        parts.append([chain.mean(column) for column in columns])
    return ExpectedWalks(*(torch.cat(column) for column in zip(*parts, strict=True)))


@torch.no_grad()
def exact_goals(
    probabilities: Probabilities, scenes: SceneSet, agent: Agent | None = None, *, at_once: int = 64
) -> ExactGoals:
    """Every state of every scene as a goal, from every start that it can be reached from.

    Args:
        probabilities: of actions, see :func:`agent_probabilities`.
        scenes: the world.
        agent: what ``probabilities`` come from: then it encodes the world once.
        at_once: goals that are computed together.

    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> exact_goals(lambda state, goal, scene: torch.full((len(state), 4), 0.25), rooms).success_500.shape
    torch.Size([176])
    """
    rows = []
    with frozen(agent if agent is not None else torch.nn.Module()):
        for index, scene in enumerate(scenes.scenes):
            for goals in torch.arange(scene.num_states).split(at_once):
                rows.append(_some_goals(probabilities, scenes, index, goals))
    return ExactGoals(*(torch.cat(column) for column in zip(*rows, strict=True)))


def _some_goals(
    probabilities: Probabilities, scenes: SceneSet, index: int, goals: Tensor
) -> tuple[Tensor, ...]:
    chain = _chain(probabilities, scenes, index, goals)
    before, shortest = chain.arrived, chain.shortest
    reached, spl = {}, torch.zeros_like(before)
    for k in range(1, 501):
        now = reach_step(chain.acts, chain.successor, goals, before)
        spl += (now - before) * shortest / shortest.clamp(min=k)
        before = now
        if k in (100, 500):
            reached[k] = now
    kept = (shortest > 0).any(1)
    means = [chain.mean(values) for values in (reached[100], reached[500], spl)]
    columns = torch.full_like(goals, index), goals, *means
    return tuple(column[kept] for column in columns)


class _Chain(NamedTuple):
    """Walks in one scene to G of its goals.

    Attributes:
        acts: (G, n, A) float64, chances of the actions.
        successor: (n, A), where they lead.
        arrived: (G, n) float64, chance of having arrived before the first of them.
        shortest: (G, n), actions of the shortest walk; -1 where there is none.
    """

    acts: Tensor
    successor: Tensor
    arrived: Tensor
    shortest: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """(G, n) to (G,): over the starts that can reach the goal in more than 0 actions."""
        counted = self.shortest > 0
        return (values * counted).sum(1) / counted.sum(1)


def _chain(probabilities: Probabilities | None, scenes: SceneSet, index: int, goals: Tensor) -> _Chain:
    scene, first = scenes.scenes[index], int(scenes.offsets[index])
    size = scene.num_states
    successor = scenes.successor[first : first + size] - first
    if probabilities is None:
        acts = torch.full((len(goals), *successor.shape), 1 / successor.shape[1], dtype=torch.float64)
    else:
        state = torch.arange(size).repeat(len(goals)) + first
        goal = goals.repeat_interleave(size) + first
        told = probabilities(state, goal, torch.full_like(state, index))
        acts = told.view(len(goals), *successor.shape).double()
    arrived = torch.zeros(len(goals), size, dtype=torch.float64)
    arrived[torch.arange(len(goals)), goals] = 1
    return _Chain(acts, successor, arrived, scene.distance[:, goals].T)
