"""The released code's numbers, reproduced: ``pytest tests/test_reference_parity.py --golden DIR``.

DIR holds what the authors' TensorFlow code computed, and how it was fed; its README describes every file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import A2CLoss, LossModule

from vusfa.envs import TargetNavEnv
from vusfa.modules import Agent, make_agent
from vusfa.objectives import DualAscent, TFRMSprop, USFEstimator, USFLoss, optim
from vusfa.objectives.functional import dual_ascent
from vusfa.scenes import Scene, SceneSet


class TestEnvironment:
    """golden_env.json: walks of 40 given actions in a room of 12 states, 4 starts, 1 and 4 frames."""

    @pytest.fixture
    def traces(self, golden: Path) -> dict[str, Any]:
        return json.loads((golden / "golden_env.json").read_text())

    @pytest.fixture
    def scenes(self, golden: Path) -> SceneSet:
        return SceneSet([Scene.load(golden / "tiny_scene.h5")])

    def test_the_scene_file_holds_what_the_traces_describe(
        self, traces: dict[str, Any], scenes: SceneSet
    ) -> None:
        scene = scenes.scenes[0]
        assert scene.graph.tolist() == traces["graph"]
        assert scene.distance.tolist() == traces["shortest_path_distance"]
        assert scene.rotation.tolist() == traces["rotation"]
        torch.testing.assert_close(scene.location, torch.tensor(traces["location"]))
        torch.testing.assert_close(scene.features, torch.tensor(traces["resnet_feature"]), rtol=0, atol=1e-7)

    @pytest.mark.parametrize("rewards", ["environment", "thread"])
    def test_every_walk(self, traces: dict[str, Any], scenes: SceneSet, rewards: str) -> None:
        """All starts walk at once, one row each; rows that end begin again at their own start."""
        goal = traces["terminal_state_id"]
        raw = {"goal_reward": 10.0, "step_reward": -0.01, "collision_reward": -0.1}
        for history in sorted({run["history_length"] for run in traces["runs"]}):
            runs = [run for run in traces["runs"] if run["history_length"] == history]
            env = TargetNavEnv(
                scenes,
                goals=[goal],
                batch_size=[len(runs)],
                history=history,
                max_steps=10_000,
                **(raw if rewards == "environment" else {}),
            )
            starts = torch.tensor([run["start_state"] for run in runs])
            begin = env.set_state(starts, torch.tensor(goal))
            now = begin
            assert len(runs) > 0
            assert {len(run["steps"]) for run in runs} == {len(traces["actions"])}
            for expected in zip(*(run["steps"] for run in runs), strict=True):
                again = torch.tensor([step["reset_to_start_before"] for step in expected])
                now = torch.where(again, begin, now)
                assert now["state_id"].tolist() == [step["history_before"] for step in expected]
                assert now["state_id"][:, -1].tolist() == [step["state_before"] for step in expected]
                action = torch.tensor([step["action"] for step in expected])
                after = env.step(now.clone().set("action", action))["next"]
                assert after["state_id"].tolist() == [step["history_after"] for step in expected]
                assert after["state_id"][:, -1].tolist() == [step["state_after"] for step in expected]
                assert after["collided"][:, 0].tolist() == [step["collided"] for step in expected]
                assert after["terminated"][:, 0].tolist() == [step["terminal"] for step in expected]
                wanted = torch.tensor(
                    [step[f"reward_{'env' if rewards == 'environment' else 'thread'}"] for step in expected]
                )
                torch.testing.assert_close(after["reward"][:, 0], wanted.float(), rtol=0, atol=1e-7)
                now = after.exclude("reward")

    def test_the_goal_fills_the_whole_target(self, traces: dict[str, Any]) -> None:
        """The goal's frame is repeated over the history, which is why one ``goal_id`` says it all."""
        for run in traces["runs"]:
            assert run["target_history"] == [traces["terminal_state_id"]] * run["history_length"]

    def test_resets_begin_where_the_released_code_begins(
        self, traces: dict[str, Any], scenes: SceneSet
    ) -> None:
        env = TargetNavEnv(
            scenes, goals=[traces["terminal_state_id"]], batch_size=[traces["reset"]["samples"]], seed=0
        )
        assert env.reset()["state_id"].unique().tolist() == traces["reset"]["states_seen"]

    def test_states_that_cannot_reach_the_goal_never_begin(
        self, traces: dict[str, Any], scenes: SceneSet
    ) -> None:
        """The released code reads the distance table, ours the graph: here the states' own moves are cut."""
        blocked, goal = traces["reset"]["blocked_rows"], traces["terminal_state_id"]
        graph = scenes.scenes[0].graph.clone()
        graph[blocked] = -1
        cut = Scene("cut", graph, scenes.scenes[0].features)
        env = TargetNavEnv(SceneSet([cut]), goals=[goal], batch_size=[traces["reset"]["samples"]], seed=0)
        seen = env.reset()["state_id"].unique().tolist()
        assert seen == (cut.distance[:, goal] > 0).nonzero()[:, 0].tolist()
        assert set(seen) <= set(traces["reset"]["states_seen_when_rows_blocked"])


# Layer names of the golden files, in our agents. Policy heads of one and of two layers are told apart
# below.
LAYERS = {
    "fc1": "encoder.branch.first",
    "fc1_s1": "encoder.branch.last",
    "fc1_g": "encoder.goal_branch.first",
    "fc1_t1": "encoder.goal_branch.last",
    "fc1_siamese": "encoder.state_layer",
    "fc2": "fusion.linear",
    "fc3": "scene_layer.linear",
    "policy_h": "policy.first",
    "policy": "policy.last",
    "value": "value.linear",
    "usf": "successor.linear",
    "fc1_r1": "reward.first",
    "fc1_rw": "reward.last",
}
# golden file: our model, coefficient of the successor features' loss, relative tolerance of gradient norms
MODELS = {
    "m1_gvf": ("gvf", None, 1e-5),
    "m2_usfa": ("usfa", 5e-4, 1e-5),
    "m3_sfdp": ("sfdp", 5e-3, 1e-5),
    "m4_vusfa": ("vusfa", 5e-4, 3e-4),
}


class Released(NamedTuple):
    """One released model, rebuilt: our agent with its weights, the batch it was fed, and what came out."""

    name: str
    about: dict[str, Any]
    arrays: dict[str, np.ndarray]
    agent: Agent
    batch: TensorDict


def parameter(agent: Agent, variable: dict[str, Any]) -> torch.nn.Parameter:
    """Our parameter that holds a golden variable (of all scenes, where each scene has its own)."""
    path = LAYERS[variable["layer"]]
    if path == "policy.last" and not hasattr(agent.policy, "last"):
        path = "policy.linear"
    return agent.get_parameter(f"{path}.{'weight' if variable['kind'] == 'W' else 'bias'}")


def as_golden(tensor: Tensor, variable: dict[str, Any]) -> Tensor:
    """A view of our parameter, or of anything of its shape, in the golden layout: [in, out], one scene.

    The first layer reads frames flattened as feature * H + h there; here it has a weight (out, F) a frame.
    """
    if variable["scene"] is not None:
        tensor = tensor[int(variable["scene"].removeprefix("scene_"))]
    if variable["kind"] == "b":
        return tensor
    return tensor.permute(2, 0, 1) if tensor.dim() == 3 else tensor.T


def two_scenes() -> SceneSet:
    """Scenes of as many features and actions; the agents are fed features, not states of these."""
    graph = torch.tensor([[1, -1, -1, -1], [0, -1, -1, -1]])
    return SceneSet([Scene(f"scene_{i}", graph, torch.ones(2, 1, 2048)) for i in range(2)])


def rebuild(golden: Path, name: str) -> Released:
    about = json.loads((golden / f"{name}.json").read_text())
    with np.load(golden / f"{name}.npz") as stored:
        arrays = dict(stored)
    seed, history, steps = about["seed"], about["history_length"], about["T"]
    agent = make_agent(MODELS[name][0], "reference", two_scenes(), observation="features")
    with torch.no_grad():
        for variable, total in zip(about["variables"], about["checks"]["weight_sums"], strict=True):
            bound = 1 / np.sqrt(variable["fan_in"])
            draw = np.random.default_rng([seed, variable["index"]]).uniform(-bound, bound, variable["shape"])
            assert draw.astype(np.float32).sum(dtype=np.float64) == pytest.approx(total, abs=1e-6)
            view = as_golden(parameter(agent, variable), variable)
            view.copy_(torch.from_numpy(draw.astype(np.float32)).view(view.shape))
    rng = np.random.default_rng([seed, 1000])
    s, t = (
        torch.from_numpy((abs(rng.standard_normal((steps, 2048, history))) * 0.5).astype(np.float32))
        for _ in range(2)
    )
    actions = torch.from_numpy(rng.integers(0, 4, size=steps))
    assert actions.tolist() == about["checks"]["actions"]
    advantage, value_target, successor_target = (
        torch.from_numpy(rng.standard_normal(shape).astype(np.float32))
        for shape in ((steps, 1), (steps, 1), (steps, 512))
    )
    batch = {
        "observation": s.mT,
        "goal_observation": t.mT,
        "scene_id": torch.zeros(steps, dtype=torch.int64),
        "action": actions,
        "advantage": advantage,
        "value_target": value_target,
        "successor_target": successor_target,
    }
    return Released(name, about, arrays, agent, TensorDict(batch, [steps]))


def close(ours: Tensor, theirs: np.ndarray, tolerance: float = 1e-5) -> None:
    theirs = torch.from_numpy(np.asarray(theirs, dtype=np.float64))
    torch.testing.assert_close(ours.detach().double().reshape(theirs.shape), theirs, rtol=0, atol=tolerance)


@pytest.fixture(scope="module", params=MODELS)
def released(request: pytest.FixtureRequest, golden: Path) -> Released:
    return rebuild(golden, request.param)


class TestModels:
    """m1_gvf .. m4_vusfa: forward pass, every loss term, every gradient, two steps of the optimiser."""

    @pytest.fixture
    def noise(self, released: Released, monkeypatch: pytest.MonkeyPatch) -> None:
        """The noise that the released code drew, in place of ours."""
        if released.agent.latent is not None:
            eps = torch.from_numpy(released.arrays["eps_t"])
            monkeypatch.setattr(released.agent.latent, "noise", lambda loc: eps)

    def test_every_weight_is_ours_and_none_of_ours_is_left(self, released: Released) -> None:
        variables = released.about["variables"]
        held = {id(parameter(released.agent, variable)) for variable in variables}
        assert held == {id(ours) for ours in released.agent.parameters()}
        assert sum(int(np.prod(v["shape"])) for v in variables) == sum(
            ours.numel() for ours in released.agent.parameters()
        )

    @pytest.mark.usefixtures("noise")
    def test_forward(self, released: Released) -> None:
        agent, arrays = released.agent, released.arrays
        critic = agent.get_value_operator()(released.batch.clone())
        actor = agent.get_policy_operator().get_dist_params(released.batch.clone())
        embeddings = torch.cat([critic["state_embedding"], critic["goal_embedding"]], -1)
        close(embeddings, arrays["fusion_in"])
        close(critic["state_value"], arrays["v"])
        close(actor["logits"], arrays["logits"])
        close(actor["logits"].softmax(-1), arrays["pi"])
        if agent.successor is not None:
            close(critic["successor_features"], arrays["usf"])
            close(critic["reward_weights"], arrays["omega"])
            close(critic["state_embedding"], arrays["state_rep"])
        if agent.latent is not None:
            for ours, theirs in (
                ("state_loc", "mu_s"),
                ("state_scale", "sigma_s"),
                ("goal_loc", "mu_t"),
                ("goal_scale", "sigma_t"),
            ):
                close(critic[ours], arrays[theirs])
            assert (arrays["logits_prerelu"] < 0).any()  # so that the ReLU shows
            close(actor["logits"], arrays["logits_prerelu"].clip(min=0))

    @pytest.mark.usefixtures("noise")
    def test_the_other_scenes_layers(self, released: Released) -> None:
        agent, arrays = released.agent, released.arrays
        elsewhere = released.batch.clone().set("scene_id", torch.ones_like(released.batch["scene_id"]))
        critic = agent.get_value_operator()(elsewhere)
        close(critic["state_value"], arrays["v_scene1"])
        inputs = [critic["hidden"]]
        if agent.successor is not None:
            close(critic["successor_features"], arrays["usf_scene1"])
        if hasattr(agent.policy, "first"):
            inputs.append(torch.from_numpy(arrays["usf"]))  # the golden run fed scene_0's here, too
        close(agent.policy(*inputs, elsewhere["scene_id"]).softmax(-1), arrays["pi_scene1"])

    def test_mixed_scenes_in_one_batch(self, released: Released) -> None:
        """Rows of both scenes at once give what each scene gives alone."""
        scene_id = torch.arange(len(released.batch)) % 2
        released.agent.eval()
        outputs = [
            released.agent.get_value_operator()(released.batch.clone().set("scene_id", scene))
            for scene in (scene_id, torch.zeros_like(scene_id), torch.ones_like(scene_id))
        ]
        released.agent.train()
        for key in ("hidden", "state_value"):
            mixed, first, second = (output[key] for output in outputs)
            torch.testing.assert_close(mixed, torch.where(scene_id.unsqueeze(-1) == 0, first, second))

    def losses(self, released: Released) -> list[LossModule]:
        """Our losses for the model, with the coefficients that make them sums over T steps."""
        steps, (_, successor_coeff, _) = released.about["T"], MODELS[released.name]
        networks = released.agent.get_policy_operator(), released.agent.get_value_operator()
        usf = USFLoss(
            *networks,
            objective_coeff=steps,
            entropy_coeff=0.01 * steps,
            critic_coeff=0.25 * steps,
            successor_coeff=successor_coeff,
            bottleneck_coeff=released.about["beta"] if released.agent.latent is not None else None,
        )
        if released.name != "m1_gvf":
            return [usf]
        return [
            usf,
            A2CLoss(*networks, entropy_coeff=0.01, critic_coeff=0.25, loss_critic_type="l2", reduction="sum"),
        ]

    @pytest.mark.usefixtures("noise")
    def test_every_term_of_the_loss(self, released: Released) -> None:
        arrays = released.arrays
        for loss in self.losses(released):
            terms = loss(released.batch.clone())
            close(terms["loss_objective"] + terms["loss_entropy"], arrays["policy_loss"])
            close(terms["loss_critic"], arrays["value_loss"])
            log_prob = (
                released.agent.get_policy_operator()
                .get_dist(released.batch.clone())
                .log_prob(released.batch["action"])
            )
            close(log_prob * released.batch["advantage"][:, 0], arrays["logpi_a_td"])
            close(-terms["loss_objective"], arrays["logpi_a_td"].sum())
            close(-terms["loss_entropy"] / 0.01, arrays["entropy"].sum())
            if "sr_loss" in arrays:
                close(terms["loss_successor"], arrays["sr_loss"], 1e-8)
                close(terms["loss_successor"] / MODELS[released.name][1], arrays["sr_mse"])
            if "kl_mean" in arrays:
                close(terms["kl"], arrays["kl_mean"])
                close(terms["kl"] - 0.2, arrays["bottle_neck"])
                close(terms["loss_bottleneck"], arrays["beta_term"])
            total = sum(value for key, value in terms.items() if key.startswith("loss"))
            close(total, arrays["total_loss"])
            assert ("sr_loss" in arrays) == ("loss_successor" in sorted(terms.keys()))
            assert ("kl_mean" in arrays) == ("loss_bottleneck" in sorted(terms.keys()))

    def test_every_step_of_the_multiplier(self, golden: Path) -> None:
        with np.load(golden / "m4_vusfa.npz") as stored:
            cases = torch.from_numpy(stored["beta_update_cases"])
        for old, violation, new in cases:
            torch.testing.assert_close(dual_ascent(old, violation, 1e-6), new, rtol=1e-6, atol=1e-12)

    @pytest.mark.usefixtures("noise")
    def test_every_gradient_and_two_steps_of_the_optimiser(self, released: Released) -> None:
        agent, variables = released.agent, released.about["variables"]
        for loss in self.losses(released):
            before = {name: weight.detach().clone() for name, weight in agent.named_parameters()}
            agent.zero_grad()
            terms = loss(released.batch.clone())
            sum(value for key, value in terms.items() if key.startswith("loss")).backward()
            self.compare_gradients(released)
            rule = released.about["optimiser"]
            optimiser = TFRMSprop(
                agent.parameters(),
                lr=rule["lr"],
                alpha=rule["decay"],
                eps=rule["epsilon"],
                initial_accumulator=rule["rms_init"],
                max_grad_norm=rule["clip_norm_per_variable"],
            )
            for step in (1, 2):
                previous = [parameter(agent, v).detach().clone() for v in variables]
                optimiser.step()
                self.compare_step(released, optimiser, previous, f"step{step}")
            agent.load_state_dict(before)

    def compare_gradients(self, released: Released) -> None:
        arrays, seed = released.arrays, released.about["seed"]
        tolerance = MODELS[released.name][2]
        for variable in released.about["variables"]:
            index = variable["index"]
            gradient = as_golden(parameter(released.agent, variable).grad, variable).reshape(
                variable["shape"]
            )
            if not arrays["grad_present"][index]:
                assert not gradient.any(), variable["name"]
                continue
            gradient = gradient.double()
            norm = arrays["grad_l2"][index]
            assert gradient.norm().item() == pytest.approx(norm, rel=tolerance), variable["name"]
            # sums of up to 4 million float32 numbers, most of which cancel
            total = pytest.approx(arrays["grad_sum"][index], abs=3e-3, rel=tolerance)
            assert gradient.sum().item() == total, variable["name"]
            direction = np.random.default_rng([seed, 2000 + index]).standard_normal(variable["shape"])
            along = (gradient * torch.from_numpy(direction)).sum().item()
            assert along == pytest.approx(arrays["grad_proj"][index], abs=10 * tolerance * norm), variable[
                "name"
            ]
            first = arrays["grad_first16"][index]
            close(gradient.flatten()[:16], first[~np.isnan(first)], 2e-6)

    def compare_step(
        self, released: Released, optimiser: TFRMSprop, previous: list[Tensor], step: str
    ) -> None:
        arrays = released.arrays
        for variable, old in zip(released.about["variables"], previous, strict=True):
            index, ours = variable["index"], parameter(released.agent, variable)
            delta = as_golden(ours.detach() - old, variable).reshape(variable["shape"]).flatten()
            if not arrays["grad_present"][index]:
                assert not delta.any(), variable["name"]  # the other scene's weights stay bit for bit
                continue
            first = arrays[f"{step}_delta_first16"][index]
            close(delta[:16], first[~np.isnan(first)], 2.4e-7)
            size = len(delta) ** 0.5
            # a variable moves by whole float32 units, and there are as many of them as elements
            close(delta.double().norm(), arrays[f"{step}_update_l2"][index], 1.2e-7 * size + 1e-7)
            accumulator = as_golden(optimiser.state[ours]["square_avg"], variable)
            accumulator = accumulator.reshape(variable["shape"]).flatten()
            first = arrays[f"{step}_rms_first16"][index]
            close(accumulator[:16], first[~np.isnan(first)], 2e-7)
            close(accumulator.double().norm(), arrays[f"{step}_rms_l2"][index], 2e-7 * size)


class TestReturns:
    """golden_returns: R, R - V and psi's return of 20 stretches, as the released threads computed them."""

    @pytest.fixture
    def cases(self, golden: Path) -> list[dict[str, Any]]:
        about = json.loads((golden / "golden_returns.json").read_text())
        with np.load(golden / "golden_returns.npz") as stored:
            arrays = dict(stored)
        cases = []
        for case in about["cases"]:
            prefix = f"c{case['case']:02d}_"
            stretch = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
            cases.append({**case, "gamma": about["gamma"], "arrays": stretch})
        assert {case["terminal"] for case in cases} == {True, False}
        return cases

    def test_every_stretch(self, cases: list[dict[str, Any]]) -> None:
        """A critic that looks its outputs up: states are numbers, the last one bootstraps."""
        for case in cases:
            arrays, steps = case["arrays"], case["length"]
            tables = {
                "state_value": np.append(arrays["values"], arrays["bootstrap_v"])[:, None],
                # psi of the states in between, and phi of the first, have no part in it
                "successor_features": np.concatenate(
                    [np.full_like(arrays["phi_next"], np.nan), arrays["bootstrap_usf"][None]]
                ),
                "state_embedding": np.concatenate(
                    [np.full_like(arrays["phi_next"][:1], np.nan), arrays["phi_next"]]
                ),
            }
            critic = TensorDictModule(
                lambda state, tables=tables: tuple(
                    torch.from_numpy(t).float()[state] for t in tables.values()
                ),
                in_keys=["state"],
                out_keys=list(tables),
            )
            states, done = torch.arange(steps + 1), torch.zeros(steps, 1, dtype=torch.bool)
            done[-1] = case["terminal"]
            following = {"state": states[1:], "reward": torch.from_numpy(arrays["rewards"]).float()[:, None]}
            following |= {"done": done, "terminated": done}
            stretch = TensorDict({"state": states[:-1], "next": following}, [steps])
            estimator = USFEstimator(value_network=critic, gamma=case["gamma"])
            targets = estimator(stretch.clone())
            close(targets["value_target"], arrays["R"])
            close(targets["advantage"], arrays["td"])
            close(targets["value_target"], arrays["R_f64"])
            if "usf_R" in arrays:
                close(targets["successor_target"], arrays["usf_R"])

    def test_a_time_limit_is_a_terminal_to_the_released_code(self, golden: Path) -> None:
        about = json.loads((golden / "golden_returns.json").read_text())
        expected = about["time_limit_last_segment_r_time_order"]
        steps = len(expected)
        critic = TensorDictModule(
            lambda state: torch.full_like(state, 5.0), in_keys=["state"], out_keys=["state_value"]
        )
        cut = torch.zeros(steps, 1, dtype=torch.bool)
        cut[-1] = True
        following = {
            "state": torch.zeros(steps, 1),
            "reward": torch.full((steps, 1), -0.01),
            "done": cut,
            "terminated": torch.zeros_like(cut),
        }
        segment = TensorDict({"state": torch.zeros(steps, 1), "next": following}, [steps])
        estimator = USFEstimator(value_network=critic, gamma=about["gamma"], bootstrap_at_timeout=False)
        close(estimator(segment)["value_target"], np.array(expected))


class TestOptimiser:
    """golden_optim: six steps of five variables, with clipping, a zero gradient and a rate of zero."""

    @pytest.mark.parametrize("path", ["_update_one_by_one", "_update_foreach"])
    def test_every_step(self, golden: Path, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
        monkeypatch.setattr(optim, "_update_one_by_one", getattr(optim, path))
        about = json.loads((golden / "golden_optim.json").read_text())
        with np.load(golden / "golden_optim.npz") as stored:
            arrays = dict(stored)
        seed, shapes = about["seed"], about["shapes"]
        variables = [
            torch.nn.Parameter(
                torch.from_numpy(
                    np.random.default_rng([seed, 5000, j]).uniform(-1, 1, shape).astype(np.float32)
                )
            )
            for j, shape in enumerate(shapes)
        ]
        optimiser = TFRMSprop(
            variables,
            alpha=about["decay"],
            eps=about["epsilon"],
            max_grad_norm=about["clip_norm"],
        )
        clipped = 0
        for step, lr in enumerate(about["lrs"]):
            for j, (variable, scale) in enumerate(zip(variables, about["grad_scales"], strict=True)):
                draw = np.random.default_rng([seed, 5001, step, j]).standard_normal(shapes[j]) * scale
                variable.grad = torch.from_numpy(draw.astype(np.float32))
                norm = about["gradient_norms"][step][j]
                assert variable.grad.norm().item() == pytest.approx(norm, rel=1e-5)
                clipped += norm > about["clip_norm"]
            optimiser.param_groups[0]["lr"] = lr
            optimiser.step()
            for j, variable in enumerate(variables):
                close(variable, arrays[f"var_{step + 1}_v{j}"], 1e-6)
                accumulator = arrays[f"rms_{step + 1}_v{j}"]
                ours = optimiser.state[variable]["square_avg"]
                np.testing.assert_allclose(ours.numpy(), accumulator, rtol=2e-6)
        assert clipped > 0


class TestMultiplier:
    """m4_vusfa's beta_update_cases: the multiplier as the object that training steps."""

    def test_every_case(self, golden: Path) -> None:
        with np.load(golden / "m4_vusfa.npz") as stored:
            cases = stored["beta_update_cases"]
        agent = make_agent("vusfa", "reference", two_scenes(), observation="features")
        loss = USFLoss(agent.get_policy_operator(), agent.get_value_operator())
        multiplier = DualAscent(loss, step_size=1e-6)
        for old, violation, new in cases.tolist():
            loss.bottleneck_coeff = old
            loss.last_kl.copy_(loss.information_target + violation)
            multiplier.step()
            # the violation is a difference of float32 numbers here
            assert loss.bottleneck_coeff.item() == pytest.approx(
                new, rel=1e-6, abs=1e-6 * 1e-6 * (1 + abs(violation))
            )
