"""What all tests share: where the golden numbers of the released code are, and small scenes."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import h5py
import hypothesis
import numpy as np
import pytest
import torch
import torch.multiprocessing
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from vusfa.errors import ConfigError, SceneError
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.graph import shortest_path_distances
from vusfa.sources.render.catalogue import Catalogue

# A program that a shell script started in the background ignores Ctrl-C, and so do those that it starts. What
# the tests say of interruptions shall hold there, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# `pytest -n 2` keeps two cores busy with two processes. With a thread per core in each of them, torch's
# threads wait for each other: the slowest test took 49 seconds in place of 4.
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)

# An example takes longer on a busy machine: no property test has a deadline.
hypothesis.settings.register_profile("vusfa", deadline=None)
hypothesis.settings.load_profile("vusfa")

_RECORDED = Path(__file__).parent / "golden"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--golden",
        type=Path,
        default=_RECORDED,
        metavar="DIR",
        help="folder of numbers that the authors' released code computed, for tests/test_reference_parity.py;"
        " by default tests/golden",
    )


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests marked ``render`` and ``miniworld`` are skipped where those are missing; under CI they fail
    there."""
    for mark, missing in (("render", _no_renderer), ("miniworld", _no_miniworld)):
        if item.get_closest_marker(mark) and (what := missing()):
            lacking(what)


def _no_renderer() -> str:
    packages = ("mitsuba", "mitsuba_oidn", "trimesh", "efficientnet_lite_pytorch")
    missing = [name for name in packages if not find_spec(name)]
    try:
        Catalogue.open()
    except SceneError:
        missing.append("furniture (Debian's sweethome3d-furniture)")
    return ", ".join(missing)


@cache
def _no_miniworld() -> str:
    from vusfa.sources.miniworld import find_miniworld

    try:
        find_miniworld()
    except ConfigError as error:
        return str(error)
    pyglet = import_module("pyglet")
    pyglet.image.load = _quick_texture  # pyglet adds a channel by a regular expression, a second per texture
    return ""


def _quick_texture(path: str) -> Any:
    """A picture as ``pyglet.image.load`` gives it, in RGBA."""
    with Image.open(path) as picture:
        rows = np.ascontiguousarray(np.flipud(picture.convert("RGBA")))
    height, width, _ = rows.shape
    return import_module("pyglet.image").ImageData(width, height, "RGBA", rows.tobytes())


def lacking(what: str) -> None:
    """Skip the test, or fail it under CI, where everything is to be there."""
    give_up = pytest.fail if os.environ.get("CI") else pytest.skip
    give_up(f"not installed: {what}")


@pytest.fixture
def needs_llvm() -> None:
    """The test renders with LLVM."""
    from vusfa.sources.render.backend import choose_backend

    if choose_backend().library is None:
        lacking("a working LLVM (Debian's libllvm19)")


@pytest.fixture(scope="session")
def golden(request: pytest.FixtureRequest) -> Path:
    """The folder of golden numbers."""
    folder: Path = request.config.getoption("--golden")
    if not folder.is_dir():
        pytest.fail(f"{folder} is not a folder; --golden names the folder of golden numbers")
    return folder


def grid_scene(name: str = "hall", width: int = 2, height: int = 2, features: int = 8) -> Scene:
    """An empty room of width x height places with four headings each: 4 N states, no island, shortest paths
    of a few steps.

    State = 4 * place + heading (0 is up, then clockwise); MoveForward, RotateRight, RotateLeft, MoveBackward.
    """
    graph = torch.full((4 * width * height, 4), -1)
    moves = [(0, 1), (1, 0), (0, -1), (-1, 0)]
    location, rotation = [], []
    for place, (y, x) in enumerate(itertools.product(range(height), range(width))):
        for heading, (right, up) in enumerate(moves):
            for action, sign in ((0, 1), (3, -1)):
                to_x, to_y = x + sign * right, y + sign * up
                if 0 <= to_x < width and 0 <= to_y < height:
                    graph[4 * place + heading, action] = 4 * (to_y * width + to_x) + heading
            graph[4 * place + heading, 1] = 4 * place + (heading + 1) % 4
            graph[4 * place + heading, 2] = 4 * place + (heading - 1) % 4
            location.append([0.5 * x, 0.5 * y])
            rotation.append(90.0 * heading)
    generator = torch.Generator().manual_seed(zlib.crc32(name.encode()))
    values = torch.rand(len(graph), 1, features, generator=generator)
    return Scene(name, graph, values, torch.tensor(location), torch.tensor(rotation))


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """:func:`grid_scene`."""
    return grid_scene


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    """A scene of 16 states with pictures of 40 x 48 pixels, as a file."""
    scene = grid_scene()
    generator = torch.Generator().manual_seed(0)
    pictures = torch.randint(256, (scene.num_states, 40, 48, 3), dtype=torch.uint8, generator=generator)
    path = tmp_path / "hall.h5"
    scene.save(path, pictures)
    return path


@pytest.fixture
def checkpoint_state() -> dict[str, Any]:
    """The smallest content of a checkpoint that is whole."""
    return {
        "frames": 7,
        "updates": 1,
        "seconds": 0.5,
        "run_id": "a",
        "agent_config": {"model": "vusfa"},
        "agent": {"w": torch.arange(500.0)},
        "scenes": {"sources": ["kitchen"], "names": ["kitchen"], "fingerprint": "f"},
        "goals": torch.tensor([1]),
        "config": {
            "agent": {"model": "vusfa", "architecture": "controlled"},
            "algorithm": {"name": "usf"},
            "env": {},
            "seed": 0,
            "threads": 1,
            "autocast": False,
            "total_frames": 9,
        },
        "overrides": [],
        "optimizer": {"state": {}, "param_groups": [{}]},
        "algorithm": {},
        "collector": {},
        "meter": {"episodes": {}, "terms": {}},
        "rng": {},
    }


@pytest.fixture
def settings() -> Callable[..., DictConfig]:
    """Settings as the command line would make them, interpolations resolved."""
    from vusfa.cli.launch import compose
    from vusfa.conf import FOLDER

    def made(*overrides: str, name: str = "train") -> DictConfig:
        cfg = compose(FOLDER, name, overrides)
        OmegaConf.resolve(cfg)
        return cfg

    return made


# Processes begin with what takes seconds to import: they are forked from one server per process of pytest.
multiprocessing.set_forkserver_preload(
    [
        "typer",
        "vusfa.cli.launch",
        "vusfa.experiments.training",
        "vusfa.report.command",
        "vusfa.sources.capture",
    ]
)


@pytest.fixture
def fast_workers() -> Iterator[None]:
    """Workers are forked from a server that has imported everything, instead of importing it each."""
    before = torch.multiprocessing.get_start_method(allow_none=True)
    torch.multiprocessing.set_start_method("forkserver", force=True)
    yield
    torch.multiprocessing.set_start_method(before, force=True)


_PROGRAM = """
import os, sys, types
os.setsid()
os.environ.clear()
os.environ.update(environment)
os.chdir(folder)
for number, path in enumerate(outputs, 1):
    os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))
sys.argv = arguments
sys.path.insert(0, os.path.dirname(arguments[0]))
sys.modules["__main__"] = main = types.ModuleType("__main__")
main.__file__ = arguments[0]
exec(compile(code, arguments[0], "exec"), vars(main))
"""


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., subprocess.CompletedProcess[str]]:
    """``program("examples/a.py", "b", folder=tmp_path)`` runs a script of the repository, or ``code`` in its
    place, in a process of its own: as ``python examples/a.py b`` does, but for the seconds of imports."""
    context, root = multiprocessing.get_context("forkserver"), Path(__file__).parents[1]

    def run(
        script: str, *arguments: object, folder: Path, code: str = "", seconds: float = 500.0
    ) -> subprocess.CompletedProcess[str]:
        path = str(root / script)
        outputs = [tmp_path_factory.mktemp("program") / name for name in ("out", "err")]
        given = {
            "arguments": [path, *map(str, arguments)],
            "code": code or Path(path).read_text(encoding="utf-8"),
            "environment": dict(os.environ),
            "folder": str(folder),
            "outputs": [str(output) for output in outputs],
        }
        process = context.Process(target=exec, args=(_PROGRAM, given))
        process.start()
        process.join(seconds)
        if process.exitcode is None and process.pid is not None:
            os.killpg(process.pid, signal.SIGKILL)  # a child that hangs, too
            process.join()
        out, err = (output.read_text(encoding="utf-8") for output in outputs)
        return subprocess.CompletedProcess(given["arguments"], process.exitcode, out, err)

    return run


@pytest.fixture
def wandb_records() -> Callable[[Path], list[dict[str, Any]]]:
    """The records of an ended run's .wandb file or folder, as wandb's own reader gives them."""

    def read(path: Path) -> list[dict[str, Any]]:
        command = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", str(path)]
        deadline = time.monotonic() + 60.0  # wandb's service writes the file, on a busy machine seconds late
        while True:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            records = [json.loads(line) for line in done.stdout.splitlines()]
            if any(record["type"] == "exit" for record in records) or time.monotonic() > deadline:
                assert records, done.stderr
                return records

    return read


# Scene files as another program would write them.


@pytest.fixture
def make_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scene file by h5py alone, as another program would; any dataset replaced or left out."""

    def make(name: str = "room.h5", attributes: dict[str, Any] | None = None, **changes: Any) -> Path:
        # A ring of five states: action 0 onwards, action 1 back, action 2 always blocked.
        states = np.arange(5)
        graph = np.stack([(states + 1) % 5, (states - 1) % 5, np.full(5, -1)], axis=1)
        datasets = {
            "graph": graph,
            "resnet_feature": np.random.default_rng(0).standard_normal((5, 2, 7)).astype(np.float32),
            "location": np.stack([states * 0.5, states * 0.25], axis=1),
            "rotation": states * 90 % 360,
            "shortest_path_distance": shortest_path_distances(graph).numpy().astype(np.int64),
        }
        datasets.update(changes)
        path = tmp_path / name
        with h5py.File(path, "w") as file:
            for key, value in datasets.items():
                if value is not None:
                    file[key] = value
            file.attrs.update(attributes or {})
        return path

    return make


@pytest.fixture
def pictures() -> np.ndarray:
    """Five different pictures, (5, 6, 8, 3)."""
    return np.random.default_rng(1).integers(0, 256, (5, 6, 8, 3), dtype=np.uint8)


# Policies whose walks can be foretold.


class Guide(TensorDictModuleBase):
    """Walks the shortest path, the lowest action first."""

    in_keys: ClassVar = ["state_id", "goal_id"]
    out_keys: ClassVar = ["action"]

    def __init__(self, scenes: SceneSet) -> None:
        super().__init__()
        self.scenes = scenes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        reached = self.scenes.successor[tensordict["state_id"][..., -1]]
        left = self.scenes.distance(reached, tensordict["goal_id"].unsqueeze(-1))
        left = torch.where(left < 0, 10**6, left)
        return tensordict.set("action", left.argmin(-1))


class Turner(TensorDictModuleBase):
    """Does the same thing all the time."""

    in_keys: ClassVar = ["state_id"]
    out_keys: ClassVar = ["action"]

    def __init__(self, action: int) -> None:
        super().__init__()
        self.action = action

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", torch.full_like(tensordict["goal_id"], self.action))


class Dice(TensorDictModuleBase):
    """Walks at random; counts the rows that it was asked about."""

    in_keys: ClassVar = ["state_id"]
    out_keys: ClassVar = ["action"]
    rows = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.rows += tensordict.numel()
        return tensordict.set("action", torch.randint(4, tensordict.shape))


class Counter(TensorDictModuleBase):
    """Has a memory: forward on every third step of its own counting, else it turns right."""

    in_keys: ClassVar = ["state_id", "count", "is_init"]
    out_keys: ClassVar = ["action", ("next", "count")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        count = tensordict.get("count", torch.zeros(*tensordict.shape, 1, dtype=torch.int64))
        assert torch.equal(tensordict["is_init"], count == 0)
        tensordict["action"] = torch.where(count.squeeze(-1) % 3 == 2, 0, 1)
        tensordict["next", "count"] = count + 1
        return tensordict


@pytest.fixture
def rooms(make_scene: Callable[..., Scene]) -> SceneSet:
    """Two rooms, 16 and 24 states."""
    return SceneSet([make_scene("hall"), make_scene("attic", width=3)])


@pytest.fixture
def island(make_scene: Callable[..., Scene]) -> SceneSet:
    """A corridor of 4 states (the last a trap that one enters and never leaves) and a state that none
    enters."""
    graph = torch.tensor([[1, -1], [2, 0], [3, 1], [-1, -1], [0, -1]])
    return SceneSet([Scene("trap", graph, torch.rand(5, 1, 4))])


@pytest.fixture
def guide(rooms: SceneSet) -> Guide:
    return Guide(rooms)


@pytest.fixture
def policies() -> dict[str, type]:
    return {"guide": Guide, "turner": Turner, "dice": Dice, "counter": Counter}
