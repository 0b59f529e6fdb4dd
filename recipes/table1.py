"""The paper's Table 1, a cell a model and seed: python recipes/table1.py --models vusfa --seeds 0

Every cell trains a model, chooses a checkpoint by the validation goals, and evaluates it on the episodes of
the manifest that all cells share. Results go to results/EXPERIMENT/MODEL-SEED; what is there is skipped, what
was cut off goes on. "untrained" is VUSFA before its first update. python recipes/tables.py prints the tables.
"""

from __future__ import annotations

import dataclasses
import shutil
import sys
import time
from pathlib import Path

import tyro
from omegaconf import OmegaConf, open_dict

from vusfa.cli.launch import compose
from vusfa.errors import VusfaError
from vusfa.experiments.measure import choose_checkpoint, measure_checkpoint
from vusfa.experiments.runs import read_run, write_run
from vusfa.files import replacing
from vusfa.modules.presets import MODELS

sys.path.insert(0, str(Path(__file__).parent))
from train import train

from vusfa.conf import FOLDER as CONF


def checkpoints(folder: Path, overrides: list[str], stages: list[float]) -> list[Path]:
    """Train as far as each stage and keep a checkpoint there; those that are there already are kept."""
    cfg = compose(CONF, "train", [*overrides, f"folder={folder}", "evaluation=none"])
    OmegaConf.resolve(cfg)  # schedules end where the whole training ends, whichever part of it runs
    total, last = cfg.total_frames, folder / "checkpoint.pt"
    kept = [folder / f"checkpoint-{round(100 * stage)}.pt" for stage in stages]
    for stage, path in zip(stages, kept, strict=True):
        if path.exists():
            continue
        with open_dict(cfg):
            cfg.total_frames, cfg.resume = round(stage * total), str(last) if last.exists() else None
        code = train(cfg, overrides)[2]
        if code:
            sys.exit(code)
        with replacing(path) as unfinished:
            shutil.copy(last, unfinished)
    return kept


def table1(
    overrides: tyro.conf.Positional[list[str]] = [],  # noqa: B006
    /,
    *,
    experiment: str = "table1",
    models: list[str] = ["untrained", *MODELS],  # noqa: B006
    seeds: list[int] = [0, 1, 2, 3, 4],  # noqa: B006
    stages: list[float] = [0.8, 0.9, 1.0],  # noqa: B006
    results: Path = Path("results"),
    runs: Path = Path("runs"),
    manifest: Path | None = None,
    again: bool = False,
) -> None:
    """Run the cells that results do not hold yet, seed by seed.

    Args:
        overrides: settings of recipes/train.py, such as preset=paper.
        experiment: name of the table.
        models: of the four, and untrained.
        seeds: paired: all models get the same ones.
        stages: parts of the training after which a checkpoint is a candidate.
        results: where cells are written.
        runs: where trainings keep their checkpoints.
        manifest: of episodes; that of the bundled rooms when not given.
        again: measure the cells that are there anew, from the checkpoints that were chosen.
    """
    for seed in seeds:
        for model in models:
            name, began = f"{model}-{seed}", time.monotonic()
            run, there = runs / experiment / name, (results / experiment / name / "cell.json").exists()
            if there and not again:
                print(f"{results / experiment / name}: already there")
                continue
            if there:
                info = read_run(results, experiment, name).info
                chosen, settings = run / info["checkpoint"], info["overrides"]
                facts = {key: info[key] for key in ("validation_spl", "cell_s") if key in info}
                facts |= {"model": model, "row": model} if model == "untrained" else {}
            else:
                untrained = model == "untrained"
                settings = [*overrides, f"agent.model={'vusfa' if untrained else model}", f"seed={seed}"]
                kept = checkpoints(run, settings, [0.0] if untrained else sorted(stages))
                scores = choose_checkpoint(kept, manifest)
                chosen = next(iter(scores))
                facts = {"validation_spl": {path.name: score for path, score in scores.items()}}
                facts |= {"model": model, "row": model} if untrained else {}
            measured = measure_checkpoint(chosen, experiment, name, settings, manifest)
            facts.setdefault("cell_s", round(time.monotonic() - began, 1))
            print(write_run(results, dataclasses.replace(measured, info={**measured.info, **facts})))


if __name__ == "__main__":
    try:
        tyro.cli(table1)
    except VusfaError as error:
        sys.exit(f"error: {error}")
