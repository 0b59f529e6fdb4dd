"""Functions as commands: parameters become arguments and options, docstrings their help.

A parameter that may be given by position is an argument, a keyword-only one an option. Options that take a
list take all words up to the next option, ``--seeds 0 1 2``.
"""

from __future__ import annotations

import functools
import inspect
import re
import signal
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from operator import getitem
from typing import Annotated, Any, get_type_hints

import typer
from typer.core import TyperCommand

from vusfa.errors import VusfaError

__all__ = ["as_command", "forward", "make_app", "run_functions"]


class _ListCommand(TyperCommand):
    """Lets an option take several words: ``--seeds 0 1`` is ``--seeds 0 --seeds 1``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option's name before each word."""
        lists = {name for param in self.params if getattr(param, "multiple", False) for name in param.opts}
        option, words = "", []
        for word in args:
            if word.startswith("--"):
                option = word if word in lists else ""
                words += [] if option else [word]
            else:
                words += [option, word] if option else [word]
        return super().parse_args(ctx, words)


def as_command(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function as typer reads it: the help of each parameter is that of the docstring's ``Args``.

    >>> def walk(goal: int, *, steps: int = 500) -> None:
    ...     '''Walk to a goal.
    ...
    ...     Args:
    ...         goal: its id.
    ...         steps: actions allowed.
    ...     '''
    >>> inspect.signature(as_command(walk)).parameters["steps"].annotation.__metadata__[0].help
    'actions allowed.'
    """
    text, _, arguments = inspect.cleandoc(function.__doc__ or "").partition("\nArgs:\n")
    arguments = re.split(r"\n\S", arguments)[0]
    helps = {
        name: " ".join(words.split())
        for names, words in re.findall(r"^    (\w[\w, ]*): (.*(?:\n {8}.*)*)", arguments, re.MULTILINE)
        for name in names.split(", ")
    }
    hints, parameters = get_type_hints(function), []
    for name, parameter in inspect.signature(function).parameters.items():
        kind = typer.Option if parameter.kind is parameter.KEYWORD_ONLY else typer.Argument
        annotation: Any = getitem(Annotated, (hints[name], kind(help=helps.get(name, ""))))
        parameters.append(parameter.replace(annotation=annotation, kind=parameter.POSITIONAL_OR_KEYWORD))

    @functools.wraps(function)
    def command(**values: Any) -> None:
        try:
            function(**values)
        except VusfaError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as interrupt:
            typer.echo(f"error: {str(interrupt) or 'interrupted'}", err=True)
            raise typer.Exit(130) from interrupt

    command.__doc__ = text
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    del command.__wrapped__
    return command


def make_app(functions: Mapping[str, Callable[..., Any]]) -> typer.Typer:
    """An application of functions by name; one called "" is the application itself."""
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    for name, function in functions.items():
        app.command(name or None, cls=_ListCommand)(as_command(function))
    return app


def run_functions(function: Callable[..., Any] | None = None, /, **subcommands: Callable[..., Any]) -> None:
    """Run a function, or one of several by name, with the process's command line, and end the process.

    Exit codes: 0 done, 1 an error that the user can mend (one line on stderr), 2 a wrong command line, 130
    Ctrl-C, 143 SIGTERM.
    """
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    make_app(subcommands if function is None else {"": function})()


def forward(app: typer.Typer, name: str, words: str, functions: Mapping[str, str]) -> None:
    """Add functions to an application as one command that imports them when it runs.

    Args:
        app: gets the command.
        name: of the command.
        words: its help in the list of commands.
        functions: ``module.function`` by the subcommand's name; "" where there is one function.
    """

    @app.command(
        name,
        help=words,
        add_help_option=False,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def command(context: typer.Context) -> None:
        try:
            found = {key: _import(place) for key, place in functions.items()}
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("vusfa"):
                raise
            typer.echo(f"error: {error}: pip install 'vusfa[recipes,report]'", err=True)
            raise typer.Exit(1) from error
        make_app(found)(args=context.args, prog_name=context.command_path)


def _import(place: str) -> Callable[..., Any]:
    module, _, name = place.rpartition(".")
    return getattr(import_module(module), name)
