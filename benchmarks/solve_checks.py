"""Checks of a policy during a training: success to the trained goals, and length over shortest path.

With one frame both are expectations over all starts, computed exactly (:mod:`vusfa.evaluation.exact`) in a
fraction of a second, for our agents and for the peers alike. With several frames they are means over
sampled episodes, which an unlearned policy makes long.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from benchmarks.peers.sb3 import sb3_actions, sb3_probabilities
from benchmarks.report import Options
from vusfa.evaluation import evaluate
from vusfa.evaluation.exact import Probabilities, expected_walks
from vusfa.evaluation.metrics import get_metric
from vusfa.evaluation.navigation import acting
from vusfa.modules import TabularPolicy
from vusfa.scenes import SceneSet
from vusfa.training import Trainer

__all__ = ["Check", "check_of_sb3", "check_of_trainer"]

#: Success, and length of the successful walks over their shortest paths.
Check = Callable[[], tuple[float, float]]
#: Episodes to each goal, and actions of an episode.
EPISODES, ACTIONS = 25, 500


def check_of_trainer(trainer: Trainer, options: Options) -> Check:
    """A check of our agent as it then is, on its own device.

    Args:
        trainer: whose goals are walked to.
        options: with ``quick``, few and short episodes.
    """
    agent, device = trainer.agent, trainer.settings["device"]
    scenes, goals = trainer.scenes.to(device), trainer.goals.to(device)

    def table() -> Probabilities:
        with acting(agent, scenes):
            found = TabularPolicy(agent, scenes, goals)
        return lambda *ids: found.probabilities(*(x.to(device) for x in ids)).cpu()

    if agent.is_tabular:
        return _exact(table, scenes, goals, options)
    return _sampled(trainer.actor, scenes, goals, agent.config["history"], options)


def check_of_sb3(model: Any, scenes: SceneSet, goals: Tensor, history: int, options: Options) -> Check:
    """A check of a model of :func:`benchmarks.peers.sb3.make_sb3` as it then is."""
    if history == 1:
        return _exact(lambda: lambda *ids: sb3_probabilities(model, *ids), scenes, goals, options)

    def act(state: Tensor, goal: Tensor, scene: Tensor) -> Tensor:
        return sb3_actions(model, {"state_id": state, "goal_id": goal, "scene_id": scene})

    policy = TensorDictModule(act, in_keys=["state_id", "goal_id", "scene_id"], out_keys=["action"])
    return _sampled(policy, scenes, goals, history, options)


def _exact(table: Callable[[], Probabilities], scenes: SceneSet, goals: Tensor, options: Options) -> Check:
    here, ids = scenes.to("cpu"), goals.cpu()

    def check() -> tuple[float, float]:
        walks = expected_walks(table(), here, ids, 20 if options.quick else ACTIONS)
        return walks.success.mean().item(), walks.length_ratio

    return check


def _sampled(
    policy: TensorDictModuleBase, scenes: SceneSet, goals: Tensor, history: int, options: Options
) -> Check:
    episodes, limit = (2, 20) if options.quick else (EPISODES, ACTIONS)

    def check() -> tuple[float, float]:
        walked = evaluate(policy, scenes, goals, episodes_per_goal=episodes, max_steps=limit, history=history)
        return get_metric(f"success_{limit}").value(walked), get_metric("length_ratio").value(walked)

    return check
