"""Time to solve: seconds of training until the four rooms' trained goals are reached, well and nearly always.

Solved means: over fresh episodes to the trained goals at least 95 % succeed, and the successful ones take at
most 1.5 times as many actions in all as their shortest paths (a ratio of means). Training is checked at
intervals; the time of these evaluations is left out, for us and for the peers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from benchmarks.peers.sb3 import make_sb3, sb3_actions
from benchmarks.report import Options, Report, Requirement, Row, number
from benchmarks.trainer import running, small
from vusfa.evaluation import evaluate
from vusfa.evaluation.metrics import get_metric
from vusfa.modules.config import MODELS
from vusfa.scenes import SceneSet

__all__ = ["PEERS", "Outcome", "checker", "is_solved", "run", "solve_row", "train_until"]

#: Settings of SB3's algorithms: those of ours that they know (steps, advantages, Adam, entropy as our mean),
#: and for PPO a few passes over each rollout.
PEERS: dict[str, dict[str, Any]] = {
    "A2C": {
        "n_steps": 50,
        "learning_rate": 1e-3,
        "ent_coef": 0.005,
        "use_rms_prop": False,
        "normalize_advantage": True,
    },
    "PPO": {"n_steps": 64, "batch_size": 1024, "n_epochs": 4, "learning_rate": 5e-4, "ent_coef": 0.005},
}
SUCCESS, DETOUR = 0.95, 1.5
MINUTES = 15


class Outcome(NamedTuple):
    """Outcome of a training.

    Attributes:
        seconds: of training until solved; NaN when it was not.
        spent: seconds of training in all.
        frames: frames of training.
        success, detour: values at the last check.
    """

    seconds: float
    spent: float
    frames: int
    success: float
    detour: float


def is_solved(success: float, detour: float) -> bool:
    """Whether the task counts as solved.

    >>> is_solved(0.96, 1.4), is_solved(0.96, 1.6), is_solved(0.9, math.nan)
    (True, False, False)
    """
    return success >= SUCCESS and detour <= DETOUR


def train_until(
    update: Callable[[], int],
    check: Callable[[], tuple[float, float]],
    cap: float,
    every: float,
    most_frames: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> Outcome:
    """Train until a check is passed, the cap is reached, or the schedule has ended.

    Args:
        update: trains a little; returns frames.
        check: success and length over shortest path now; its time does not count.
        cap: limit of seconds of training.
        every: seconds of training between checks.
        most_frames: where the training's schedule ends.
        clock: returns seconds.

    >>> ticks = iter(range(100))
    >>> outcome = train_until(lambda: 8, lambda: (1.0, 1.0), cap=9, every=2, clock=lambda: next(ticks))
    >>> outcome.seconds, outcome.frames
    (2.0, 16)
    """
    spent, checked, frames = 0.0, 0.0, 0
    while True:
        began = clock()
        frames += update()
        spent += clock() - began
        over = spent >= cap or frames >= most_frames
        if spent - checked >= every or over:
            success, detour = check()
            checked = spent
            if is_solved(success, detour):
                return Outcome(spent, spent, frames, success, detour)
            if over:
                return Outcome(math.nan, spent, frames, success, detour)


def run(options: Options) -> Report:
    """The four models with the recipe's settings, then SB3's two."""
    report = Report("solve")
    cap, every = (0.5, 0.5) if options.quick else (options.cap, 2.0)
    torch.set_num_threads(options.threads)
    outcomes: dict[str, Outcome] = {}
    for model in MODELS:
        with running([f"agent.model={model}", *small(options)]) as ours:
            trainer = ours.trainer
            history = trainer.agent.config["history"]
            check = checker(trainer.actor, trainer.scenes, trainer.goals, history, options)
            frames = trainer.settings["total_frames"]
            outcomes[model] = train_until(ours.update, check, cap, every, frames)
    peers: dict[str, Outcome] = {}
    for name, settings in PEERS.items():
        num_envs = trainer.settings["collector"]["num_envs"]
        model_ = make_sb3(
            name,
            trainer.scenes,
            trainer.goals,
            num_envs=num_envs,
            width=trainer.agent.config["hidden_size"],
            history=history,
            **settings,
        )
        peers[f"SB3 {name}"] = train_until(
            _learner(model_, num_envs * settings["n_steps"]),
            checker(_policy(model_), trainer.scenes, trainer.goals, history, options),
            cap,
            every,
        )
    best = min(peers.values(), key=lambda o: math.inf if math.isnan(o.seconds) else o.seconds)
    limit = best.spent if math.isnan(best.seconds) else best.seconds
    for name, outcome in outcomes.items():
        times = None if math.isnan(outcome.seconds) else limit / outcome.seconds
        report.rows.append(solve_row(name, outcome, "SB3's best", times))
        what = f"{name}: time to solve the four rooms"
        report.requirements.append(
            Requirement(what, outcome.seconds / 60, MINUTES, "minutes", at_least=False)
        )
        share = outcome.seconds / limit
        report.requirements.append(
            Requirement(f"{what}, share of SB3's best", share, 0.2, "times", at_least=False)
        )
    report.rows += [solve_row(name, outcome) for name, outcome in peers.items()]
    return report


def solve_row(name: str, outcome: Outcome, peer: str = "", times: float | None = None) -> Row:
    """The row of a training that :func:`train_until` ran."""
    note = (
        f"success {number(100 * outcome.success)} %, length {number(outcome.detour)} times the shortest path"
    )
    if math.isnan(outcome.seconds):
        note = f"not solved after {number(outcome.spent)} s and {outcome.frames:,} frames: {note}"
    else:
        note = f"{outcome.frames:,} frames; {note}; time of evaluations not counted"
    return Row(f"time to solve, {name}", outcome.seconds, "s", peer, times, note)


def checker(
    policy: TensorDictModuleBase, scenes: SceneSet, goals: torch.Tensor, history: int, options: Options
) -> Callable[[], tuple[float, float]]:
    """A check of a policy for :func:`train_until`: fifty episodes to each goal, actions sampled."""
    episodes, limit = (2, 20) if options.quick else (50, 500)

    def check() -> tuple[float, float]:
        table = evaluate(policy, scenes, goals, episodes_per_goal=episodes, max_steps=limit, history=history)
        detour = get_metric("length_ratio").value(table)
        return get_metric(f"success_{limit}").value(table), detour

    return check


def _policy(model: Any) -> TensorDictModule:
    def act(state: torch.Tensor, goal: torch.Tensor, scene: torch.Tensor) -> torch.Tensor:
        return sb3_actions(model, {"state_id": state, "goal_id": goal, "scene_id": scene})

    return TensorDictModule(act, in_keys=["state_id", "goal_id", "scene_id"], out_keys=["action"])


def _learner(model: Any, frames: int) -> Callable[[], int]:
    def learn() -> int:
        before = model.num_timesteps
        model.learn(frames, reset_num_timesteps=before == 0)
        return model.num_timesteps - before

    return learn
