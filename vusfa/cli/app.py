"""The Typer application and the error handling of all commands."""

from __future__ import annotations

import errno
from importlib import import_module
from typing import Annotated, Any

import typer

from vusfa import __version__
from vusfa.cli import COMMANDS, FIRST_STEPS, FUNCTIONS, TRAINING_COMMANDS
from vusfa.cli.functions import App, Commands, forward
from vusfa.cli.interrupts import out_of_memory
from vusfa.errors import VusfaError
from vusfa.limits import brief

__all__ = ["app", "scenes"]

#: What the system answers to a name that no file can have, or that leads nowhere.
_WRONG_NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR)


class _Commands(Commands):
    """Report an early end of any command as one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the context names."""
        try:
            return super().invoke(ctx)
        except VusfaError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from error
        except OSError as error:
            if error.errno not in _WRONG_NAMES or error.filename is None:
                raise
            typer.echo(f"error: {brief(str(error.filename))}: {error.strerror}; check the path", err=True)
            raise typer.Exit(1) from error
        except (MemoryError, RuntimeError) as error:
            if not out_of_memory(error):
                raise
            typer.echo("error: out of memory; close other programs, or allow more (ulimit)", err=True)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as interrupt:
            typer.echo("stopped", err=True)
            raise typer.Exit(130) from interrupt


#: ``vusfa``
app = App(cls=_Commands, epilog=FIRST_STEPS)
#: ``vusfa scenes``: the commands of :data:`vusfa.cli.COMMANDS` are registered here
scenes = App(epilog="Every command that reads a scene takes a bundled name or a file: bathroom, room.h5.")
app.add_typer(
    scenes, name="scenes", help="Look at scenes, check them, make your own.", rich_help_panel="Scenes"
)


def _show_version(requested: bool) -> None:
    if requested:
        typer.echo(f"vusfa {__version__}")
        raise typer.Exit


@app.callback()
def _vusfa(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Target-driven visual navigation with universal successor features."""


for _name in TRAINING_COMMANDS:
    import_module(_name).register(app)
for _name, _command in FUNCTIONS.items():
    forward(app, _name, _command)
for _name in COMMANDS:
    import_module(_name).register(scenes)
