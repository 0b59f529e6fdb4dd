"""The paper's Table 1, a cell a model and seed: python recipes/table1.py --models vusfa --seeds 0

Every cell trains a model, chooses a checkpoint by the validation goals, and evaluates it on the episodes of
the manifest that all cells share. Results go to results/EXPERIMENT/MODEL-SEED; what is there is skipped, what
was cut off goes on. python recipes/tables.py prints the tables.
"""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from typing import Any

import torch
import tyro
from omegaconf import OmegaConf, open_dict

from vusfa.errors import VusfaError
from vusfa.evaluation import evaluate
from vusfa.evaluation.exact import agent_probabilities, exact_goals
from vusfa.evaluation.files import replacing
from vusfa.evaluation.manifest import BUNDLED_MANIFEST, Manifest, make_manifest, read_manifest
from vusfa.evaluation.metrics import spl
from vusfa.evaluation.results import Cell, write_cell
from vusfa.modules import Agent
from vusfa.modules.presets import MODELS
from vusfa.training import EvaluationProgress, load_agent, make_observation, run_facts
from vusfa.training.launch import compose

sys.path.insert(0, str(Path(__file__).parent))
from train import train

CONF = Path(__file__).parent / "conf"
STAGES = (0.8, 0.9, 1.0)


def run_cell(
    experiment: str, name: str, overrides: list[str], *, results: Path, runs: Path, manifest: Path | None
) -> None:
    """Train, choose, evaluate and write one cell.

    Args:
        experiment, name: of the cell.
        overrides: settings of recipes/train.py.
        results, runs: folders of results and of checkpoints.
        manifest: of episodes; the bundled rooms' own, or one made for other scenes, when not given.
    """
    folder, began = runs / experiment / name, time.monotonic()
    cfg = compose(CONF, "train", [*overrides, f"folder={folder}", "evaluation=none"])
    OmegaConf.resolve(cfg)  # schedules end where the whole training ends, whichever part of it runs
    total, last = cfg.total_frames, folder / "checkpoint.pt"
    kept = [folder / f"checkpoint-{round(100 * stage)}.pt" for stage in STAGES]
    for stage, path in zip(STAGES, kept, strict=True):
        if not path.exists():
            with open_dict(cfg):
                cfg.total_frames, cfg.resume = round(stage * total), str(last) if last.exists() else None
            code = train(cfg, overrides)[2]
            if code:
                sys.exit(code)
            with replacing(path) as unfinished:
                shutil.copy(last, unfinished)
    scores = [validation_score(path, manifest) for path in kept]
    chosen = kept[max(range(len(kept)), key=lambda i: scores[i])]
    agent, scenes, state = load_agent(chosen)
    episodes = choose_manifest(manifest, agent, scenes, state["goals"])
    info = {
        **run_facts(state, overrides),
        "checkpoint": chosen.name,
        "validation_spl": dict(zip((path.name for path in kept), scores, strict=True)),
    }
    tables = {
        way: measure(agent, scenes, episodes, state["goals"], f"{name}, {way}", way == "sampled")
        for way in ("sampled", "greedy")
    }
    exact = None
    if agent.config["history"] == 1 and agent.config["observation"] == "index" and not agent.config["memory"]:
        exact = exact_goals(agent_probabilities(agent.eval()), scenes, agent)
    info["cell_s"] = round(time.monotonic() - began, 1)
    print(write_cell(results, Cell(experiment, name, info, tables, exact)))


def choose_manifest(path: Path | None, agent: Agent, scenes: Any, goals: torch.Tensor) -> Manifest:
    """The named manifest, the bundled rooms' own, or one made for other rooms."""
    manifest = read_manifest(path or BUNDLED_MANIFEST)
    return manifest if path or manifest.fingerprint == scenes.fingerprint else make_manifest(scenes, goals)


def validation_score(checkpoint: Path, manifest: Path | None) -> float:
    """The rule that checkpoints are chosen by: SPL of the episodes to the validation goals, drawn actions."""
    agent, scenes, state = load_agent(checkpoint)
    episodes = choose_manifest(manifest, agent, scenes, state["goals"])
    table = measure(agent, scenes, episodes, state["goals"], checkpoint.stem, validation=True)
    return spl(table.success, table.length, table.shortest)


def measure(
    agent: Agent,
    scenes: Any,
    manifest: Manifest,
    trained: torch.Tensor,
    title: str,
    sample: bool = True,
    validation: bool = False,
) -> Any:
    """The manifest's episodes, walked by an agent."""
    with EvaluationProgress() as progress:
        return evaluate(
            agent.get_policy_operator(out_keys=["action"]),
            scenes,
            episodes=manifest.episodes(scenes, validation),
            trained=trained,
            sample=sample,
            seed=manifest.seed,
            history=agent.config["history"],
            observe=make_observation(agent, scenes),
            progress=lambda done, of: progress(title, done, of),
        )


def table1(
    overrides: tyro.conf.Positional[list[str]] = [],  # noqa: B006
    /,
    *,
    experiment: str = "table1",
    models: list[str] = list(MODELS),  # noqa: B006
    seeds: list[int] = [0, 1, 2, 3, 4],  # noqa: B006
    results: Path = Path("results"),
    runs: Path = Path("runs"),
    manifest: Path | None = None,
) -> None:
    """Run the cells that results do not hold yet, seed by seed.

    Args:
        overrides: settings of recipes/train.py, such as preset=paper.
        experiment: name of the table.
        models: of the four.
        seeds: paired: all models get the same ones.
        results: where cells are written.
        runs: where trainings keep their checkpoints.
        manifest: of episodes; that of the bundled rooms when not given.
    """
    for seed in seeds:
        for model in models:
            name = f"{model}-{seed}"
            if (results / experiment / name / "cell.json").exists():
                print(f"{results / experiment / name}: already there")
                continue
            settings = [*overrides, f"agent.model={model}", f"seed={seed}"]
            run_cell(experiment, name, settings, results=results, runs=runs, manifest=manifest)


if __name__ == "__main__":
    try:
        tyro.cli(table1)
    except VusfaError as error:
        sys.exit(f"error: {error}")
