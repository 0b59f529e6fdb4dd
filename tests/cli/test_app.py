"""What all commands have in common: help, errors, signals."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from vusfa import __version__
from vusfa.cli import COMMANDS, main
from vusfa.cli.app import app, scenes

NAMES = [str(command.name) for command in scenes.registered_commands]


def test_every_module_adds_commands() -> None:
    assert {"list", "show", "check", "from-photos"} <= set(NAMES)
    assert len(NAMES) >= len(COMMANDS)
    assert len(set(NAMES)) == len(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_command_explains_itself_by_examples(run: Callable[..., Any], name: str) -> None:
    result = run(name, "--help")
    assert result.exit_code == 0
    assert "Examples:" in result.stdout
    assert f"vusfa scenes {name}" in result.stdout.partition("Examples:")[2]


def test_help_without_arguments_and_the_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"vusfa {__version__}\n")
    assert "scenes" in CliRunner().invoke(app, []).output


def test_an_error_is_one_line_and_exit_code_1(run: Callable[..., Any]) -> None:
    result = run("show", "attic")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith("error: 'attic' is neither a bundled scene (bathroom, ")
    assert result.stderr.count("\n") == 1


def test_ctrl_c_is_exit_code_130(run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> list[str]:
        raise KeyboardInterrupt

    monkeypatch.setattr("vusfa.scenes.validate", stop)
    result = run("check", "x.h5")
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "stopped\n")


def test_errors_of_the_program_are_not_hidden(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.scenes.validate", lambda *_: 1 / 0)
    assert isinstance(run("check", "x.h5").exception, ZeroDivisionError)


@pytest.mark.parametrize(
    "arguments", [("check",), ("compact", "-"), ("encode", "-")], ids=lambda given: given[0]
)
@pytest.mark.parametrize("name", ["a" * 5000, "file/x.h5"])
def test_names_that_no_file_can_have_are_one_line(
    run: Callable[..., Any], tmp_path: Path, name: str, arguments: tuple[str, ...]
) -> None:
    (tmp_path / "file").touch()
    command, *rest = arguments
    result = run(command, tmp_path / name, *(tmp_path / "target.h5" for _ in rest))
    assert result.exit_code == 1
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    assert len(result.stderr) < 1000 or "file/x.h5" in name


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_process_that_cleans_up(
    number: signal.Signals, code: int, program: Callable[..., Any], tmp_path: Path
) -> None:
    text = f"""
import os, time, vusfa.scenes, vusfa.cli
def hang(*_):
    try:
        os.kill(os.getpid(), {int(number)})
        time.sleep(30)
    finally:
        print("cleaned up")
vusfa.scenes.validate = hang
vusfa.cli.main(["scenes", "check", "x.h5"])
"""
    done = program("vusfa", folder=tmp_path, code=text)
    assert (done.returncode, done.stdout) == (code, "cleaned up\n"), done.stderr
    assert "Traceback" not in done.stderr


def test_the_program_answers_without_loading_what_computes() -> None:
    program = """
import sys, vusfa.cli
try:
    vusfa.cli.main(["scenes", "--help"])
finally:
    print({"torch", "matplotlib", "h5py", "numpy"} & set(sys.modules), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "set()\n")
    assert all(name in done.stdout for name in NAMES)


def test_as_a_module() -> None:
    command = [sys.executable, "-m", "vusfa.cli", "scenes", "check", "no_such_room.h5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stdout == "no_such_room.h5: there is no such file; check the path\n"
    assert done.stderr == "error: 1 of 1 files have faults\n"


def test_without_typer_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setitem(sys.modules, "typer", None)
    monkeypatch.delitem(sys.modules, "vusfa.cli.app")
    try:
        with pytest.raises(SystemExit, match=r"^error: .*pip install 'vusfa\[scenes\]'$"):
            main([])
    finally:
        signal.signal(signal.SIGTERM, before)
