"""The errors that a user can cause and mend.

Each message names the culprit (a file, a field, a state, a key of a configuration) and says what to do about
it. They derive from :class:`ValueError`, so that code which knows nothing of this package can still catch
them.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

__all__ = [
    "ActionError",
    "CameraError",
    "CheckpointError",
    "ConfigError",
    "GoalError",
    "RankError",
    "ResultError",
    "SceneError",
    "VusfaError",
    "WorkerError",
    "check_choices",
    "near",
    "printable",
]

# Control characters but tab and newline, marks that turn the direction of text, halves of characters.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_LONG = re.compile(r"\S{1001,}")


def printable(text: str) -> str:
    r"""Text of a file, such as a scene's name, as a terminal may get it: what would move its cursor, set its
    colors or turn its direction is spelled out.

    >>> printable("hall\x1b[2J")
    'hall\\x1b[2J'
    """
    return _UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def bounded(text: str) -> str:
    """Text whose words of more than 1,000 characters, a value of a command line, are cut.

    >>> len(bounded(f"folder is '{'x' * 100_000}'; give another"))
    526
    """
    return _LONG.sub(lambda match: f"{match[0][:400]}...{match[0][-100:]}", text)


def near(word: object, choices: Iterable[object], otherwise: str | None = None) -> str:
    """The end of a message on an unknown word: the choice that it resembles most, or what there is.

    Args:
        word: what was given.
        choices: what there is.
        otherwise: the end where it resembles none, in place of a list of all choices.

    >>> near("optm", ["optim", "env"]), near("x", ["optim", "env"])
    ("did you mean 'optim'?", 'there are optim, env')
    """
    names = [str(choice) for choice in choices]
    found = difflib.get_close_matches(str(word)[:200], names, n=1)
    return f"did you mean {found[0]!r}?" if found else otherwise or f"there are {', '.join(names)}"


def check_choices(name: str, given: Iterable[object], choices: Iterable[object]) -> None:
    """Refuse words that are none of the choices.

    >>> check_choices("models", ["gvf", "vufsa"], ["gvf", "vusfa"])
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: models has 'vufsa'; did you mean 'vusfa'?
    """
    names = [str(choice) for choice in choices]
    for word in given:
        if str(word) not in names:
            raise ConfigError(f"{name} has {str(word)[:200]!r}; {near(word, names)}")


class VusfaError(ValueError):
    """Base of every error that bad input causes.

    >>> raise VusfaError("room.h5: dataset 'graph' is missing; write it as (N, A) int64")
    Traceback (most recent call last):
    ...
    vusfa.errors.VusfaError: room.h5: dataset 'graph' is missing; write it as (N, A) int64
    """

    def __str__(self) -> str:
        """The message, :func:`printable` and its words :func:`bounded`, for it often holds what a file or a
        command line says."""
        return bounded(printable(super().__str__()))


class SceneError(VusfaError):
    """A scene file or a set of scenes that cannot be used."""


class GoalError(VusfaError):
    """A goal that does not exist or that nothing can reach."""


class CheckpointError(VusfaError):
    """A checkpoint that is damaged, or that belongs to another model or other scenes."""


class CameraError(VusfaError):
    """A camera, stream or folder of pictures that cannot be read."""


class ActionError(VusfaError, IndexError):
    """An action that does not exist, or none at all."""


class ConfigError(VusfaError):
    """A configuration with a key or a value that nothing understands."""


class ResultError(VusfaError):
    """Results on disk that are damaged, or that cannot be written so."""


class WorkerError(VusfaError):
    """A process that collects data has died, does not answer, or cannot start."""


class RankError(WorkerError):
    """A rank of a data-parallel training is gone, or could not begin.

    Args:
        message: which one, and what has become of it.
        is_quiet: another rank reports it.
    """

    def __init__(self, message: str, is_quiet: bool = False) -> None:
        super().__init__(message)
        self.is_quiet = is_quiet
