"""``vusfa train``: trains an agent and evaluates it; settings are given as to Hydra."""

from __future__ import annotations

import sys
from typing import Any

import typer

from vusfa.files import say

__all__ = ["register"]

#: Hydra reads everything behind ``train`` itself, ``--help`` included.
_HYDRA: dict[str, Any] = {
    "add_help_option": False,
    "context_settings": {
        "allow_extra_args": True,
        "ignore_unknown_options": True,
        "allow_interspersed_args": False,
        "help_option_names": [],
    },
}


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("train", **_HYDRA)(train)


def train(context: typer.Context) -> None:
    """Train an agent and evaluate it: vusfa train SETTING=VALUE ..."""
    try:
        from vusfa.cli.launch import launch
        from vusfa.experiments import training
    except ModuleNotFoundError as error:
        typer.echo(f"error: vusfa train needs {error.name}: pip install 'vusfa[recipes]'", err=True)
        raise typer.Exit(1) from error

    def job(settings: dict[str, Any], overrides: list[str]) -> int:
        trainer, _, exit_code = training.train(settings, overrides)
        say(f"{trainer.settings['folder']}/checkpoint.pt")
        return exit_code

    sys.argv = ["vusfa train", *context.args]
    launch(job)
