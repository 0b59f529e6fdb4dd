"""Zero-shot evaluation of every state as a goal, ten episodes each, beside one episode at a time."""

from __future__ import annotations

import time

import torch

from benchmarks.report import Options, Report, Requirement, Row, counted
from benchmarks.trainer import recipe_settings
from vusfa.envs import resolve_goals
from vusfa.evaluation import evaluate
from vusfa.experiments.measure import evaluation_policy, evaluation_precision
from vusfa.modules import InferencePolicy, make_agent
from vusfa.scenes import SceneSet

__all__ = ["run"]

MINUTES = 2.0


def run(options: Options) -> Report:
    """Untrained VUSFA agents, which wander for most of the 500 steps, as recipes/zero_shot.py evaluates them.

    One is the recipe's; one has four frames and layers of 512, as in preset=controlled.
    """
    scenes = SceneSet.bundled(["bathroom"] if options.quick else None)
    torch.set_num_threads(options.threads)
    recipe = recipe_settings(options.overrides).agent
    sizes = {
        f"{counted(recipe.history, 'frame')} of {recipe.hidden_size}": (recipe.history, recipe.hidden_size)
    }
    report = Report("eval")
    for name, (history, size) in {**sizes, "4 frames of 512": (4, 512)}.items():
        _measure(name, scenes, history, 16 if options.quick else size, options, report)
    return report


def _measure(name: str, scenes: SceneSet, history: int, size: int, options: Options, report: Report) -> None:
    torch.manual_seed(0)
    agent = make_agent("vusfa", scenes=scenes, history=history, hidden_size=size, embedding_size=size)
    goals = resolve_goals(scenes, "all")
    each, limit = (1, 10) if options.quick else (10, 500)
    chosen = goals[:8] if options.quick else goals

    def seconds(some: torch.Tensor, batch: int, episodes: int, together: bool = False) -> float:
        began = time.perf_counter()
        with evaluation_precision(agent, {"autocast": True}):
            evaluate(
                evaluation_policy(agent, scenes) if together else InferencePolicy(agent),
                scenes,
                some,
                episodes_per_goal=episodes,
                max_steps=limit,
                batch_size=batch,
                history=history,
            )
        return time.perf_counter() - began

    seconds(goals[:2], 16, 1)  # unmeasured
    sample = goals[:: max(1, len(goals) // 8)][:8]
    alone = seconds(sample, 1, 1) / len(sample) * len(chosen) * each
    whole = seconds(chosen, 4096, each, together=True)
    again = seconds(sample, 1, 1) / len(sample) * len(chosen) * each
    alone = (alone + again) / 2
    label = f"zero-shot evaluation, {name}, {len(chosen):,} goals, {each} episodes each"
    note = f"of {len(sample)} episodes before and {len(sample)} after, scaled to all"
    untrained = "an untrained agent, which needs most of the steps; a trained one is quicker"
    report.rows.append(Row(label, whole, "s", "one episode at a time", alone / whole, untrained))
    report.rows.append(Row(f"{label}, one episode at a time", alone, "s", note=note))
    report.requirements.append(Requirement(label, whole / 60, MINUTES, "minutes", at_least=False))
