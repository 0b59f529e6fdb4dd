"""The Typer application and the error handling of all commands."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from vusfa import __version__
from vusfa.cli import COMMANDS, FUNCTIONS, TRAINING_COMMANDS
from vusfa.cli.functions import forward
from vusfa.errors import VusfaError

__all__ = ["app", "scenes"]


class _Commands(TyperGroup):
    """Turns what ends a command early into a line and an exit code, for every command alike."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the context names."""
        try:
            return super().invoke(ctx)
        except VusfaError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as interrupt:
            typer.echo("stopped", err=True)
            raise typer.Exit(130) from interrupt


_LOOKS: dict[str, Any] = {
    "no_args_is_help": True,
    "rich_markup_mode": "markdown",
    "context_settings": {"help_option_names": ["-h", "--help"]},
}

#: ``vusfa``
app = typer.Typer(cls=_Commands, pretty_exceptions_enable=False, **_LOOKS)
#: ``vusfa scenes``: the commands of :data:`vusfa.cli.COMMANDS` are registered here
scenes = typer.Typer(**_LOOKS)
app.add_typer(scenes, name="scenes", help="Scenes: look at them, check them, make your own.")


def _show_version(requested: bool) -> None:
    if requested:
        typer.echo(f"vusfa {__version__}")
        raise typer.Exit


@app.callback()
def _vusfa(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Say which version it is."),
    ] = False,
) -> None:
    """Target-driven visual navigation with universal successor features."""


for _name in TRAINING_COMMANDS:
    import_module(_name).register(app)
for _name, (_words, _functions) in FUNCTIONS.items():
    forward(app, _name, _words, _functions)
for _name in COMMANDS:
    import_module(_name).register(scenes)
