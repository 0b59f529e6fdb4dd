"""Folder of a run: one process writes to it, no run is overwritten unasked, leftovers are removed."""

from __future__ import annotations

import itertools
import os
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from vusfa.cluster.locks import FileLock, LockedError
from vusfa.errors import ConfigError
from vusfa.files import check_file, check_folder, remove_leftovers

__all__ = ["AUTO", "BEST", "CHECKPOINT", "EPISODES", "RunFolder", "default_folder", "found_checkpoint"]

#: ``resume`` of a run that goes on if there is something to go on with.
AUTO = "auto"

#: The last checkpoint of a run, and the one with the best score of its evaluations during the training.
CHECKPOINT, BEST, EPISODES = "checkpoint.pt", "best.pt", "episodes.npz"
_OF_A_RUN = (CHECKPOINT, BEST, EPISODES, "metrics.csv", "validation.csv")
_EVALUATION = ("evaluation.csv", "evaluation.json", "evaluation_episodes.csv")
_LOCK = ".lock"


def default_folder(settings: Mapping[str, Any]) -> Path:
    """Default folder of a run, named after preset, model, scenes, seed and time.

    >>> settings = {"name": "fast", "agent": {"model": "gvf"}, "scenes": ["bathroom", "x/y.h5"], "seed": 3}
    >>> str(default_folder(settings).parent)
    'runs/fast-gvf-bathroom+y-seed3'
    """
    scenes = [settings["scenes"]] if isinstance(settings["scenes"], str) else settings["scenes"]
    stems = [Path(scene).stem for scene in scenes]
    shown = "+".join(stems) if len(stems) <= 3 else f"{len(stems)}_scenes"
    parts = settings["name"], settings["agent"]["model"], shown, f"seed{settings['seed']}"
    name = re.sub(r"[^\w.+-]", "_", "-".join(parts))
    return Path("runs", name[:120], time.strftime("%Y-%m-%d_%H-%M-%S"))


def found_checkpoint(folder: str | Path | None) -> str | None:
    """The checkpoint that ``resume=auto`` goes on with, or None.

    Raises:
        ConfigError: no folder was given.
    """
    if folder is None:
        raise ConfigError("resume=auto looks into the run's folder; give folder=, too")
    path = Path(folder, CHECKPOINT)
    return str(path) if path.is_file() else None


class RunFolder:
    """Context manager that gives this process exclusive use of a run's folder.

    Args:
        path: the folder; None for :func:`default_folder`, which no other run gets.
        settings: of the run: ``resume``, ``overwrite``, and what the default's name says.

    Attributes:
        path: the folder; made on entry.

    Raises:
        ConfigError: it cannot be written, or a run is in it, or is being written to it.
    """

    def __init__(self, path: str | Path | None, settings: Mapping[str, Any]) -> None:
        self._settings, self._unnamed = settings, path is None
        self.path = check_folder(default_folder(settings) if path is None else path, "folder")
        self._made: list[Path] = []
        self._lock: FileLock | None = None
        if not self._unnamed:
            self._refuse_other_run()

    def __enter__(self) -> RunFolder:
        self._make()
        self._refuse_other_run()
        remove_leftovers(self.path)
        for name in ("config.json", *_OF_A_RUN, *_EVALUATION):
            check_file(self.path / name)
        if self._settings["overwrite"] and not self._resumes_here():
            for name in (*_OF_A_RUN, *_EVALUATION):
                with suppress(OSError):
                    (self.path / name).unlink()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._lock is not None:
            self._lock.release()
        for place in reversed(self._made):  # a run that did not begin leaves nothing
            with suppress(OSError):
                place.rmdir()

    def _make(self) -> None:
        base = self.path
        for number in itertools.count(2):
            missing = [place for place in (self.path, *self.path.parents) if not place.exists()]
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.path.mkdir(exist_ok=not self._unnamed)
                self._made = missing[::-1]
                return self._claim()
            except FileExistsError as error:
                if not self._unnamed:
                    raise ConfigError(f"folder is '{self.path}', which is a file; give another") from error
                self.path = base.with_name(f"{base.name}-{number}")
            except OSError as error:
                raise ConfigError(f"folder is '{self.path}': {error.strerror}; give another") from error

    def _claim(self) -> None:
        """Take the lock, which ends with this process in any case."""
        self._lock = FileLock(self.path / _LOCK)
        try:
            self._lock.acquire()
        except LockedError as error:
            raise ConfigError(
                f"folder is '{self.path}', where {error.owner} is writing a run; wait for it, or give another"
                " folder"
            ) from error

    def _resumes_here(self) -> bool:
        resume = self._settings["resume"]
        return resume is not None and Path(resume).resolve().parent == self.path.resolve()

    def _refuse_other_run(self) -> None:
        taken = os.path.lexists(self.path / CHECKPOINT)
        if taken and not self._settings["overwrite"] and not self._resumes_here():
            raise ConfigError(
                f"folder is '{self.path}', where a run is already ({CHECKPOINT}); give resume=auto to go on"
                " with it, another folder, or overwrite=true to replace it"
            )
