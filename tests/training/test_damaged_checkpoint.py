"""Damaged and hostile checkpoints: refused in words that name file and entry, before anything is restored."""

from __future__ import annotations

import copy
import random
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.cli.launch import compose
from vusfa.errors import CheckpointError, VusfaError
from vusfa.training import Trainer, load_agent, load_checkpoint, make_trainer, save_checkpoint

SMALL = ["agent.hidden_size=8", "agent.embedding_size=8", "agent.history=1", "env.goals=[3,9,12]"]
SMALL += ["collector.num_envs=6", "collector.rollout=4", "algorithm=hindsight", "hindsight.batch_size=8"]
SMALL += ["hindsight.capacity=60"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trainer, Path]:
    """A training with everything that a checkpoint may hold, and its checkpoint."""
    folder = tmp_path_factory.mktemp("run")
    settings: Any = OmegaConf.to_container(compose(overrides=["scenes=[bathroom]", *SMALL]), resolve=True)
    trainer = make_trainer(settings)
    with trainer.collecting() as batches:
        for _ in range(3):
            trainer.update(batches)
        return trainer, trainer.save(folder / "checkpoint.pt")


@pytest.fixture
def changed(saved: tuple[Trainer, Path], tmp_path: Path):
    """Writes the checkpoint with one entry replaced, or removed."""
    trainer, path = saved
    content = torch.load(path, weights_only=True)

    def write(name: str, *value: Any) -> tuple[Trainer, Path]:
        state = parent = copy.deepcopy(content)
        *parts, last = (int(part) if part.isdigit() else part for part in name.split("/"))
        for part in parts:
            parent = parent[part]
        if value:
            parent[last] = value[0](parent[last]) if callable(value[0]) else value[0]
        else:
            del parent[last]
        torch.save(state, tmp_path / "b.pt")
        return trainer, tmp_path / "b.pt"

    return write


def resume(trainer: Trainer, path: Path) -> None:
    """All that reads a checkpoint: for an evaluation, and to go on."""
    load_agent(path, trainer.scenes)
    trainer.resume(path)
    with trainer.collecting() as batches:
        trainer.update(batches)


def test_the_whole_one_is_taken(saved: tuple[Trainer, Path]):
    trainer, path = saved
    resume(trainer, path)
    assert trainer.frames > load_checkpoint(path)["frames"]


def test_every_flipped_bit_that_changes_content_is_seen(saved: tuple[Trainer, Path], tmp_path: Path):
    _, path = saved
    content, draw, refused = path.read_bytes(), random.Random(0), 0
    whole = load_checkpoint(path)
    for _ in range(60):
        damaged = bytearray(content)
        damaged[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
        (tmp_path / "b.pt").write_bytes(damaged)
        try:
            state = load_checkpoint(tmp_path / "b.pt")
        except CheckpointError as error:
            assert "b.pt: " in str(error)  # noqa: PT017
            refused += 1
        else:  # it was in the padding between records
            assert str(state) == str(whole)
    assert refused > 30


@pytest.mark.parametrize("name", ["goals", "agent", "config", "rng", "meter/terms", "scenes/names"])
def test_a_missing_entry_is_named(changed, name: str):
    with pytest.raises(CheckpointError, match=f"b.pt: .*'{name.replace('/', '.')}' is missing"):
        resume(*changed(name))


NAN = torch.full((8,), torch.nan)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("agent/fusion.linear.bias", NAN, "holds NaN"),
        ("agent/fusion.linear.bias", torch.zeros(9), r"is float32 \(9,\), not float32 \(8,\)"),
        ("agent/fusion.linear.bias", torch.zeros(8, dtype=torch.int64), "is int64"),
        ("agent/fusion.linear.bias", [1], r"is \[1\], not a tensor"),
        ("optimizer/state/1/exp_avg", torch.zeros(3), r"float32 \(3,\), not float32 \(8,\)"),
        ("optimizer/state/1/exp_avg_sq", NAN, "holds NaN"),
        ("optimizer/state/99", {}, "of no parameter"),
        ("optimizer/param_groups/0/params", [0, 0], "of other parameters"),
        ("algorithm/replay/rows/state_id", torch.full((60, 1), 10**6), "entry 'algorithm'"),
        ("algorithm/replay/rows/next", {}, "entry 'algorithm'"),
        ("algorithm/replay/sampler/scene_of", torch.zeros(3, dtype=torch.int64), "entry 'algorithm'"),
        ("algorithm/replay/writer", "x", "entry 'algorithm'"),
        ("algorithm/loss/bottleneck_coeff", torch.zeros(2), "entry 'algorithm'"),
        ("collector/carrier/state_id", torch.full((6, 1), 10**6), "out of range"),
        ("collector/carrier/goal_id", torch.full((6,), -1), "out of range"),
        ("collector/generator", torch.zeros(5056, dtype=torch.uint8), "entry 'collector.generator' cannot"),
        ("meter/episodes/sums", torch.zeros(5, 4, dtype=torch.float64), "float64"),
        ("meter/terms/count", "many", "entry 'meter.terms' cannot"),
        ("rng/numpy/2", 10**6, "entry 'rng' cannot"),
        ("rng/python", [3, [1, 2], None], "entry 'rng' cannot"),
        ("frames", -5, "0 or more"),
        ("frames", "7", "'7', not of type int"),
        ("agent_config/hidden_size", 10**9, "agent_config.hidden_size"),
        ("agent_config/walls", 3, "knows no field 'walls'"),
        ("goals", torch.zeros(3), "not a list of state ids"),
        ("config/seed", None, "not of type int"),
        ("run_id", b"a", "a bytes, which no checkpoint holds"),
        ("run_id", "../../x", "no id of a run"),
        ("run_id", "a\x1b[2J", "no id of a run"),
        ("run_id", "x" * 129, "no id of a run"),
    ],
)
def test_what_is_wrong_is_named(changed, name: str, value: Any, words: str):
    with pytest.raises(CheckpointError, match=rf"b\.pt: .*{words}"):
        resume(*changed(name, value))


def paths(value: Any, before: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if before:
        yield before
    items = value.items() if isinstance(value, dict) else enumerate(value[:3]) if type(value) is list else ()
    for key, item in items:
        yield from paths(item, (*before, key))


def test_no_mutation_ends_in_a_traceback(saved: tuple[Trainer, Path], tmp_path: Path):
    """A seeded draw of entries, each removed or replaced by something else; benchmarks/faults.py draws
    more."""
    trainer, path = saved
    content, draw = torch.load(path, weights_only=True), random.Random(1)
    junk = [None, -1, 10**12, 1.5, "x", [], {}, [1, "a"], {"a": 1}, torch.zeros(3), torch.zeros(2, 0), True]
    places, refused = list(paths(content)), 0
    for _ in range(40):
        state = parent = copy.deepcopy(content)
        *parts, last = draw.choice(places)
        for part in parts:
            parent = parent[part]
        if draw.random() < 0.3:
            del parent[last]
        else:
            parent[last] = draw.choice(junk)
        torch.save(state, tmp_path / "b.pt")
        try:
            resume(trainer, tmp_path / "b.pt")
        except VusfaError as error:
            assert "b.pt: " in str(error)  # noqa: PT017
            refused += 1
    assert refused > 10  # the others left out or changed what a checkpoint need not hold, or held that value


def test_archives_that_are_no_checkpoints(tmp_path: Path, checkpoint_state: dict[str, Any]):
    path = save_checkpoint(tmp_path / "a.pt", checkpoint_state)
    with zipfile.ZipFile(path) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in records.items():
            archive.writestr(name, data)
    with pytest.raises(CheckpointError, match=r"bomb\.pt: its record .* is compressed"):
        load_checkpoint(tmp_path / "bomb.pt")
    shared: list[Any] = [0] * 30
    for _ in range(8):  # 30^9 values in a kilobyte
        shared = [shared] * 30
    torch.save({**checkpoint_state, "overrides": shared}, tmp_path / "laughs.pt")
    with pytest.raises(CheckpointError, match=r"laughs\.pt: it holds more than 200,000 values"):
        load_checkpoint(tmp_path / "laughs.pt")
    torch.save({**checkpoint_state, "agent": {"w": torch.zeros(1).expand(10**12)}}, tmp_path / "wide.pt")
    with pytest.raises(CheckpointError, match=r"wide\.pt: its entry '\.?agent\.w' is no plain tensor"):
        load_checkpoint(tmp_path / "wide.pt")
    torch.save(checkpoint_state, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(CheckpointError, match=r"old\.pt: not a whole checkpoint"):
        load_checkpoint(tmp_path / "old.pt")
