"""USFLoss trains: in TorchRL's own A2C trainer, and networks of other people on a plain task."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import GymEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import MLP, OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import ValueEstimators
from torchrl.trainers.algorithms.a2c import A2CTrainer

from vusfa.objectives import DualAscent, TFRMSprop, USFLoss

# what TorchRL says of its own trainer
EXPERIMENTAL = pytest.mark.filterwarnings(
    "ignore:A2CTrainer is an experimental:UserWarning",
    "ignore:The '.*' hook stage will be replaced:FutureWarning",
)


def cart_pole() -> TransformedEnv:
    env = TransformedEnv(GymEnv("CartPole-v1"))
    env.append_transform(StepCounter())
    env.append_transform(RewardSum())
    env.set_seed(0)
    return env


def plain_networks(env: TransformedEnv) -> tuple[ProbabilisticActor, ValueOperator]:
    """Someone else's: two perceptrons that share nothing, built of TorchRL's own parts."""
    body = Mod(MLP(4, 2, num_cells=[64]), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(
        body,
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    return actor, ValueOperator(MLP(4, 1, num_cells=[64]), in_keys=["observation"])


class Split(nn.Module):
    """Mean, scale and a sample of a latent, from one vector."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        loc, scale = x.chunk(2, -1)
        return loc, scale, loc + scale * torch.randn_like(scale)


def successor_networks(env: TransformedEnv, shared: bool) -> tuple[ProbabilisticActor, Seq]:
    """Someone else's successor features, under other names, beside the policy or over one trunk with it."""
    trunk = Mod(MLP(4, 64, num_cells=[64]), in_keys=["observation"], out_keys=["code"])
    split = Mod(Split(), in_keys=["code"], out_keys=["mu", "sigma", "z"])
    if shared:
        body = Seq(trunk, split, Mod(nn.Linear(32, 2), in_keys=["mu"], out_keys=["logits"]))
    else:
        body = Mod(MLP(4, 2, num_cells=[64]), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(
        body,
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    features = Mod(nn.Linear(32, 32), in_keys=["mu"], out_keys=["sf"])
    value = Mod(nn.Linear(32, 1), in_keys=["sf"], out_keys=["v"])
    return actor, Seq(trunk, split, features, value)


def make_trainer(
    loss: USFLoss, frames: int, estimator: object, optimiser: torch.optim.Optimizer
) -> A2CTrainer:
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(64), sampler=SamplerWithoutReplacement(), batch_size=32, shared=False
    )
    return A2CTrainer(
        collector=Collector(
            cart_pole,
            loss.actor_network,
            frames_per_batch=64,
            total_frames=frames,
            auto_register_policy_transforms=False,
        ),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=None,
        loss_module=loss,
        optimizer=optimiser,
        replay_buffer=buffer,
        clip_norm=40.0,
        progress_bar=False,
        enable_logging=False,
        gae=estimator,
    )


class TestA2CTrainer:
    @EXPERIMENTAL
    def test_a_plain_actor_and_critic(self) -> None:
        """With the estimator that the trainer makes by itself."""
        loss = USFLoss(*plain_networks(cart_pole()))
        before = [p.detach().clone() for p in loss.parameters()]
        trainer = make_trainer(loss, 256, None, torch.optim.Adam(loss.parameters(), 1e-3))
        trainer.train()
        assert trainer.collected_frames == 256
        assert all((p != b).any() for p, b in zip(loss.parameters(), before, strict=True))

    @EXPERIMENTAL
    def test_successor_features_and_a_multiplier(self) -> None:
        """With our estimator, TensorFlow's RMSProp, and the multiplier as a hook after each step."""
        networks = successor_networks(cart_pole(), shared=True)
        loss = USFLoss(*networks, information_target=0.01, successor_coeff=0.1)
        loss.set_keys(value="v", successor_features="sf", state_embedding="mu")
        loss.set_keys(state_loc="mu", state_scale="sigma")
        assert {"loss_successor", "loss_bottleneck"} <= set(loss.out_keys)
        loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
        before = {name: p.detach().clone() for name, p in loss.named_parameters()}
        trainer = make_trainer(loss, 256, loss.value_estimator, TFRMSprop(loss.parameters(), lr=1e-2))
        trainer.register_op("post_optim", DualAscent(loss, step_size=0.1).step)
        trainer.train()
        assert all((p != before[name]).any() for name, p in loss.named_parameters())
        assert loss.bottleneck_coeff > 0


class TestPlainTask:
    """A plain loop, as a user would write it."""

    def train(self, loss: USFLoss, frames: int = 3400) -> list[TensorDict]:
        """What each batch gave: the mean length of its episodes and its losses."""
        loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95, normalize_advantage=True)
        optimiser = torch.optim.Adam(loss.parameters(), 3e-3)
        collector = Collector(
            cart_pole,
            loss.actor_network,
            frames_per_batch=200,
            total_frames=frames,
            auto_register_policy_transforms=False,
        )
        history = []
        for rollout in collector:
            targets = loss.value_estimator(rollout)
            for _ in range(4):
                losses = loss(targets)
                optimiser.zero_grad()
                sum(value for key, value in losses.items() if key.startswith("loss")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
            ended = rollout["next", "done"]
            # a batch in which no episode ends is one of long episodes
            length = rollout["next", "step_count"][ended].double().mean().nan_to_num(200.0)
            if "successor_target" in targets:
                losses["scale"] = targets["successor_target"].square().mean()
            history.append(losses.detach().set("length", length))
        collector.shutdown()
        return history

    def test_two_perceptrons_learn_to_balance_a_pole(self) -> None:
        history = torch.stack(self.train(USFLoss(*plain_networks(cart_pole()))))
        terms = {"loss_objective", "loss_critic", "loss_entropy", "entropy", "explained_variance"}
        assert set(history.keys()) == terms | {"length"}
        # a random policy lasts 22 steps
        assert history["length"][:5].mean() < 55
        assert history["length"][-5:].mean() > 65

    def test_successor_features_of_other_names_learn_too(self) -> None:
        loss = USFLoss(*successor_networks(cart_pole(), shared=False), successor_coeff=0.1)
        loss.set_keys(value="v", successor_features="sf", state_embedding="mu")
        loss.set_keys(goal_loc="mu", goal_scale="sigma")
        history = torch.stack(self.train(loss))
        assert history["length"][:5].mean() < 55
        assert history["length"][-5:].mean() > 65
        # the share of the targets that the features leave unexplained, from all of it at first
        unexplained = history["loss_successor"] / loss.successor_coeff / history["scale"]
        assert unexplained[0] > 0.9
        assert unexplained[-5:].mean() < 0.9
