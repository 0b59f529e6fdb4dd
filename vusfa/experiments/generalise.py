"""Rooms never seen: training in some rooms, tests in others: ``vusfa generalise``."""

from __future__ import annotations

import re
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch

from vusfa.cluster.cells import Cell, run_cells
from vusfa.conf.compose import as_text
from vusfa.errors import ConfigError, SceneError
from vusfa.evaluation import (
    Episodes,
    evaluate,
    evaluate_searchers,
    print_summary,
    random_walk_summary,
    summary,
)
from vusfa.evaluation.exact import exact_goals, uniform_probabilities
from vusfa.evaluation.searchers import check_searched
from vusfa.experiments.room_split import SPLIT_FILE, TRAIN, find_split
from vusfa.experiments.runs import Run, check_run_name, read_run, write_run
from vusfa.experiments.training import compose_settings, train
from vusfa.files import check_folder, say
from vusfa.modules import InferencePolicy, TriedActions, transplant
from vusfa.scenes import SceneSet
from vusfa.training import EvaluationProgress, load_agent, run_facts

__all__ = ["generalise", "generalise_cell", "policies", "rooms_of", "run_name", "split_rooms"]

PRESET = "preset=imitation"


def split_rooms(folder: Path, trained: int, tested: int) -> tuple[list[str], list[str]]:
    """Dumps to train on and to test in: in the order of the numbers that their names end in, the first and
    the last.

    Raises:
        SceneError: there are fewer.
    """
    number = re.compile(r"(\d+)$")
    files = sorted(
        folder.glob("*.h5"),
        key=lambda path: (int(found[0]) if (found := number.search(path.stem)) else 0, path.stem),
    )
    if min(trained, tested) < 1:
        raise ConfigError(f"trained is {trained} and tested {tested}; give 1 or more of each")
    if len(files) < trained + tested:
        raise SceneError(
            f"{folder}: {len(files)} dumps (.h5), {trained + tested} are wanted; render some with"
            " 'vusfa scenes render', or ask for fewer"
        )
    return [str(path) for path in files[:trained]], [str(path) for path in files[-tested:]]


def rooms_of(
    folder: Path, trained: int | None, tested: int | None, test: str | None
) -> tuple[list[str], list[str], str | None]:
    """Dumps to train on and to test in, and the part that the latter are of.

    Where the folder has a split (:mod:`vusfa.experiments.room_split`) they are the first of its parts, all by
    default; otherwise those of :func:`split_rooms`, 32 and 8 by default.

    Args:
        folder: of the rooms.
        trained, tested: numbers of rooms.
        test: part of the split, "validation" by default.

    Raises:
        ConfigError: a part without a split, an unknown one, or one with fewer rooms.
        SceneError: dumps are missing.
    """
    split = find_split(folder)
    if split is None:
        if test is not None:
            raise ConfigError(f"test is {test!r}, but {folder} has no {SPLIT_FILE}; leave it out")
        first, last = split_rooms(folder, 32 if trained is None else trained, 8 if tested is None else tested)
        return first, last, None
    part = test or "validation"
    if part == TRAIN:
        raise ConfigError(f"test is {part!r}, the rooms to train in; name another part of {SPLIT_FILE}")
    return split.files(folder, TRAIN, trained), split.files(folder, part, tested), part


def policies(agent: Any, scenes: SceneSet, weight: float, temperature: float) -> dict[str, Any]:
    """Who walks in the rooms, by name."""
    sizes = scenes.num_states, scenes.num_actions
    walkers: dict[str, Any] = {"agent": InferencePolicy(agent)}
    if agent.memory is None:  # one that remembers by itself needs no count of tried actions
        walkers["agent-memory"] = TriedActions(agent, *sizes, weight=weight, temperature=temperature)
    return walkers | {"memory": TriedActions(None, *sizes, weight=weight)}


def generalise(
    rooms: Path,
    overrides: list[str] = [],  # noqa: B006
    *,
    name: str = "vusfa",
    seed: int = 0,
    seeds: list[int] = [],  # noqa: B006
    trained: int | None = None,
    tested: int | None = None,
    test: str | None = None,
    weight: float = 3.0,
    temperature: float = 1.0,
    episodes: int = 10,
    searchers: bool = True,
    results: Path = Path("results"),
    runs: Path = Path("runs"),
    again: bool = False,
    launcher: str = "serial",
    launcher_options: list[str] = [],  # noqa: B006
) -> None:
    """Train in some rooms, test in others that the agent has never seen.

    The agent, whose heads are the same for all rooms, walks to every goal of the other rooms as it is and
    with a memory of the episode; beside it the random walk, the memory alone, and searchers that know the
    map but not where the goal is (:mod:`vusfa.evaluation.searchers`). Results go to
    RESULTS/generalise/NAME-SEED, where the rooms have a split NAME-PART-SEED, and existing ones are skipped;
    ``vusfa tables generalise`` prints the table of all seeds, with intervals.

    Args:
        rooms: folder of dumps (.h5).
        overrides: settings of vusfa train over those of preset=imitation, whose agent reads features
            with a grid (those of a split); preset=unseen reads any.
        name: of the results, before the seed.
        seed: of everything.
        seeds: of several agents, in place of one seed.
        trained: rooms to train on, evenly of all kinds; where the folder has a split (``vusfa scenes
            render-rooms FOLDER split=unseen``) all of its part to train in by default, otherwise 32.
        tested: rooms to test in; all of the split's part by default, otherwise 8.
        test: part of the split to test in: validation (the default), test or large.
        weight: of the memory: off the logits for each time that an action was tried here.
        temperature: of the agent's logits, beside the memory.
        episodes: to every goal of the rooms to test in.
        searchers: evaluate those that know the map, too.
        results: where results are written.
        runs: where the checkpoint is kept.
        again: test the agents of existing results again.
        launcher, launcher_options: what runs the cells: serial, local, slurm or ray (docs/cluster.md).
    """
    how: dict[str, Any] = {"weight": weight, "temperature": temperature, "episodes": episodes}
    how |= {"searchers": searchers, "results": results, "runs": runs}
    check_run_name(f"{name}-{seed}")
    check_folder(runs / "generalise", "runs")
    first, last, part = rooms_of(rooms, trained, tested, test)
    how["part"] = part
    compose_settings([PRESET, *overrides])  # mistakes show before any work
    unseen = SceneSet.open(last)
    if searchers:
        check_searched(unseen)
    cells = {
        each: Cell(
            results / "generalise" / run_name(name, part, each),
            partial(generalise_cell, first, last, overrides, name, each, how),
        )
        for each in seeds or [seed]
    }
    run_cells(list(cells.values()), launcher, launcher_options, again)
    none, every = torch.tensor([], dtype=torch.int64), torch.arange(unseen.num_states)
    for each in cells:
        tables = read_run(results, "generalise", run_name(name, part, each)).episodes
        rows = [row for who, table in tables.items() for row in summary(table, who)]
        print_summary([*rows, *random_walk_summary(unseen, every, none)])
    say(f"vusfa tables generalise --results {results} shows all seeds with intervals")


def run_name(name: str, part: str | None, seed: int) -> str:
    """Folder of a run's results.

    >>> run_name("vusfa", None, 0), run_name("vusfa", "test", 0)
    ('vusfa-0', 'vusfa-test-0')
    """
    return f"{name}-{seed}" if part is None else f"{name}-{part}-{seed}"


def generalise_cell(
    first: list[str], last: list[str], overrides: list[str], name: str, seed: int, how: dict[str, Any]
) -> Path:
    """Train one agent, unless its checkpoint is there, and test it in rooms that it has never seen.

    Args:
        first, last: dumps to train on, and to test in.
        overrides, name, seed, how: arguments of :func:`generalise`, the others by name.
    """
    weight, temperature, episodes = (how[each] for each in ("weight", "temperature", "episodes"))
    results, runs = how["results"], how["runs"]
    torch.set_num_threads(1)
    unseen, folder = SceneSet.open(last), runs / "generalise" / f"{name}-{seed}"
    settings = [PRESET, *overrides, f"seed={seed}", f"scenes=[{','.join(map(as_text, first))}]"]
    if not (folder / "checkpoint.pt").exists():
        cfg = compose_settings([*settings, f"folder={as_text(str(folder))}", "evaluation=none"])
        if code := train(cfg, settings).exit_code:
            sys.exit(code)
    agent, _, state = load_agent(folder / "checkpoint.pt")
    if [Path(path).stem for path in state["scenes"]["sources"]] != [Path(path).stem for path in first]:
        raise ConfigError(
            f"{folder}: this agent was trained in {len(state['scenes']['sources'])} rooms, not in the"
            f" {len(first)} that are asked for; give another name, or remove the folder"
        )
    tables: dict[str, Episodes] = {}
    with EvaluationProgress() as progress:
        for who, policy in policies(transplant(agent, unseen).eval(), unseen, weight, temperature).items():
            tables[who] = evaluate(
                policy,
                unseen,
                episodes_per_goal=episodes,
                history=agent.config["history"],
                seed=seed,
                batch_size=1024,
                progress=lambda done, total, who=who: progress(who, done, total),  # type: ignore[misc]
            )
    if how["searchers"]:
        with EvaluationProgress() as progress:
            tables |= evaluate_searchers(
                tables["agent"], unseen, lambda done, total: progress("searchers", done, total)
            )
    facts = {**run_facts(state, overrides), "trained_in": [Path(p).stem for p in first]}
    info = {**facts, "memory_weight": weight, "temperature": temperature, "tested_in": list(unseen.names)}
    info |= {} if how["part"] is None else {"part": how["part"]}
    walk = exact_goals(uniform_probabilities(unseen.num_actions), unseen)
    return write_run(results, Run("generalise", run_name(name, how["part"], seed), info, tables, walk))
