"""Time to solve: seconds of training until the four rooms' trained goals are reached, well and nearly always.

Solved means: to the trained goals success is at least 95 %, and the successful walks take at most 1.5 times
as many actions in all as their shortest paths (a ratio of means). Training is checked at intervals
(:mod:`benchmarks.solve_checks`). The seconds that are reported are those of training, without the checks,
for us and for the peers; the cap is one of all seconds, checks included, for each training.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import torch

from benchmarks.peers.sb3 import make_sb3
from benchmarks.report import Options, Report, Requirement, Row, counted, number
from benchmarks.solve_checks import Check, check_of_sb3, check_of_trainer
from benchmarks.trainer import recipe_settings, running, small
from vusfa.envs import resolve_goals
from vusfa.files import say
from vusfa.modules.config import MODELS
from vusfa.scenes import SceneSet

__all__ = ["PEERS", "Outcome", "estimate", "is_solved", "make_report", "run", "solve_row", "train_until"]

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
#: Seconds between lines of progress, and those that a training takes to begin.
TELL, BEGIN = 10.0, 5.0


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
    check: Check,
    cap: float,
    every: float,
    most_frames: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
    tell: Callable[[Outcome], None] = lambda outcome: None,
) -> Outcome:
    """Train until a check is passed, the cap is reached, or the schedule has ended.

    Args:
        update: trains a little; returns frames.
        check: success and length over shortest path now. The last one begins early enough to end at the cap,
            if it takes as long as the one before it.
        cap: limit of seconds, training and checks together.
        every: seconds of training between checks, or as many as the last check took if these are more.
        most_frames: where the training's schedule ends.
        clock: returns seconds.
        tell: gets the outcome so far after every check.

    >>> ticks = iter(range(100))
    >>> outcome = train_until(lambda: 8, lambda: (1.0, 1.0), cap=9, every=2, clock=lambda: next(ticks))
    >>> outcome.seconds, outcome.frames
    (2.0, 16)
    """
    began, spent, checked, took, frames = clock(), 0.0, 0.0, 0.0, 0
    while True:
        start = clock()
        frames += update()
        now = clock()
        spent += now - start
        over = now - began + took >= cap or frames >= most_frames
        if spent - checked >= max(every, took) or over:
            success, detour = check()
            end = clock()
            checked, took = spent, end - now
            over = over or end - began + took >= cap  # another check would end after it
            solved = is_solved(success, detour)
            outcome = Outcome(spent if solved else math.nan, spent, frames, success, detour)
            tell(outcome)
            if solved or over:
                return outcome


def estimate(trainings: int, repetitions: int, cap: float) -> str:
    """The line that says how long the suite may take.

    >>> estimate(6, 2, 55)
    'solve: 6 trainings, 2 repetitions, at most 55 s each (--cap): 12 minutes at most'
    """
    most = math.ceil(trainings * repetitions * (cap + BEGIN) / 60)
    return (
        f"solve: {counted(trainings, 'training')}, {counted(repetitions, 'repetition')}, at most {cap:g} s"
        f" each (--cap): {counted(most, 'minute')} at most"
    )


def run(options: Options, keep: Callable[[Report], None] = lambda report: None) -> Report:
    """SB3's two, then the four models with the recipe's settings; each repetition has another seed.

    Args:
        options: of the measurement.
        keep: gets the report so far after every training.
    """
    cap, every = (0.5, 0.5) if options.quick else (options.cap, 2.0)
    torch.set_num_threads(options.threads)
    peers, ours = {f"SB3 {name}": name for name in PEERS}, list(MODELS)
    say(estimate(len(peers) + len(ours), options.repetitions, cap))
    outcomes: dict[str, list[Outcome]] = {name: [] for name in [*peers, *ours]}
    for seed in range(options.repetitions):
        for name in outcomes:
            begin = _sb3(peers[name], seed, options) if name in peers else _own(name, seed, options)
            with begin as (update, check, frames):
                tell = _teller(f"{name}, seed {seed}", cap)
                outcome = train_until(update, check, cap, every, frames, tell=tell)
            end = "not solved" if math.isnan(outcome.seconds) else "solved"
            say(
                f"{name}, seed {seed}: {end} after {number(outcome.spent)} s of training, {_reached(outcome)}"
            )
            outcomes[name].append(outcome)
            keep(make_report(outcomes))
    return make_report(outcomes)


@contextmanager
def _own(model: str, seed: int, options: Options) -> Iterator[tuple[Callable[[], int], Check, float]]:
    with running([f"agent.model={model}", f"seed={seed}", *small(options)]) as ours:
        yield ours.update, check_of_trainer(ours.trainer, options), ours.trainer.settings["total_frames"]


@contextmanager
def _sb3(algorithm: str, seed: int, options: Options) -> Iterator[tuple[Callable[[], int], Check, float]]:
    """An algorithm of SB3 on the task of :func:`_own`."""
    recipe, settings = recipe_settings(small(options)), PEERS[algorithm]
    scenes = SceneSet.open(list(recipe.scenes))
    goals, num_envs = resolve_goals(scenes, recipe.env.goals), recipe.collector.num_envs
    sizes = {"num_envs": num_envs, "width": recipe.agent.hidden_size, "history": recipe.agent.history}
    model = make_sb3(algorithm, scenes, goals, seed=seed, **sizes, **settings)
    check = check_of_sb3(model, scenes, goals, recipe.agent.history, options)
    yield partial(_learn, model, num_envs * settings["n_steps"]), check, math.inf
    model.get_env().close()


def _learn(model: Any, frames: int) -> int:
    before = model.num_timesteps
    model.learn(frames, reset_num_timesteps=before == 0)
    return model.num_timesteps - before


def _teller(name: str, cap: float) -> Callable[[Outcome], None]:
    """Prints a line about a training every :data:`TELL` seconds."""
    began = last = time.perf_counter()

    def tell(outcome: Outcome) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last >= TELL:
            last = now
            say(f"{name}: {now - began:.0f} of at most {cap:g} s, {_reached(outcome)}")

    return tell


def _reached(outcome: Outcome) -> str:
    return (
        f"{outcome.frames:,} frames: success {number(100 * outcome.success)} %, length"
        f" {number(outcome.detour)} times the shortest path"
    )


def make_report(outcomes: Mapping[str, list[Outcome]]) -> Report:
    """The report of all trainings that have ended, by the name of a model or a peer; the median over
    repetitions, where one that was not solved counts as longer than any."""
    report = Report("solve")
    done = {name: found for name, found in outcomes.items() if found}
    peers = [found for name, found in done.items() if name not in MODELS]
    # a peer that has not solved the task gets the time that it has spent
    limits = [min(_at_least(o) for o in turn) for turn in zip(*peers, strict=False)]
    for name in [*(n for n in done if n in MODELS), *(n for n in done if n not in MODELS)]:
        turns = done[name]
        if name not in MODELS:
            report.rows.append(solve_row(name, turns))
            continue
        shares = [o.seconds / limit for o, limit in zip(turns, limits, strict=False)]
        share = _median(shares) if shares else math.nan
        times = None if math.isnan(share) else 1 / share
        report.rows.append(solve_row(name, turns, "SB3's best", times))
        what = f"{name}: time to solve the four rooms"
        minutes = _median([o.seconds for o in turns]) / 60
        report.requirements += [
            Requirement(what, minutes, MINUTES, "minutes", at_least=False),
            Requirement(f"{what}, share of SB3's best", share, 0.2, "times", at_least=False),
        ]
    return report


def _at_least(outcome: Outcome) -> float:
    return outcome.spent if math.isnan(outcome.seconds) else outcome.seconds


def _median(values: list[float]) -> float:
    """Median, NaN being the largest; the upper of the middle two."""
    return sorted(values, key=lambda v: math.inf if math.isnan(v) else v)[len(values) // 2]


def solve_row(name: str, turns: list[Outcome], peer: str = "", times: float | None = None) -> Row:
    """The row of trainings that :func:`train_until` ran, one per repetition."""
    solved = [o for o in turns if not math.isnan(o.seconds)]
    seconds = _median([o.seconds for o in turns])
    notes = [f"{len(solved)} of {len(turns)} solved"]
    notes += [f"not solved after {number(o.spent)} s and {_reached(o)}" for o in turns if o not in solved]
    if solved:
        notes.append(f"{statistics.median_low(o.frames for o in solved):,} frames where solved")
    notes.append("time of checks not counted")
    samples = tuple(o.seconds for o in turns)
    return Row(f"time to solve, {name}", seconds, "s", peer, times, "; ".join(notes), samples)
