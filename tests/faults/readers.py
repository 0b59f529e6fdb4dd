"""Every reader of files with a sound file for it, which :mod:`worker` damages before it is read."""

from __future__ import annotations

import io
import json
import logging
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from PIL import Image

from vusfa.cli.launch import compose
from vusfa.deploy.agents import open_agent, save_agent
from vusfa.envs import resolve_goals
from vusfa.envs.goals import read_manifest as read_goals
from vusfa.errors import SceneError
from vusfa.evaluation import Episodes
from vusfa.evaluation.exact import ExactGoals
from vusfa.experiments.manifest import make_manifest, read_manifest, write_manifest
from vusfa.experiments.runs import Run, read_run, write_run
from vusfa.report.curve import read_metrics
from vusfa.report.runs import read_episodes
from vusfa.report.runs import read_run as read_logged_run
from vusfa.scenes import Scene, SceneSet, validate
from vusfa.scenes.index import INDEX, read_index, write_index
from vusfa.scenes.pictures import decode
from vusfa.sources.compact import compact
from vusfa.sources.download import Patience
from vusfa.sources.fetch import Archive, archives, fetch
from vusfa.sources.photo_tables import read_edges, read_poses
from vusfa.sources.photos import fit_picture, read_features
from vusfa.sources.render.plan_file import load_plan
from vusfa.sources.row_log import RowLog
from vusfa.training import Trainer, load_agent, make_trainer
from vusfa.training.loggers import CSVLogger

__all__ = ["READERS", "Reader"]


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        kind: format of the file, of :data:`mutate.KINDS`.
        make: writes a sound file, and what belongs to it, into an empty folder; returns the file.
        read: reads it.
    """

    kind: str
    make: Callable[[Path], Path]
    read: Callable[[Path], Any]


def _scene() -> Scene:
    states = torch.arange(5)
    graph = torch.stack([(states + 1) % 5, (states - 1) % 5], 1)
    features = torch.rand(5, 2, 7, generator=torch.Generator().manual_seed(0))
    return Scene("ring", graph, features, attributes={"seed": 3, "licences": ["CC0"]})


def _jpeg(shade: int = 100) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.full((12, 16, 3), shade, np.uint8)).save(buffer, "JPEG")
    return buffer.getvalue()


def _scene_file(folder: Path, pictures: Any) -> Path:
    _scene().save(folder / "ring.h5", pictures)
    return folder / "ring.h5"


def _jpeg_scene(folder: Path) -> Path:
    return _scene_file(folder, [_jpeg(shade) for shade in range(5)])


def _raw_scene(folder: Path) -> Path:
    return _scene_file(folder, np.arange(5 * 4 * 6 * 3, dtype=np.uint8).reshape(5, 4, 6, 3))


def _read_scene(path: Path) -> None:
    faults = validate(path)
    assert all(line.startswith(str(path)) for line in faults)
    scene = Scene.load(path)
    SceneSet([scene])
    if scene.has_pictures:
        scene.pictures([0, 4])
    assert len(str(faults)) < 20_000


def _compact(path: Path) -> None:
    compact(path, path.with_name("small.h5"))
    Scene.load(path.with_name("small.h5"))


def _manifest(folder: Path) -> Path:
    return write_manifest(folder / "m.npz", make_manifest(SceneSet([_scene()]), torch.tensor([0])))


def _run_folder(folder: Path) -> Path:
    column = torch.arange(4)
    episodes = Episodes(
        column * 0,
        column,
        (column + 1) % 5,
        column > 1,
        column + 3,
        column + 1,
        column,
        column < 1,
        ("ring",),
        9,
    )
    exact = ExactGoals(column * 0, column, {"success_500": column / 4})
    return write_run(
        folder, Run("table1", "usfa-0", {"model": "usfa", "seed": 0}, {"sampled": episodes}, exact)
    )


def _go_on(path: Path) -> None:
    log = CSVLogger(path.parent, {}, resume_frames=10)
    log.log_metrics({"success": 0.5, "loss": 0.1}, 20)
    log.log_metrics({"success": 0.5, "loss": 0.1, "kl": 0.1}, 30)


def _of_a_run(name: str) -> Reader:
    def read(path: Path) -> None:
        folder = path.parent
        read_run(folder.parent.parent, folder.parent.name, folder.name)

    return Reader("json" if name.endswith("json") else "npz", lambda folder: _run_folder(folder) / name, read)


def _text(name: str, content: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(content, encoding="utf-8")
        return folder / name

    return make


_EPISODES = (
    "scene,goal,start,success,length,shortest,collisions,trained\nring,0,1,1,3,1,0,1\nring,2,1,0,9,1,4,0\n"
)
_CONFIG = {
    "agent": {"model": "usfa", "architecture": "paper"},
    "seed": 1,
    "scenes": ["ring"],
    "algorithm": {"name": "usf"},
}
_PLAN = """name: cell
size: [3.0, 2.0, 2.6]
grid: {step: 0.5, headings: 4}
camera: {height: 1.5, resolution: [64, 48]}
surfaces: {floor: tile, walls: [brick, plain]}
furniture:
- {model: 'Scopia#5', at: [1.0, 1.0], size: [0.4, 0.5, 0.4]}
"""


def _logged_run(folder: Path) -> Path:
    _text("metrics.csv", "frames,success\n10,0.5\n20,\n")(folder)
    _text("zero_shot_episodes.csv", _EPISODES)(folder)
    _text(
        "zero_shot.json", json.dumps({"settings": {"max_steps": 9}, "rows": [{"policy": "usfa", "spl": 0.5}]})
    )(folder)
    return _text("config.json", json.dumps(_CONFIG))(folder)


def _archive(folder: Path) -> Path:
    scene = _jpeg_scene(folder).read_bytes()
    (folder / "ring.h5").unlink()
    with zipfile.ZipFile(folder / "rooms.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("deep/ring.h5", scene)
    return folder / "rooms.zip"


def _fetch(path: Path) -> None:
    once = Patience(connect=0.2, silence=0.2, attempts=1, pause=0.01)
    out = path.with_name("out")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    shutil.copy(path, out)
    try:
        fetch(Archive("rooms", path.name, ("http://127.0.0.1:9/rooms.zip",), {"ring": 5}, once), out)
    finally:
        left = {item.name for item in out.iterdir()}
        assert left in ({"ring.h5"}, set()), f"left behind: {left}"


def _row_log(folder: Path) -> Path:
    RowLog(folder / "rows", {"work": 1}, np.dtype("f4")).append(np.arange(5, dtype="f4"))
    return folder / "rows"


def _npy(folder: Path) -> Path:
    np.save(folder / "features.npy", np.ones((5, 7), np.float32))
    return folder / "features.npy"


def _photo(folder: Path) -> Path:
    (folder / "a.jpg").write_bytes(_jpeg())
    return folder / "a.jpg"


def _decode(path: Path) -> None:
    try:
        decode(path.read_bytes())
        fit_picture(path, 8, 8)
    except OSError as error:  # their callers name the dataset or the table
        raise SceneError(str(error)) from error


def _index(folder: Path) -> Path:
    for name in ("a.h5", "b.h5"):
        _scene().save(folder / name)
    write_index(folder, {name: Scene.load(folder / name, lazy=True) for name in ("a.h5", "b.h5")})
    return folder / INDEX


def _read_index(path: Path) -> None:
    found = read_index(path.parent)
    if found is None:  # as where there is none
        raise SceneError("the index is not believed")
    for dump in found.values():
        scene = Scene.of_dump(dump)
        SceneSet([scene])
        assert not dump.faults()


_ROOMS = SceneSet([_scene()])


def _trainer() -> Trainer:
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it writes to standard output
    overrides = ["agent.hidden_size=4", "agent.embedding_size=4", "agent.history=1", "env.goals=[0,2]"]
    overrides += ["collector.num_envs=2", "collector.rollout=4", "algorithm=hindsight"]
    overrides += ["hindsight.batch_size=8", "hindsight.capacity=40", "hindsight.updates=2"]
    return make_trainer(_settings(*overrides), scenes=_ROOMS)


@cache
def _settings(*overrides: str) -> Any:
    return OmegaConf.to_container(compose(overrides=overrides), resolve=True)


@cache
def _learned() -> bytes:
    trainer = _trainer()
    with TemporaryDirectory() as folder, trainer.collecting() as batches:
        trainer.update(batches)
        return trainer.save(Path(folder, "checkpoint.pt")).read_bytes()


def _checkpoint(folder: Path) -> Path:
    (folder / "checkpoint.pt").write_bytes(_learned())
    return folder / "checkpoint.pt"


def _resume(path: Path) -> None:
    """For an evaluation, and to go on."""
    load_agent(path, _ROOMS)
    trainer = _trainer()
    trainer.resume(path)
    with trainer.collecting() as batches:
        trainer.update(batches)


def _agent_file(folder: Path) -> Path:
    trainer = _trainer()
    return save_agent(folder / "agent.safetensors", trainer.agent, _ROOMS, trainer.goals)


READERS: dict[str, Reader] = {
    "checkpoint": Reader("checkpoint", _checkpoint, _resume),
    "agent": Reader("safetensors", _agent_file, lambda path: open_agent(path, _ROOMS)),
    "scene": Reader("hdf5", _jpeg_scene, _read_scene),
    "scene, raw": Reader("hdf5", _raw_scene, _read_scene),
    "index": Reader("npz", _index, _read_index),
    "compact": Reader("hdf5", _jpeg_scene, _compact),
    "fetch": Reader("zip", _archive, _fetch),
    "archives": Reader(
        "yaml", _text("a.yaml", "a: {mirrors: ['http://h/a.zip'], scenes: {x: 3}}\n"), archives
    ),
    "picture": Reader("jpeg", _photo, _decode),
    "features": Reader("npy", _npy, lambda path: read_features(path, 5)),
    "poses": Reader(
        "csv", _text("poses.csv", "file,x,z,heading\na.jpg,0,0,90\nb.jpg,0.5,0,180\n"), read_poses
    ),
    "edges": Reader(
        "csv", _text("edges.csv", "state,action,next\na,go,b\nb,go,a\n"), lambda p: read_edges(p, "ab")
    ),
    "row log": Reader("bytes", _row_log, lambda path: RowLog(path, {"work": 1}, np.dtype("f4")).read()),
    "plan": Reader("yaml", _text("plan.yaml", _PLAN), load_plan),
    "goals": Reader("yaml", _text("goals.yaml", "ring: [0, 2]\n"), lambda path: resolve_goals(_ROOMS, path)),
    "goal names": Reader("text", _text("goals.yaml", "ring: [0, 2]\n"), read_goals),
    "manifest": Reader("npz", _manifest, read_manifest),
    "cell.json": _of_a_run("cell.json"),
    "episodes": _of_a_run("sampled.npz"),
    "exact": _of_a_run("exact.npz"),
    "metrics.csv": Reader("csv", _text("metrics.csv", "frames,success\n10,0.5\n20,\n"), read_metrics),
    "resumed log": Reader("csv", _text("metrics.csv", "frames,success\n10,0.5\n20,\n"), _go_on),
    "episodes.csv": Reader("csv", _text("episodes.csv", _EPISODES), lambda path: read_episodes(path, 9)),
    "config.json": Reader("json", _logged_run, lambda path: read_logged_run(path.parent)),
    "zero_shot.json": Reader(
        "json",
        lambda folder: _logged_run(folder).with_name("zero_shot.json"),
        lambda p: read_logged_run(p.parent),
    ),
}
