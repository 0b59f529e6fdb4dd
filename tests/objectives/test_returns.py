"""The estimator, against plain loops over rows, TorchRL's estimators, and its promise of one evaluation."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import GymEnv
from torchrl.modules import LSTMModule, set_recurrent_mode
from torchrl.objectives.value import GAE, TDLambdaEstimator

from vusfa.objectives import USFEstimator


def table_critic(states: int = 6, features: int = 2, goal: bool = False) -> Seq:
    """Value, successor features and embedding of a state number, from fixed tables."""
    keys = ["state"]
    generator = torch.Generator().manual_seed(1)
    tables = [
        torch.randn(states, n, generator=generator, dtype=torch.double) for n in (1, features, features)
    ]

    def look_up(state: Tensor) -> tuple[Tensor, ...]:
        return tuple(table[state] for table in tables)

    critic = Mod(look_up, in_keys=keys, out_keys=["state_value", "successor_features", "state_embedding"])
    critic.tables = tables
    return critic


def transcribed_targets(
    td: TensorDict, critic: Mod, gamma: float, lmbda: float, bootstrap_at_timeout: bool
) -> tuple[list, list, list]:
    """One row, one number at a time, backwards."""
    value, psi, phi = (table.tolist() for table in critic.tables)
    features = range(len(psi[0]))
    steps = td.shape[0]
    state, following = td["state"].tolist(), td["next", "state"].tolist()
    advantage, target, successor = [0.0] * steps, [0.0] * steps, [[0.0] * len(psi[0])] * steps
    for t in reversed(range(steps)):
        done, terminated = bool(td["next", "done"][t]), bool(td["next", "terminated"][t])
        if done and not bootstrap_at_timeout:
            terminated = True
        if terminated:
            rest, psi_rest = 0.0, [0.0 for _ in features]
        elif done or t == steps - 1:
            rest, psi_rest = value[following[t]][0], psi[following[t]]
        else:
            rest = (1 - lmbda) * value[following[t]][0] + lmbda * target[t + 1]
            psi_rest = [(1 - lmbda) * psi[following[t]][i] + lmbda * successor[t + 1][i] for i in features]
        target[t] = float(td["next", "reward"][t]) + gamma * rest
        embedding = phi[following[t]]
        successor[t] = [embedding[i] + gamma * psi_rest[i] for i in features]
        advantage[t] = target[t] - value[state[t]][0]
    return advantage, target, successor


def table_rollout(*batch: int, seed: int, ends: float) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    following = torch.randint(6, batch, generator=generator)
    done = torch.rand(*batch, 1, generator=generator) < ends
    restart = torch.where(done.squeeze(-1), torch.randint(6, batch, generator=generator), following)
    first = torch.randint(6, (*batch[:-1], 1), generator=generator)
    return TensorDict(
        {
            "state": torch.cat([first, restart[..., :-1]], -1),
            "next": {
                "state": following,
                "reward": torch.randn(*batch, 1, generator=generator, dtype=torch.double),
                "done": done,
                "terminated": done & (torch.rand(*batch, 1, generator=generator) < 0.5),
            },
        },
        batch,
    )


class TestTargets:
    @given(
        batch=st.sampled_from([(1,), (7,), (1, 1), (4, 5), (3, 1), (2, 3, 4)]),
        seed=st.integers(0, 2**20),
        ends=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
        gamma=st.floats(0, 1),
        lmbda=st.sampled_from([0.0, 0.3, 0.95, 1.0]),
        bootstrap_at_timeout=st.booleans(),
    )
    @settings(max_examples=80)
    def test_equal_a_plain_transcription(self, batch, seed, ends, gamma, lmbda, bootstrap_at_timeout) -> None:
        td = table_rollout(*batch, seed=seed, ends=ends)
        critic = table_critic()
        options = {"bootstrap_at_timeout": bootstrap_at_timeout}
        estimator = USFEstimator(value_network=critic, gamma=gamma, lmbda=lmbda, **options)
        result = estimator(td)
        assert result is td
        rows = td.reshape(-1, batch[-1])
        for row in rows:
            expected = transcribed_targets(row, critic, gamma, lmbda, **options)
            for key, values in zip(("advantage", "value_target", "successor_target"), expected, strict=True):
                values = torch.tensor(values, dtype=torch.double).reshape(row[key].shape)
                torch.testing.assert_close(row[key], values, rtol=0, atol=1e-10)

    def test_by_hand(self) -> None:
        """A terminal, a time-out, a plain step, the end; V(s) = s, psi(s) = 10 s, phi(s) = s + 0.5."""
        critic = Mod(
            lambda s: (s.float(), 10 * s.float(), s + 0.5),
            in_keys=["s"],
            out_keys=["state_value", "successor_features", "state_embedding"],
        )
        td = TensorDict(
            {
                "s": torch.tensor([[1], [5], [7], [8]]),
                "next": {
                    "s": torch.tensor([[2], [6], [8], [9]]),
                    "reward": torch.tensor([[1.0], [2.0], [3.0], [4.0]]),
                    "done": torch.tensor([[True], [True], [False], [False]]),
                    "terminated": torch.tensor([[True], [False], [False], [False]]),
                },
            },
            [4],
        )
        USFEstimator(value_network=critic, gamma=0.5)(td)
        # 1 and nothing more; 2 + 6/2; 3 + 8.5/2; 4 + 9/2
        assert td["value_target"].squeeze(-1).tolist() == [1.0, 5.0, 7.25, 8.5]
        assert td["advantage"].squeeze(-1).tolist() == [0.0, 0.0, 0.25, 0.5]
        # 2.5 and nothing more; 6.5 + 60/2; 8.5 + 54.5/2; 9.5 + 90/2
        assert td["successor_target"].squeeze(-1).tolist() == [2.5, 36.5, 35.75, 54.5]

    def test_targets_are_constants(self, usf, rollout) -> None:
        networks = usf()
        td = USFEstimator(value_network=networks.critic)(rollout(2, 4))
        for key in ("advantage", "value_target", "successor_target"):
            assert not td[key].requires_grad
            assert td[key].isfinite().all()

    def test_value_estimate_is_the_target_alone(self) -> None:
        td = table_rollout(2, 4, seed=0, ends=0.3)
        estimator = USFEstimator(value_network=table_critic())
        target = estimator.value_estimate(td)
        assert "value_target" not in td
        torch.testing.assert_close(target, estimator(td)["value_target"])

    @pytest.mark.parametrize("lmbda", [0.0, 0.7, 1.0])
    def test_without_successor_features_it_is_torchrls(self, plain, rollout, lmbda: float) -> None:
        critic = plain().critic
        td = rollout(5, 8, ends=0.3)
        estimator = USFEstimator(value_network=critic, gamma=0.9, lmbda=lmbda)
        mine = estimator(td.clone())
        assert estimator.out_keys == ["advantage", "value_target"]
        assert "successor_target" not in mine
        for theirs in (GAE, TDLambdaEstimator):
            # their vectorised path fails for lmbda=0
            expected = theirs(value_network=critic, gamma=0.9, lmbda=lmbda, vectorized=False)(td.clone())
            torch.testing.assert_close(mine["advantage"], expected["advantage"], rtol=0, atol=1e-6)
            torch.testing.assert_close(mine["value_target"], expected["value_target"], rtol=0, atol=1e-6)

    def test_normalised_advantage(self) -> None:
        td = table_rollout(8, 9, seed=0, ends=0.2)
        raw = USFEstimator(value_network=table_critic())(td.clone())
        scaled = USFEstimator(value_network=table_critic(), normalize_advantage=True)(td)
        assert scaled["advantage"].mean().abs() < 1e-9
        assert scaled["advantage"].std(correction=0).item() == pytest.approx(1.0)
        correlation = torch.corrcoef(torch.stack([raw["advantage"].flatten(), scaled["advantage"].flatten()]))
        assert correlation[0, 1].item() == pytest.approx(1.0)
        torch.testing.assert_close(raw["value_target"], scaled["value_target"])

    def test_small_advantages_are_not_blown_up(self) -> None:
        td = table_rollout(8, 9, seed=0, ends=0.2)
        raw = USFEstimator(value_network=table_critic())(td.clone())["advantage"]
        floor = 10 * raw.std().item()
        estimator = USFEstimator(
            value_network=table_critic(), normalize_advantage=True, min_advantage_std=floor
        )
        torch.testing.assert_close(estimator(td)["advantage"], (raw - raw.mean()) / floor)

    def test_half_precision_of_the_critic_does_not_reach_the_sums(self) -> None:
        """A critic under autocast writes bfloat16; the returns are summed in the reward's precision."""
        critic = Mod(
            lambda s: (s.bfloat16(), s.bfloat16(), s.bfloat16()),
            in_keys=["s"],
            out_keys=["state_value", "successor_features", "state_embedding"],
        )
        no = torch.zeros(50, 1, dtype=torch.bool)
        s = torch.ones(50, 1)
        following = {"s": s, "reward": torch.full((50, 1), 0.01), "done": no, "terminated": no}
        td = USFEstimator(value_network=critic, gamma=1.0)(TensorDict({"s": s, "next": following}, [50]))
        assert td["value_target"].dtype == td["successor_target"].dtype == torch.float32
        torch.testing.assert_close(td["value_target"][0], torch.tensor([1.5]))
        torch.testing.assert_close(td["successor_target"][0], torch.tensor([51.0]))
        plain = Mod(lambda s: (0.3 * s).bfloat16(), in_keys=["s"], out_keys=["state_value"])
        td = USFEstimator(value_network=plain, gamma=0.99)(td.exclude("value_target", "advantage"))
        written = torch.tensor(0.3).bfloat16().float()
        torch.testing.assert_close(td["value_target"][-1:, 0], 0.01 + 0.99 * written[None], rtol=0, atol=1e-7)


class TestOneEvaluation:
    def test_the_critic_sees_each_state_once(self) -> None:
        """T roots a row, its last next state, and the next states of steps that ended in mid-rollout."""
        td = table_rollout(4, 6, seed=3, ends=0.3)
        critic, sizes = table_critic(), []
        critic.register_forward_hook(lambda module, args, out: sizes.append(args[0].numel()))
        USFEstimator(value_network=critic)(td)
        inside = td["next", "done"][:, :-1].sum().item()
        assert inside > 0
        assert sizes == [4 * 6 + 4 + inside]

    @pytest.mark.parametrize("time_dim", [0, 1])
    def test_what_the_critic_wrote_at_the_roots_may_be_known(self, time_dim: int) -> None:
        """The same targets; the critic sees only the states that are no root."""
        td = table_rollout(4, 6, seed=3, ends=0.3)
        critic, sizes = table_critic(), []
        wanted, written = USFEstimator(value_network=critic)(td.copy()), critic(td.copy())
        critic.register_forward_hook(lambda module, args, out: sizes.append(args[0].numel()))
        if time_dim == 0:
            td, written = td.transpose(0, 1), written.transpose(0, 1)
        got = USFEstimator(value_network=critic)(td.copy(), written=written, time_dim=time_dim)
        for key in ("advantage", "value_target", "successor_target"):
            torch.testing.assert_close(got[key], wanted[key] if time_dim else wanted[key].transpose(0, 1))
        assert sizes == [4 + td["next", "done"].sum().item() - wanted["next", "done"][:, -1].sum().item()]

    def test_it_runs_on_the_parameters_given(self, plain, rollout) -> None:
        critic = plain().critic
        td = rollout(2, 4)
        params = TensorDict.from_module(critic).data.apply(torch.zeros_like)
        estimator = USFEstimator(value_network=critic, gamma=0.0)
        with_zeros = estimator(td.clone(), params=params)
        torch.testing.assert_close(with_zeros["advantage"], td["next", "reward"])
        assert (estimator(td.clone())["advantage"] - td["next", "reward"]).abs().min() > 1e-4
        torch.testing.assert_close(estimator.value_estimate(td, target_params=params), td["next", "reward"])
        own = TensorDict.from_module(critic).data
        with_zeros = estimator(td.clone(), params=own, target_params=params)
        torch.testing.assert_close(with_zeros["advantage"], td["next", "reward"])

    def test_what_the_next_state_lacks_is_the_roots(self, usf, rollout) -> None:
        """A goal that stays need not be stored twice."""
        critic = usf(variational=False).critic
        td = rollout(3, 5)
        expected = USFEstimator(value_network=critic)(td.clone())
        del td["next", "goal"]
        result = USFEstimator(value_network=critic)(td)
        torch.testing.assert_close(result["successor_target"], expected["successor_target"])

    def test_next_observations_that_a_compact_collector_left_out(self, plain, rollout) -> None:
        """NaN at an ended step: the root stands in at a time-out, and a terminal needs nothing."""
        critic = plain().critic
        td = rollout(3, 5, ends=0.5)
        replaced = td.clone()
        done = td["next", "done"].squeeze(-1)
        replaced["next", "observation"] = torch.where(
            done.unsqueeze(-1), td["observation"], td["next", "observation"]
        )
        td["next", "observation"][done] = math.nan
        result = USFEstimator(value_network=critic)(td)
        expected = USFEstimator(value_network=critic)(replaced)
        torch.testing.assert_close(result["advantage"], expected["advantage"])


class TestLayouts:
    def test_nested_and_renamed_keys(self) -> None:
        td = table_rollout(2, 5, seed=0, ends=0.3)
        critic = table_critic()
        expected = USFEstimator(value_network=critic)(td.clone())
        renamed = Mod(
            critic.module, in_keys=[("agent", "state")], out_keys=[("agent", "v"), ("agent", "psi"), "phi"]
        )
        nested = TensorDict({}, td.batch_size)
        nested.set(("agent", "state"), td["state"])
        nested.set(("next", "agent", "state"), td["next", "state"])
        nested.set(("next", "agent", "reward"), td["next", "reward"])
        nested.set(("next", "flags", "done"), td["next", "done"])
        nested.set(("next", "flags", "terminated"), td["next", "terminated"])
        estimator = USFEstimator(value_network=renamed)
        estimator.set_keys(
            value=("agent", "v"),
            successor_features=("agent", "psi"),
            state_embedding="phi",
            successor_target=("targets", "psi"),
            value_target=("targets", "v"),
            advantage=("targets", "advantage"),
            reward=("agent", "reward"),
            done=("flags", "done"),
            terminated=("flags", "terminated"),
        )
        assert estimator.out_keys == [("targets", "advantage"), ("targets", "v"), ("targets", "psi")]
        estimator(nested)
        torch.testing.assert_close(nested["targets", "psi"], expected["successor_target"])
        torch.testing.assert_close(nested["targets", "v"], expected["value_target"])
        torch.testing.assert_close(nested["targets", "advantage"], expected["advantage"])

    @pytest.mark.parametrize("how", ["name", "argument"])
    def test_time_may_be_another_dimension(self, how: str) -> None:
        td = table_rollout(3, 5, seed=0, ends=0.3)
        expected = USFEstimator(value_network=table_critic())(td.clone())
        moved = td.transpose(0, 1).contiguous()
        if how == "name":
            moved.names = ["time", None]
            result = USFEstimator(value_network=table_critic())(moved)
        else:
            result = USFEstimator(value_network=table_critic())(moved, time_dim=0)
        assert result is moved
        torch.testing.assert_close(result["successor_target"].transpose(0, 1), expected["successor_target"])
        torch.testing.assert_close(result["advantage"].transpose(0, 1), expected["advantage"])

    def test_lazy_stacks_of_workers(self) -> None:
        rows = [table_rollout(3, 5, seed=seed, ends=0.3) for seed in range(2)]
        stacked = TensorDict.lazy_stack([row.clone() for row in rows])
        result = USFEstimator(value_network=table_critic())(stacked)
        for worker, row in enumerate(rows):
            expected = USFEstimator(value_network=table_critic())(row)
            torch.testing.assert_close(result["advantage"][worker], expected["advantage"])

    def test_rows_that_are_padded(self) -> None:
        """Trajectories cut by the batch's end and padded: padding is no next state and counts for nothing."""
        td = table_rollout(2, 6, seed=0, ends=0.0)
        mask = torch.ones(2, 6, dtype=torch.bool)
        mask[1, 3:] = False
        full = USFEstimator(value_network=table_critic())(td[1:, :3].clone())
        padded = td.clone()
        padded["collector", "mask"] = mask
        padded["state"][1, 3:] = 0
        padded["next", "reward"][1, 3:] = math.inf
        result = USFEstimator(value_network=table_critic(), normalize_advantage=True)(padded.clone())
        assert result["advantage"][mask].mean().abs() < 1e-9
        result = USFEstimator(value_network=table_critic())(padded)
        torch.testing.assert_close(result["value_target"][1:, :3], full["value_target"])
        torch.testing.assert_close(result["successor_target"][1:, :3], full["successor_target"])

    def test_without_a_tensordict(self) -> None:
        td = table_rollout(2, 4, seed=0, ends=0.3)
        estimator = USFEstimator(value_network=table_critic())
        expected = estimator(td.clone())
        advantage, value_target, successor_target = estimator(
            state=td["state"],
            next_state=td["next", "state"],
            next_reward=td["next", "reward"],
            next_done=td["next", "done"],
            next_terminated=td["next", "terminated"],
        )
        torch.testing.assert_close(advantage, expected["advantage"])
        torch.testing.assert_close(value_target, expected["value_target"])
        torch.testing.assert_close(successor_target, expected["successor_target"])

    def test_terminated_defaults_to_done(self) -> None:
        td = table_rollout(2, 4, seed=0, ends=0.5)
        td["next", "terminated"] = td["next", "done"]
        expected = USFEstimator(value_network=table_critic())(td.clone())
        del td["next", "terminated"]
        result = USFEstimator(value_network=table_critic())(td)
        torch.testing.assert_close(result["advantage"], expected["advantage"])


class TestRecurrentCritics:
    """Critics that read ``is_init`` are run along time, not on a flat batch."""

    def networks(self) -> Seq:
        lstm = LSTMModule(input_size=3, hidden_size=4, in_key="observation", out_key="hidden")
        head = Mod(nn.Linear(4, 1), in_keys=["hidden"], out_keys=["state_value"])
        psi = Mod(nn.Linear(4, 2), in_keys=["hidden"], out_keys=["successor_features"])
        phi = Mod(nn.Linear(3, 2), in_keys=["observation"], out_keys=["state_embedding"])
        return Seq(lstm, head, psi, phi)

    def rollout(self, critic: Seq, rollout, batch: int, steps: int, seed: int) -> TensorDict:
        """As a collector writes it: the hidden state is carried along, and reset where an episode begins."""
        td = rollout(batch, steps, ends=0.4, seed=seed)
        done = td["next", "done"]
        td["is_init"] = torch.cat([torch.ones(batch, 1, 1, dtype=torch.bool), done[:, :-1]], 1)
        td["next", "is_init"] = torch.zeros(batch, steps, 1, dtype=torch.bool)
        hidden = {key: torch.zeros(batch, 1, 4) for key in ("recurrent_state_h", "recurrent_state_c")}
        columns = []
        with torch.no_grad(), set_recurrent_mode(False):
            for t in range(steps):
                step = td[:, t].clone()
                for key, value in hidden.items():
                    step[key] = torch.where(step["is_init"].unsqueeze(-1), 0.0, value)
                step = critic(step)
                hidden = {key: step["next", key] for key in hidden}
                columns.append(step)
        return torch.stack(columns, 1).contiguous()

    @pytest.mark.parametrize("seed", [1, 2])
    def test_equals_a_walk_through_time(self, rollout, seed: int) -> None:
        critic = self.networks()
        td = self.rollout(critic, rollout, 3, 6, seed)
        # episodes that begin with the last step, and that last one step
        assert td["is_init"][:, -1].any()
        assert (td["is_init"] & td["next", "done"])[:, :-1].any()
        walked = {key: td[key].clone() for key in ("state_value", "successor_features", "state_embedding")}
        with torch.no_grad(), set_recurrent_mode(False):
            following = critic(td["next"].exclude("next").reshape(-1).clone()).reshape(td.shape)
        result = USFEstimator(value_network=critic, gamma=0.9, lmbda=0.8)(td.exclude(*walked))
        tables = Mod(
            lambda i: tuple(
                torch.cat([walked[key].reshape(18, -1), following[key].reshape(18, -1)])[i] for key in walked
            ),
            in_keys=["state"],
            out_keys=list(walked),
        )
        numbered = td.select(("next", "reward"), ("next", "done"), ("next", "terminated"))
        numbered["state"] = torch.arange(18).reshape(3, 6)
        numbered["next", "state"] = torch.arange(18, 36).reshape(3, 6)
        expected = USFEstimator(value_network=tables, gamma=0.9, lmbda=0.8)(numbered)
        for key in ("advantage", "value_target", "successor_target"):
            torch.testing.assert_close(result[key], expected[key], rtol=1e-5, atol=1e-5)

    def test_no_next_state_begins_an_episode(self) -> None:
        """The step to it goes on from the root's hidden state, even where the root began an episode."""
        seen = []

        def look(state: Tensor, is_init: Tensor) -> Tensor:
            seen.append((state.squeeze(-1).tolist(), is_init.squeeze(-1).tolist()))
            return state.float()

        critic = Mod(look, in_keys=["state", "is_init"], out_keys=["state_value"])
        td = table_rollout(1, 3, seed=0, ends=0.0)
        td["state"], td["next", "state"] = torch.tensor([[[0], [1], [2]]]), torch.tensor([[[7], [8], [9]]])
        td["next", "done"][0, 0] = True
        td["is_init"] = torch.ones(1, 3, 1, dtype=torch.bool)
        USFEstimator(value_network=critic)(td)
        assert seen == [([[0, 1, 2, 9]], [[True, True, True, False]]), ([[7]], [[False]])]


class TestErrors:
    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"gamma": 1.5}, "gamma is 1.5"),
            ({"lmbda": -0.1}, "lmbda is -0.1"),
            ({"min_advantage_std": 0.0}, "min_advantage_std is 0.0"),
        ],
    )
    def test_hyperparameters(self, wrong: dict, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            USFEstimator(value_network=table_critic(), **wrong)

    def test_no_time_dimension(self) -> None:
        with pytest.raises(ValueError, match="time dimension"):
            USFEstimator(value_network=table_critic())(TensorDict({"next": {}}, []))

    def test_unknown_keys(self) -> None:
        estimator = USFEstimator(value_network=table_critic())
        with pytest.raises(KeyError, match="unknown is not an accepted"):
            estimator.set_keys(unknown="x")
        with pytest.raises(KeyError, match="not found in value network"):
            estimator.set_keys(value="x")

    @pytest.mark.parametrize("missing", ["state", "reward", "done"])
    def test_what_a_collector_left_out(self, missing: str) -> None:
        """Without next states (compact_obs=True) V of the last state itself would stand for the future."""
        td = table_rollout(2, 3, seed=0, ends=0.3).exclude(("next", missing))
        message = "compact_obs=False" if missing == "state" else rf"no \('next', '{missing}'\)"
        with pytest.raises(KeyError, match=message):
            USFEstimator(value_network=table_critic())(td)
        with pytest.raises(KeyError, match=r"no .*'next'"):
            USFEstimator(value_network=table_critic())(td.exclude("next"))

    def test_a_compact_collector(self) -> None:
        env = GymEnv("CartPole-v1")
        critic = Mod(nn.Linear(4, 1), in_keys=["observation"], out_keys=["state_value"])
        for compact in (False, True):
            collector = Collector(
                env,
                frames_per_batch=8,
                total_frames=8,
                compact_obs=compact,
                auto_register_policy_transforms=False,
            )
            (batch,) = list(collector)
            if compact:
                with pytest.raises(KeyError, match=r"none of \['observation'\].*compact_obs=False"):
                    USFEstimator(value_network=critic)(batch)
            else:
                assert USFEstimator(value_network=critic)(batch)["advantage"].isfinite().all()


def test_gamma_and_lmbda_are_buffers_that_keep_their_precision() -> None:
    estimator = USFEstimator(value_network=table_critic(), gamma=0.9, lmbda=0.7)
    state = {name: value.item() for name, value in estimator.state_dict().items()}
    assert state == {"gamma": 0.9, "lmbda": 0.7}
    for moved in (estimator.float(), estimator.half(), estimator.to("meta")):
        assert (moved.gamma.item(), moved.lmbda.item()) == (0.9, 0.7)
    other = USFEstimator(value_network=table_critic())
    other.load_state_dict(estimator.state_dict())
    assert (other.gamma.item(), other.lmbda.item()) == (0.9, 0.7)
    other.load_state_dict({})  # of version 0.1
    assert other.gamma.item() == 0.9
