"""Small actors and critics made by hand, in the ways that people build them, and rollouts for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

OBSERVATION, EMBEDDING, ACTIONS = 3, 5, 4


class Noise(nn.Module):
    """A sample of a Gaussian, drawn by torch itself: TorchRL's exploration type has no say."""

    def forward(self, loc: Tensor, scale: Tensor) -> Tensor:
        return loc + scale * torch.randn_like(scale) if self.training else loc


class Policy(nn.Module):
    """Reads embedding and successor features; the latter as constants."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Linear(2 * EMBEDDING, ACTIONS)

    def forward(self, embedding: Tensor, successor: Tensor) -> Tensor:
        return self.head(torch.cat([embedding, successor.detach()], -1))


@dataclass
class Networks:
    """An actor, a critic, the modules they are built of by name, and how often each of those ran."""

    actor: ProbabilisticActor
    critic: Seq
    parts: dict[str, Mod]
    calls: dict[str, int] = field(default_factory=dict)

    def count(self) -> None:
        for name, part in self.parts.items():
            self.calls[name] = 0
            part.register_forward_hook(self._counter(name))

    def _counter(self, name: str) -> Callable[..., None]:
        def hook(*_: object) -> None:
            self.calls[name] += 1

        return hook


def _actor(*modules: Mod, action_key: object = "action", **kwargs: object) -> ProbabilisticActor:
    return ProbabilisticActor(
        Seq(*modules),
        in_keys=["logits"],
        out_keys=[action_key],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
        **kwargs,
    )


def make_plain(observation: object = "observation", value: object = "state_value") -> Networks:
    """An actor and a critic that share nothing and know nothing of successor features."""
    policy = Mod(nn.Linear(OBSERVATION, ACTIONS), in_keys=[observation], out_keys=["logits"])
    head = Mod(nn.Linear(OBSERVATION, 1), in_keys=[observation], out_keys=[value])
    return Networks(_actor(policy), Seq(head), {"policy": policy, "value": head})


def make_usf(variational: bool = True) -> Networks:
    """An actor and a critic over one trunk, with successor features and, if variational, a bottleneck."""
    width = 2 * EMBEDDING if variational else EMBEDDING
    encoder = Mod(nn.Linear(OBSERVATION, width), in_keys=["observation"], out_keys=["encoded"])
    goal = Mod(nn.Linear(OBSERVATION, width), in_keys=["goal"], out_keys=["goal_encoded"])
    if variational:
        keys = ["state_loc", "state_scale", "state_embedding"]
        split = Mod(lambda x: (*x.chunk(2, -1), x.chunk(2, -1)[0]), in_keys=["encoded"], out_keys=keys)
        goal_split = Mod(
            lambda x: x.chunk(2, -1), in_keys=["goal_encoded"], out_keys=["goal_loc", "goal_scale"]
        )
        sample = Mod(Noise(), in_keys=["goal_loc", "goal_scale"], out_keys=["goal_latent"])
    else:
        split = Mod(nn.Identity(), in_keys=["encoded"], out_keys=["state_embedding"])
        goal_split = Mod(nn.Identity(), in_keys=["goal_encoded"], out_keys=["goal_embedding"])
        sample = Mod(nn.Identity(), in_keys=["goal_embedding"], out_keys=["goal_latent"])
    psi = Mod(nn.Linear(EMBEDDING, EMBEDDING), in_keys=["state_embedding"], out_keys=["successor_features"])
    omega = Mod(nn.Linear(EMBEDDING, EMBEDDING), in_keys=["goal_latent"], out_keys=["reward_weights"])
    value = Mod(
        lambda p, w: (p * w).sum(-1, keepdim=True),
        in_keys=["successor_features", "reward_weights"],
        out_keys=["state_value"],
    )
    policy = Mod(Policy(), in_keys=["state_embedding", "successor_features"], out_keys=["logits"])
    parts = {
        "encoder": encoder,
        "goal": goal,
        "split": split,
        "goal_split": goal_split,
        "sample": sample,
        "psi": psi,
        "omega": omega,
        "value": value,
        "policy": policy,
    }
    trunk = Seq(encoder, split)
    critic = Seq(trunk, Seq(goal, goal_split), psi, sample, omega, value)
    return Networks(_actor(trunk, psi, policy), critic, parts)


def make_rollout(
    *batch: int, seed: int = 0, ends: float = 0.3, keys: dict[str, object] | None = None
) -> TensorDict:
    """A rollout as a collector gives it: the next root is the next state, unless the episode ended."""
    generator = torch.Generator().manual_seed(seed)
    names: dict[str, object] = {"observation": "observation", "goal": "goal", "reward": "reward"}
    names |= {"done": "done", "terminated": "terminated", "action": "action"} | (keys or {})
    following = torch.randn(*batch, OBSERVATION, generator=generator)
    first = torch.randn(*batch[:-1], 1, OBSERVATION, generator=generator)
    restart = torch.randn(*batch, OBSERVATION, generator=generator)
    done = torch.rand(*batch, 1, generator=generator) < ends
    terminated = done & (torch.rand(*batch, 1, generator=generator) < 0.5)
    root = torch.cat([first, torch.where(done, restart, following)[..., :-1, :]], -2)
    goal = torch.randn(*batch[:-1], 1, OBSERVATION, generator=generator).expand(*batch, -1)
    td = TensorDict({}, batch)
    td.set(names["observation"], root)
    td.set(names["goal"], goal)
    td.set(names["action"], torch.randint(ACTIONS, batch, generator=generator))
    td.set(("next", names["observation"]), following)
    td.set(("next", names["goal"]), goal)
    td.set(("next", names["reward"]), torch.randn(*batch, 1, generator=generator))
    td.set(("next", names["done"]), done)
    td.set(("next", names["terminated"]), terminated)
    return td


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def plain() -> Callable[..., Networks]:
    return make_plain


@pytest.fixture
def usf() -> Callable[..., Networks]:
    return make_usf


@pytest.fixture
def rollout() -> Callable[..., TensorDict]:
    return make_rollout
