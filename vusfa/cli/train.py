"""``vusfa train``: train an agent and evaluate it; settings are written as for Hydra."""

from __future__ import annotations

import sys
from typing import Any

import typer

__all__ = ["register"]

#: Hydra itself reads everything after ``train``, ``--help`` included.
_HYDRA: dict[str, Any] = {
    "add_help_option": False,
    "context_settings": {
        "allow_extra_args": True,
        "ignore_unknown_options": True,
        "allow_interspersed_args": False,
        "help_option_names": [],
    },
}

#: Hydra's options; everything else is a setting.
_HYDRA_OPTIONS = {
    *("help", "hydra-help", "version", "cfg", "resolve", "package", "run", "multirun", "info"),
    *("shell-completion", "config-path", "config-name", "config-dir", "experimental-rerun"),
}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("train", rich_help_panel="Agents", **_HYDRA)(train)


def train(context: typer.Context) -> None:
    """Train an agent and evaluate it: vusfa train SETTING=VALUE ..."""
    try:
        from vusfa.cli.launch import launch
        from vusfa.cli.ray_train import train_on_ray
        from vusfa.experiments import training
        from vusfa.report.media import draw_media
    except ModuleNotFoundError as error:
        typer.echo(f"error: vusfa train needs {error.name}: pip install 'vusfa[recipes]'", err=True)
        raise typer.Exit(1) from error

    for word in context.args:
        name, _, value = word.removeprefix("--").partition("=")
        if word.startswith("--") and name and name not in _HYDRA_OPTIONS:
            setting = f"{name.replace('-', '_')}={value or 'VALUE'}"
            typer.echo(f"error: {word}: settings are written without dashes, {setting}", err=True)
            raise typer.Exit(2)

    def job(settings: dict[str, Any], overrides: list[str]) -> int:
        if settings["cluster"]["kind"]:
            return train_on_ray(settings, overrides, draw_media)
        return training.train(settings, overrides, draw_media).exit_code

    sys.argv = ["vusfa train", *context.args]
    launch(job)
