"""vusfa scenes compact."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vusfa.scenes import Scene

Run = Callable[..., Any]


def test_the_command(run: Run, make_file: Callable[..., Path], tmp_path: Path) -> None:
    target = tmp_path / "small.h5"
    result = run("compact", make_file(), target)
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.startswith(f"{target}: 0.0 MB, from 0.0 MB")
    assert Scene.load(target).num_states == 5


def test_the_command_refuses_a_faulty_file(run: Run, make_file: Callable[..., Path], tmp_path: Path) -> None:
    source, target = make_file(rotation=None), tmp_path / "small.h5"
    result = run("compact", source, target)
    assert result.exit_code == 1
    assert result.stderr == f"error: {source}: dataset 'rotation' is missing; write it as numbers (N,)\n"
    assert not target.exists()
