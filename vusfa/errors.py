"""The errors that a user can cause and mend.

Each message names the culprit (a file, a field, a state, a key of a configuration) and says what to do about
it. They derive from :class:`ValueError`, so that code which knows nothing of this package can still catch
them.
"""

from __future__ import annotations

import re

__all__ = [
    "ActionError",
    "CameraError",
    "CheckpointError",
    "ConfigError",
    "GoalError",
    "ResultError",
    "SceneError",
    "VusfaError",
    "WorkerError",
    "printable",
]

# Control characters but tab and newline, marks that turn the direction of text, halves of characters.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""Text of a file, such as a scene's name, as a terminal may get it: what would move its cursor, set its
    colors or turn its direction is spelled out.

    >>> printable("hall\x1b[2J")
    'hall\\x1b[2J'
    """
    return _UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


class VusfaError(ValueError):
    """Base of every error that bad input causes.

    >>> raise VusfaError("room.h5: dataset 'graph' is missing; write it as (N, A) int64")
    Traceback (most recent call last):
    ...
    vusfa.errors.VusfaError: room.h5: dataset 'graph' is missing; write it as (N, A) int64
    """

    def __str__(self) -> str:
        """The message, :func:`printable`, for it often holds what a file says."""
        return printable(super().__str__())


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
