"""Functions as commands."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
from typer.testing import CliRunner

from vusfa.cli import FUNCTIONS, main
from vusfa.cli.functions import make_app
from vusfa.errors import ConfigError

calls: list[tuple[object, ...]] = []


def walk(
    goals: list[str],
    *,
    seeds: list[int] = [0],  # noqa: B006
    mode: Literal["sampled", "greedy"] = "sampled",
    out: Path | None = None,
    again: bool = False,
) -> None:
    """Walk to goals.

    Args:
        goals: their ids,
            or names.
        seeds, mode: of the actions.
        out: where to.
        again: once more.
    """
    if goals == ["none"]:
        raise ConfigError("no goals")
    calls.append((goals, seeds, mode, out, again))


def test_lists_literals_and_help() -> None:
    runner, app = CliRunner(), make_app({"": walk})
    line = ["a", "b", "--seeds", "3", "4", "--mode", "greedy", "--out", "x", "--again"]
    assert runner.invoke(app, line).exit_code == 0
    assert calls.pop() == (["a", "b"], [3, 4], "greedy", Path("x"), True)
    assert runner.invoke(app, ["a"]).exit_code == 0
    assert calls.pop() == (["a"], [0], "sampled", None, False)
    text = runner.invoke(app, ["--help"], env={"COLUMNS": "120"}).output
    for words in ("Walk to goals.", "their ids, or names.", "of the actions.", "[default: 0]"):
        assert words in text
    assert "Args" not in text


def test_faults_in_one_line() -> None:
    done = CliRunner().invoke(make_app({"": walk}), ["none"])
    assert (done.exit_code, done.stderr) == (1, "error: no goals\n")
    assert CliRunner().invoke(make_app({"": walk}), ["a", "--mode", "other"]).exit_code == 2


@pytest.mark.parametrize("name", FUNCTIONS)
def test_all_have_help(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.cli.signal.signal", lambda *_: None)  # SIGTERM stays pytest's
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert not ended.value.code
    assert f"Usage: vusfa {name}" in capsys.readouterr().out
