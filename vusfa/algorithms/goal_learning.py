"""The base of algorithms that learn a critic of all seen goals, and the policy from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from vusfa.algorithms.base import Algorithm, AlgorithmSettings, check_replay
from vusfa.algorithms.registry import ALGORITHMS
from vusfa.algorithms.replay import HindsightReplay, RankedReplay
from vusfa.errors import CheckpointError, ConfigError
from vusfa.modules import Agent
from vusfa.objectives.scores import ScoreLoss
from vusfa.scenes import SceneSet

__all__ = ["GoalLearning", "GoalLearningSettings", "SceneSample", "Scores", "scores_of", "slow_copy"]

#: Frames of walking before the first step, at most, where settings give none.
MAX_START = 100_000
# arguments of HindsightReplay and of ScoreLoss among the settings
_OF_REPLAY = ("capacity", "batch_size", "horizon", "own_future", "discount")
_OF_SCORES = ("critic_coeff", "objective_coeff", "temperature")


@dataclass
class GoalLearningSettings(AlgorithmSettings):
    """Numbers of the algorithms that learn a critic of all goals.

    Attributes:
        updates: optimizer steps per batch of the collector.
        batch_size: transitions in each of these steps.
        capacity: frames kept.
        horizon: the farthest goal that a transition is given from its own episode, in steps.
        discount: gamma of the critic; goals of the own episode are drawn with weight gamma^steps.
        own_future: share of the goals that are from the own episode; the others are any seen states.
        learning_starts: frames of walking before the first step, with a policy that learns to be uniform;
            None: 40 % of ``total_frames``, at most 100,000.
        hidden_size, embedding_size: of the critic's networks, and of what they write.
        policy_pairs: pairs of a state and a goal per step from which the policy learns.
        temperature: of the softmax of scores that the policy learns, in the units of the critic.
        critic_coeff, objective_coeff: of :class:`~vusfa.objectives.ScoreLoss`, for the agent's own value and
            policy.
    """

    updates: int = 10
    batch_size: int = 8192
    capacity: int = 1_000_000
    horizon: int = 60
    discount: float = 0.9
    own_future: float = 1.0
    learning_starts: int | None = None
    hidden_size: int = 512
    embedding_size: int = 128
    policy_pairs: int = 4096
    temperature: float = 0.1
    critic_coeff: float = 0.01
    objective_coeff: float = 1.0


#: Scores (n, A), constants, of states (n,) and goals (n,), by their places among a scene's seen states.
Scores = Callable[[Tensor, Tensor], Tensor]


class SceneSample(NamedTuple):
    """The transitions of a sample that are in one scene; states and goals are places among its seen states.

    Attributes:
        scene: its index.
        states: (S,) ids of its seen states, ascending.
        state, action, following, goal: (n,) int64, of each transition.
        steps: (n,) int64, to a goal of the own episode; 0 for any other.
    """

    scene: int
    states: Tensor
    state: Tensor
    action: Tensor
    following: Tensor
    goal: Tensor
    steps: Tensor

    def of_a_few_sizes(self) -> SceneSample:
        """Most of the transitions, drawn at random: of 64 and more, a multiple of 64. A processor compiles a
        bfloat16 kernel per number of rows."""
        number = len(self.state)
        row = torch.randperm(number)[: number - number % 64 if number >= 64 else number]
        parts = (part[row] for part in self[2:])
        return SceneSample(self.scene, self.states, *parts)

    def counts(self, num_actions: int) -> Tensor:
        """How often each state with an action has each goal, (S * A, S), float32."""
        size = len(self.states)
        place = (self.state * num_actions + self.action) * size + self.goal
        return place.bincount(minlength=size * num_actions * size).view(-1, size).float()


def scores_of(table: Tensor) -> Scores:
    """Scores that are looked up in a table (S, A, S).

    >>> scores_of(torch.arange(8.0).view(2, 2, 2))(torch.tensor([1]), torch.tensor([0]))
    tensor([[4., 6.]])
    """
    constant = table.detach()
    return lambda state, goal: constant[state, :, goal]


def slow_copy(critic: nn.Module, rate: float) -> AveragedModel:
    """A copy whose ``update_parameters(critic)`` moves its weights by a share ``rate`` of the way to the
    critic's.

    >>> layer = nn.Linear(1, 1, bias=False)
    >>> slow = slow_copy(layer, 0.25)
    >>> for value in (0.0, 1.0):
    ...     _ = nn.init.constant_(layer.weight, value)
    ...     slow.update_parameters(layer)
    >>> slow.module.weight.item()
    0.25
    """
    return AveragedModel(critic, multi_avg_fn=get_ema_multi_avg_fn(1 - rate))


class GoalLearning(RankedReplay, Algorithm):
    """Base: a critic of all pairs of states and goals, by a subclass's loss, and a policy from its scores.

    The agent walks to its trained goals, and its transitions go into a replay buffer. From samples of it the
    critic learns, and from the critic's scores the agent's policy (:class:`~vusfa.objectives.ScoreLoss`).

    No reward is read, and the agent acts without the critic: it is evaluated, filmed and exported like any
    other.

    Args:
        agent, scenes, settings: see :class:`~vusfa.algorithms.Algorithm`; of the agent the policy and the
            value are trained.

    Attributes:
        replay: transitions, with goals named in hindsight.
        critic: the networks of the critic.
    """

    Settings = GoalLearningSettings

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        numbers = self.numbers = settings["algorithm"]
        self._check(numbers)
        check_replay(self.name, agent, self.threads, history=1, encoder="mlp")
        kind, total = settings["collector"]["kind"], settings["total_frames"]
        if kind == "multi_async":
            raise ConfigError(
                f"algorithm={self.name} follows each environment from batch to batch, which"
                " collector.kind=multi_async hands over in no fixed order; give single or multi_sync"
            )
        starts = numbers["learning_starts"]
        self._starts = min(MAX_START, int(0.4 * total)) if starts is None else starts
        if not 0 <= self._starts < total:
            raise ConfigError(
                f"algorithm.learning_starts is {starts} of total_frames {total}: nothing would be learned;"
                " give fewer, 0 or more, or null"
            )
        self._learns = False
        sizes = {name: numbers[name] for name in _OF_REPLAY}
        self.replay = HindsightReplay(scenes.num_states, settings["collector"]["num_envs"], **sizes)
        coefficients = {name: numbers[name] for name in _OF_SCORES}
        networks = agent.get_policy_operator(), agent.get_value_operator()
        try:
            self.score_loss = ScoreLoss(*networks, **coefficients, functional=False)
        except ValueError as error:
            raise ConfigError(f"algorithm={self.name}: {error}") from error
        self.device = next(agent.parameters()).device
        self.score_loss.to(self.device)
        self.critic = self.make_critic(scenes.feature_size, scenes.num_actions).to(self.device)

    @property
    def name(self) -> str:
        """Its registered name."""
        return next(name for name, one in ALGORITHMS.items() if one is type(self))

    def _check(self, numbers: Mapping[str, Any]) -> None:
        for name in ("updates", "hidden_size", "embedding_size", "policy_pairs"):
            if numbers[name] < 1:
                raise ConfigError(f"algorithm.{name} is {numbers[name]}; give 1 or more")
        if not 0 < numbers["discount"] < 1:
            raise ConfigError(f"algorithm.discount is {numbers['discount']}; give a number between 0 and 1")

    def make_critic(self, feature_size: int, num_actions: int) -> nn.Module:
        """The critic's networks."""
        raise NotImplementedError

    def critic_terms(self, sample: SceneSample, features: Tensor) -> tuple[dict[str, Tensor], Scores]:
        """Terms of the critic in one scene, and its scores of all actions, a function of states and goals.

        Args:
            sample: the scene's transitions.
            features: (S, F) of its seen states.
        """
        raise NotImplementedError

    def parameters(self) -> Iterable[nn.Parameter]:
        """Those of the agent and of the critic."""
        return [*self.agent.parameters(), *self.critic.parameters()]

    def schedule(self, frames: int) -> None:
        """Begin to learn after ``learning_starts``, once and for all."""
        self._learns = self._learns or frames >= self._starts
        self.replay_steps = self.numbers["updates"] - 1 if self._learns else 0

    def scenes_on_record(self) -> Tensor:
        """Those of the replay buffer."""
        return self.replay.scenes()

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Terms of a sample that may hold the batch; at first, those of a uniform policy in the batch."""
        self.replay.extend(batch)
        if self._learns:
            return self.replay_losses()
        rows = batch.select("state_id", "goal_id", "scene_id").reshape(-1)
        equal = torch.zeros(len(rows), self.scenes.num_actions, device=rows["goal_id"].device)
        return dict(self.score_loss(rows.set("action_scores", equal)).items())

    def replay_losses(self) -> dict[str, Tensor]:
        """Terms of the critic, and of the policy that learns from it, of one sample."""
        terms: dict[str, Tensor] = {}
        pairs = []
        for sample in self.samples():
            features = self.agent.encoder.frames.lookup(sample.states)
            found, scores = self.critic_terms(sample, features)
            share = len(sample.state) / self.numbers["batch_size"]
            for name, value in found.items():
                terms[name] = terms.get(name, 0.0) + share * value
            pairs.append(self._pairs(sample, scores))
        return {**terms, **dict(self.score_loss(torch.cat(pairs)).items())}

    def samples(self) -> Iterator[SceneSample]:
        """A sample of the replay buffer, scene by scene."""
        rows = self.replay.sample()
        scene, seen = rows["scene_id"], self.replay.sampler.scene_of
        for number in scene.unique().tolist():
            part = rows[scene == number]
            states = (seen == number).nonzero().squeeze(-1)
            ids = part["state_id"][:, -1], part["next", "state_id"][:, -1], part["goal_id"]
            state, following, goal = (torch.searchsorted(states, each) for each in ids)
            yield SceneSample(number, states, state, part["action"], following, goal, part["steps_to_goal"])

    def _pairs(self, sample: SceneSample, scores: Scores) -> TensorDict:
        """Pairs of states and goals with their scores: half of them on the way of an episode, half any."""
        size, total = len(sample.states), int(self.replay.sampler.seen.sum())
        number = max(1, self.numbers["policy_pairs"] * size // total)
        row = torch.randint(len(sample.state), (number // 2,))
        anywhere = torch.randint(size, (2, number - number // 2))
        state = torch.cat([sample.state[row], anywhere[0]])
        goal = torch.cat([sample.goal[row], anywhere[1]])
        goal = torch.where(state == goal, (goal + 1) % size, goal)
        columns = {
            "state_id": sample.states[state].unsqueeze(-1),
            "goal_id": sample.states[goal],
            "scene_id": torch.full_like(goal, sample.scene),
            "action_scores": scores(state, goal),
        }
        return TensorDict(columns, [len(goal)])

    def state_dict(self) -> dict[str, Any]:
        """The critic, and the replay buffer."""
        return {
            "critic": self.critic.state_dict(),
            "replay": self.replay.state_dict(),
            "learns": self._learns,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with critic and replay buffer; a ``CheckpointError`` where the state has none."""
        self.warm_start(state)
        self.replay.load_state_dict(state["replay"])
        self._learns = bool(state["learns"])

    def warm_start(self, state: Mapping[str, Any]) -> None:
        """Take the critic; a ``CheckpointError`` where there is none, or another."""
        try:
            self.critic.load_state_dict(state["critic"])
        except (KeyError, RuntimeError) as error:
            raise CheckpointError(
                "of another algorithm; give the algorithm that it was trained with"
            ) from error
