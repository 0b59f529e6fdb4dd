"""Zero-shot evaluation of every state as a goal, ten episodes each, beside one at a time."""

from __future__ import annotations

import time

import torch

from benchmarks.report import Options, Report, Requirement, Row
from vusfa.envs import resolve_goals
from vusfa.evaluation import evaluate
from vusfa.modules import ActingPolicy, make_agent
from vusfa.scenes import SceneSet

__all__ = ["run"]

MINUTES = 2.0


def run(options: Options) -> Report:
    """An untrained VUSFA agent, which wanders for most of the 500 steps: a trained one takes less time."""
    scenes = SceneSet.bundled(["bathroom"] if options.quick else None)
    size = 16 if options.quick else 512
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    agent = make_agent("vusfa", scenes=scenes, hidden_size=size, embedding_size=size)
    actor = ActingPolicy(agent)
    goals = resolve_goals(scenes, "all")
    each, limit = (1, 10) if options.quick else (10, 500)
    chosen = goals[:8] if options.quick else goals

    def seconds(some: torch.Tensor, batch: int, episodes: int) -> float:
        began = time.perf_counter()
        evaluate(actor, scenes, some, episodes_per_goal=episodes, max_steps=limit, batch_size=batch)
        return time.perf_counter() - began

    seconds(goals[:2], 16, 1)  # unmeasured
    sample = goals[:: max(1, len(goals) // 8)][:8]
    alone = seconds(sample, 1, 1) / len(sample) * len(chosen) * each
    whole = seconds(chosen, 4096, each)
    again = seconds(sample, 1, 1) / len(sample) * len(chosen) * each
    alone = (alone + again) / 2
    label = f"zero-shot evaluation, {len(chosen):,} goals, {each} episodes each"
    note = f"of {len(sample)} episodes before and {len(sample)} after, scaled to all"
    report = Report("eval")
    untrained = "an untrained agent, which needs most of the steps; a trained one is quicker"
    report.rows.append(Row(label, whole, "s", "one episode at a time", alone / whole, untrained))
    report.rows.append(Row(f"{label}, one episode at a time", alone, "s", note=note))
    report.requirements.append(Requirement(label, whole / 60, MINUTES, "minutes", at_least=False))
    return report
