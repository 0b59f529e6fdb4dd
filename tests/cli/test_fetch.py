"""vusfa scenes fetch, from a local server."""

from __future__ import annotations

import threading
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from vusfa.scenes import Scene


@pytest.fixture(autouse=True)
def _progress_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done within a moment is told, too."""
    monkeypatch.setattr("vusfa.cli.progress._BRIEF", 0.0)


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.fixture
def mirror(tmp_path: Path, make_scene: Callable[..., Scene]) -> Iterator[str]:
    """An address with an archive of two small rooms."""
    served = tmp_path / "served"
    served.mkdir()
    with zipfile.ZipFile(served / "rooms.zip", "w") as file:
        for name in ("one", "two"):
            make_scene(name).save(tmp_path / f"{name}.h5")
            file.write(tmp_path / f"{name}.h5", f"dumps/{name}.h5")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(served))) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/rooms.zip"
        server.shutdown()
        thread.join()


@pytest.fixture
def config(tmp_path: Path, mirror: str) -> Path:
    path = tmp_path / "archives.yaml"
    scenes, patience = "{one: 16, two: 16}", "{attempts: 1, pause: 0.01}"
    path.write_text(f"rooms: {{mirrors: ['{mirror}'], scenes: {scenes}, patience: {patience}}}")
    return path


def test_rooms_arrive(run: Callable[..., Any], config: Path, mirror: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run("fetch", "rooms", "--out", out, "--config", config)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"{out}/one.h5: 16 states\n{out}/two.h5: 16 states\n"
    assert f"fetching {mirror}" in result.stderr
    assert "MB" in result.stderr
    assert run("check", out / "one.h5", out / "two.h5").exit_code == 0
    again = run("fetch", "rooms", "-o", out, "--config", config)
    assert "all scenes are there and sound" in again.stderr


def test_a_mirror_that_is_named_replaces_the_others(
    run: Callable[..., Any], config: Path, mirror: str, tmp_path: Path
) -> None:
    config.write_text(config.read_text().replace(mirror, "http://127.0.0.1:9/none.zip"))
    out = tmp_path / "out"
    failed = run("fetch", "rooms", "--out", out, "--config", config)
    assert failed.exit_code == 1
    assert "error: rooms: no mirror gave it; name another one" in failed.stderr
    assert run("fetch", "rooms", "--out", out, "--config", config, "--mirror", mirror).exit_code == 0


def test_an_unknown_archive(run: Callable[..., Any], tmp_path: Path) -> None:
    result = run("fetch", "thor-v2", "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr == "error: no archive is called 'thor-v2'; there are thor-v1\n"
    assert not (tmp_path / "out").exists()
