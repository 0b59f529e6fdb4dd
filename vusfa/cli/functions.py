"""The grammar of all commands, and functions as commands: parameters become arguments, docstrings their help.

Positional parameters are arguments, keyword-only ones options. Options are written like settings of a
training, ``seeds=[0,1,2]``, or with dashes, ``--seeds 0 1 2``.
"""

from __future__ import annotations

import functools
import inspect
import math
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from operator import getitem
from typing import Annotated, Any, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from vusfa.cli import Forwarded
from vusfa.errors import ConfigError, VusfaError, printable
from vusfa.limits import RANGES, brief, one_line

__all__ = ["App", "Commands", "as_command", "forward", "make_app", "run_functions"]

_UsageError: Any = typer.BadParameter.__mro__[1]  # typer does not export it


@contextmanager
def _one_line_of_usage() -> Iterator[None]:
    """Context that reports a wrong command line as one line and exit code 2, without a box around it."""
    try:
        yield
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # whose text is the help
            raise
        typer.echo(f"error: {_usage(error)}", err=True)
        raise typer.Exit(2) from error


def _usage(error: Any) -> str:
    """What is wrong with a command line: the option, its value, and where the help is."""
    param, text = getattr(error, "param", None), one_line(error.format_message()).rstrip(".")
    found: list[Any] = getattr(error.__cause__, "errors", list)()  # of pydantic, which has the value
    if param is not None and found:
        said = one_line(found[0]["msg"]).removeprefix("Value error, ").rstrip(".")
        said = said.replace("Input should", "it should", 1)
        text = f"{param.name} is {brief(found[0]['input'])}; {said}"
    context = getattr(error, "ctx", None)
    mend = f"; {context.command_path} --help lists what there is" if context is not None else ""
    return printable(f"{text[:1].lower()}{text[1:]}{mend}")


def check_numbers(values: Mapping[str, Any]) -> None:
    """Refuse numbers of a command line that are not in their range of :data:`vusfa.limits.RANGES`, that no
    processor counts to, or that are not finite.

    >>> check_numbers({"max_steps": 10**9})
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: max_steps is 1000000000; give 1 to 100,000
    """
    for name, value in values.items():
        for number in value if isinstance(value, list | tuple) else [value]:
            if type(number) not in (int, float):
                continue
            least, most = RANGES.get(name, (-(2**63), 2**63 - 1))
            if not least <= number <= most or not math.isfinite(number):
                what = f"{least:,} to {most:,}" if name in RANGES else "a number that a computer can count to"
                raise ConfigError(f"{name} is {brief(number)}; give {what}")


class Commands(TyperGroup):
    """A group of commands; a wrong command line is one line of error."""

    def make_context(self, *given: Any, **extra: Any) -> Any:
        """Read the group's own options."""
        with _one_line_of_usage():
            return super().make_context(*given, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the context names."""
        with _one_line_of_usage():
            return super().invoke(ctx)


class Command(TyperCommand):
    """A command whose options may be written ``name=value``, and take lists: ``[0,1]``, ``--seeds 0 1``."""

    def make_context(self, *given: Any, **extra: Any) -> Any:
        """Read arguments and options, and check their numbers before any work."""
        with _one_line_of_usage():
            context = super().make_context(*given, **extra)
        try:
            check_numbers(context.params)
        except ConfigError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from error
        return context

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Write every option as click reads it: ``--name=value``, once per value."""
        options = {
            name: param for param in self.params if isinstance(param, TyperOption) for name in param.opts
        }
        # the file to write is an argument of some commands, an option of others: out=FILE is right for all
        positional = "--out" not in options and any(param.name == "target" for param in self.params)
        words: list[str] = []
        targets: list[str] = []
        taking: TyperOption | None = None  # the preceding option, if it takes values
        for place, word in enumerate(args):
            name, equals, value = word.partition("=")
            setting = options.get("--" + name.replace("_", "-")) if equals and name.isidentifier() else None
            if word == "--":
                words += args[place:]
                break
            if word.startswith("-") and len(word) > 1:
                taking = options.get(word)
                if taking is not None and taking.is_flag:
                    taking = None
                words += [] if taking is not None and taking.multiple else [word]
            elif taking is not None and not taking.multiple:
                words, taking = [*words, word], None
            elif positional and equals and name in ("out", "target"):
                taking, targets = None, [*targets, value]
            elif setting is not None:
                taking = None
                words += _spelled(setting, value)
            else:
                words += [word] if taking is None else [taking.opts[0], word]
        return super().parse_args(ctx, [*words, *targets])


def _spelled(option: TyperOption, value: str) -> list[str]:
    """An option with dashes; a flag's value is ``true`` or ``false``."""
    if option.is_flag:
        spelled = {"true": option.opts[:1], "false": option.secondary_opts[:1]}
        return spelled.get(value.lower(), [f"{option.opts[0]}={value}"])  # click refuses the latter
    if option.multiple:
        return [f"{option.opts[0]}={item.strip()}" for item in value.strip("[]").split(",") if item.strip()]
    return [f"{option.opts[0]}={value}"]


class App(typer.Typer):
    """A group of commands with the same grammar and style of help."""

    def __init__(self, **settings: Any) -> None:
        looks: dict[str, Any] = {
            "cls": Commands,
            "no_args_is_help": True,
            "rich_markup_mode": "markdown",
            "pretty_exceptions_enable": False,
            "context_settings": {"help_option_names": ["-h", "--help"]},
        }
        super().__init__(**{**looks, **settings})

    def command(self, name: str | None = None, **settings: Any) -> Any:
        """Register a command, see :class:`typer.Typer`."""
        return super().command(name, **{"cls": Command, **settings})


def as_command(function: Callable[..., Any]) -> Callable[..., Any]:
    """Convert a function for typer: the docstring's ``Args`` become the help of each parameter.

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
        except Exception as error:  # Hydra's, for a setting among the arguments
            if type(error).__module__.partition(".")[0] not in ("hydra", "omegaconf"):
                raise
            from vusfa.cli.launch import explain
            from vusfa.conf import FOLDER

            typer.echo(f"error: {explain(error, FOLDER)}", err=True)
            raise typer.Exit(2) from error

    command.__doc__ = text
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    del command.__wrapped__
    return command


def make_app(functions: Mapping[str, Callable[..., Any]], examples: Sequence[str] = ()) -> typer.Typer:
    """Make an application of functions; one named "" is the application itself.

    Args:
        functions: functions by name.
        examples: command lines; each is shown in its function's help.
    """
    app = App(add_completion=False, no_args_is_help="" not in functions)
    for name, function in functions.items():
        command = as_command(function)
        own = [line for line in examples if not name or line.split()[2] == name]
        if own:
            command.__doc__ = f"{command.__doc__}\n\nExamples:\n\n" + "".join(f"    {line}\n" for line in own)
        app.command(name or None)(command)
    return app


def run_functions(function: Callable[..., Any] | None = None, /, **subcommands: Callable[..., Any]) -> None:
    """Run a function, or one of several by name, with the process's command line, and end the process.

    Exit codes: 0 done, 1 an error that the user can mend (one line on stderr), 2 a wrong command line, 130
    Ctrl-C, 143 SIGTERM.
    """
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    make_app(subcommands if function is None else {"": function})()


def forward(app: typer.Typer, name: str, forwarded: Forwarded) -> None:
    """Add functions to an application as one command that imports them when it runs.

    Args:
        app: application to extend.
        name: name of the command.
        forwarded: functions to run.
    """

    @app.command(
        name,
        help=forwarded.words,
        rich_help_panel=forwarded.panel,
        add_help_option=False,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def command(context: typer.Context) -> None:
        try:
            found = {key: _import(place) for key, place in forwarded.functions.items()}
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("vusfa"):
                raise
            typer.echo(f"error: {error}: pip install 'vusfa[recipes,report]'", err=True)
            raise typer.Exit(1) from error
        make_app(found, forwarded.examples)(args=context.args, prog_name=context.command_path)


def _import(place: str) -> Callable[..., Any]:
    module, _, name = place.rpartition(".")
    return getattr(import_module(module), name)
