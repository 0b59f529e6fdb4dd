"""The errors that a user can cause and mend.

Each message names the culprit (a file, a field, a state, a key of a configuration) and says what to do about
it. They derive from :class:`ValueError`, so that code which knows nothing of this package can still catch
them.
"""

from __future__ import annotations

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
]


class VusfaError(ValueError):
    """Base of every error that bad input causes.

    >>> raise VusfaError("room.h5: dataset 'graph' is missing; write it as (N, A) int64")
    Traceback (most recent call last):
    ...
    vusfa.errors.VusfaError: room.h5: dataset 'graph' is missing; write it as (N, A) int64
    """


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
