"""What all tests share: where the golden numbers of the released code are, and small scenes."""

from __future__ import annotations

import itertools
import os
import signal
import zlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import torch.multiprocessing

from vusfa.errors import SceneError
from vusfa.scenes import Scene
from vusfa.scenes.render.catalogue import Catalogue

# A program that a shell script started in the background ignores Ctrl-C, and so do those that it starts. What
# the tests say of interruptions shall hold there, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

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
    """Tests marked ``render`` are skipped where a renderer is missing; under CI they fail there."""
    if not item.get_closest_marker("render"):
        return
    packages = ("mitsuba", "mitsuba_oidn", "trimesh", "efficientnet_lite_pytorch")
    missing = [name for name in packages if not find_spec(name)]
    try:
        Catalogue.open()
    except SceneError:
        missing.append("furniture (Debian's sweethome3d-furniture)")
    if missing:
        lacking(", ".join(missing))


def lacking(what: str) -> None:
    """Skip the test, or fail it under CI, where everything is to be there."""
    give_up = pytest.fail if os.environ.get("CI") else pytest.skip
    give_up(f"not installed: {what}")


@pytest.fixture
def needs_llvm() -> None:
    """The test renders with LLVM."""
    from vusfa.scenes.render.backend import choose_backend

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
def fast_workers() -> Iterator[None]:
    """Workers are forked from a server that has imported everything, instead of importing it each."""
    before = torch.multiprocessing.get_start_method(allow_none=True)
    torch.multiprocessing.set_forkserver_preload(["vusfa.training"])
    torch.multiprocessing.set_start_method("forkserver", force=True)
    yield
    torch.multiprocessing.set_start_method(before, force=True)


@pytest.fixture
def wandb_content() -> Callable[[Path], bytes]:
    """What a .wandb file holds, joined where its 32 KB blocks cut it."""

    def read(path: Path) -> bytes:
        data, place, parts = path.read_bytes(), 7, []  # behind the file's head
        while place + 7 <= len(data):
            left = 32768 - place % 32768
            if left < 7:  # padding: a record's head is not cut
                place += left
                continue
            length = int.from_bytes(data[place + 4 : place + 6], "little")  # behind a checksum
            parts.append(data[place + 7 : place + 7 + length])
            place += 7 + length
        return b"".join(parts)

    return read
