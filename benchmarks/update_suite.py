"""Complete training updates (collect, returns, loss, backward, step): by default with one frame and with
four, and with the paper's preset.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from benchmarks.peers.bare_update import BareTraining
from benchmarks.peers.feature_fed import feature_fed
from benchmarks.peers.sb3 import make_sb3
from benchmarks.report import Options, Report, Requirement, Row
from benchmarks.timing import Timing, Work, interleaved, ratio
from benchmarks.trainer import Running, running, small

__all__ = ["RELEASED", "run"]

#: Frames per second of the released code: folder 6, 20 threads, TensorFlow's compatibility mode, two cores.
RELEASED = 162.0
#: Required speed relative to that, by the frames of the history.
BOUNDS = {1: 100.0, 4: 60.0}
#: The same with the paper's preset: 10 million frames in an hour.
PAPER = 17.0


def run(options: Options) -> Report:
    """Ours as ``recipes/train.py`` does it by default, and four peers."""
    report = Report("update")
    for history in (1, 4):
        with ExitStack() as stack:
            timings = interleaved(_works(history, options, stack), options.repetitions, options.seconds)
        _add(report, history, options.threads, timings)
    with ExitStack() as stack:
        timings = interleaved(_paper_works(options, stack), options.repetitions, options.seconds)
    _add_paper(report, options.threads, timings)
    return report


def _paper_works(options: Options, stack: ExitStack) -> dict[str, Work]:
    """VUSFA as the paper has it: 100 environments of 5 steps, layers of 512, four frames, A3C's step."""
    changed = small(options)
    if options.quick:
        changed = [*changed, "collector.num_envs=10"]  # one per goal
    ours = stack.enter_context(running(["preset=paper", "agent.model=vusfa", *changed]))
    bare = BareTraining(ours.trainer)
    works = {"ours": Work(ours.update, options.threads), "bare update": Work(bare.update, options.threads)}
    return works | {"ours, 1 thread": Work(ours.update), "bare update, 1 thread": Work(bare.update)}


def _works(history: int, options: Options, stack: ExitStack) -> dict[str, Work]:
    overrides = ["agent.model=vusfa", f"agent.history={history}", *small(options)]
    ours = stack.enter_context(running(overrides))
    fed = stack.enter_context(feature_fed(overrides))
    bare = BareTraining(ours.trainer)
    calls = {"ours": ours.update, "bare update": bare.update, "features": fed.update}
    works = {name: Work(call, options.threads) for name, call in calls.items()}
    works["ours, 1 thread"] = Work(ours.update)
    works["bare update, 1 thread"] = Work(bare.update)
    # as many environments and steps as ours, and SB3's own five steps; the faster of the two counts
    for steps in sorted({5, ours.trainer.settings["collector"]["rollout"]}):
        works[f"SB3 A2C, {steps} steps"] = Work(_sb3_update(ours, history, steps), options.threads)
    return works


def _sb3_update(ours: Running, history: int, steps: int) -> Callable[[], int]:
    trainer = ours.trainer
    num_envs, width = trainer.settings["collector"]["num_envs"], trainer.agent.config["hidden_size"]
    scenes, goals = trainer.scenes, trainer.goals
    model = make_sb3("A2C", scenes, goals, num_envs=num_envs, width=width, history=history, n_steps=steps)

    def update() -> int:
        before = model.num_timesteps
        model.learn(num_envs * steps, reset_num_timesteps=before == 0)
        return model.num_timesteps - before

    return update


def _add_paper(report: Report, threads: int, timings: dict[str, Timing]) -> None:
    label, ours, bare = "updates, preset=paper", timings["ours"], timings["bare update"]
    report.rows.append(_released_row(label, ours))
    report.rows.append(_row(label, ours, "bare update", bare))
    report.rows.append(_row(f"{label}, bare update", bare))
    alone, bare_alone = timings["ours, 1 thread"], timings["bare update, 1 thread"]
    report.rows.append(_row(f"{label}, 1 thread", alone, "bare update, 1 thread", bare_alone))
    what = f"VUSFA update, preset=paper, {threads} threads, "
    value = ours.per_second / RELEASED
    report.requirements.append(Requirement(what + "times the released code", value, PAPER, "times"))
    share = what + "share of the bare update's speed"
    report.requirements.append(Requirement(share, ratio(ours, bare), 0.8, "times"))


def _add(report: Report, history: int, threads: int, timings: dict[str, Timing]) -> None:
    frames = "1 frame" if history == 1 else f"{history} frames"
    label, ours = f"updates, {frames}", timings["ours"]
    rate = ours.per_second
    report.rows.append(_released_row(label, ours))
    for name, timing in timings.items():
        if name.startswith("ours"):
            continue
        mine = timings["ours, 1 thread"] if "1 thread" in name else ours
        report.rows.append(_row(label + (", 1 thread" if "1 thread" in name else ""), mine, name, timing))
        report.rows.append(_row(f"{label}, {name}", timing))
    sb3 = max((t for name, t in timings.items() if name.startswith("SB3")), key=lambda t: t.per_second)
    for text, value, bound in (
        ("times the released code", rate / RELEASED, BOUNDS[history]),
        ("times SB3's A2C", ratio(ours, sb3), 5.0),
        ("times the feature-fed pipeline", ratio(ours, timings["features"]), 3.0),
        ("share of the bare update's speed", ratio(ours, timings["bare update"]), 0.8),
    ):
        what = f"VUSFA update, {frames}, {threads} threads, {text}"
        report.requirements.append(Requirement(what, value, bound, "times"))


def _released_row(name: str, timing: Timing) -> Row:
    rate = timing.per_second
    note = f"{RELEASED:.0f} frames/s: folder 6, 20 threads, TensorFlow's compatibility mode, two cores"
    return Row(name, rate, "frames/s", "the released code", rate / RELEASED, note, tuple(timing.rates))


def _row(name: str, timing: Timing, peer: str = "", other: Timing | None = None) -> Row:
    times = None if other is None else ratio(timing, other)
    return Row(name, timing.per_second, "frames/s", peer, times, samples=tuple(timing.rates))
