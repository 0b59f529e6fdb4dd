from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner

from vusfa.cli.app import app


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """``run("list", "bathroom")`` runs ``vusfa scenes list bathroom``; gives exit_code, stdout, stderr."""
    # Messages are not cut at the width of whoever runs the tests, nor coloured.
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")

    def run_scenes(*arguments: object) -> Any:
        return CliRunner().invoke(app, ["scenes", *map(str, arguments)])

    return run_scenes
