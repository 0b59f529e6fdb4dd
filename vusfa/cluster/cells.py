"""Cells: an experiment's pieces of work, each with one result on disk, run here or by a launcher.

A cell whose result is there is done and skipped. While a process works on a cell it holds the lock
``.RESULT.lock`` beside the result, which ends with the process: two commands on one folder share its cells,
and a cell whose process was killed is run again. Whatever runs cells, on however many machines, is a
:data:`Launcher`: a function of jobs. This module has the one that runs them one after the other;
:mod:`vusfa.cluster` registers others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vusfa.cluster.locks import FileLock, LockedError
from vusfa.errors import ConfigError, ResultError, near
from vusfa.files import check_folder, say
from vusfa.limits import brief

__all__ = ["LAUNCHERS", "Cell", "Job", "Launcher", "register_launcher", "run_cell", "run_cells"]

#: A call that can be pickled; it returns a line to print, or None.
Job = Callable[[], "str | None"]
#: Calls every job at least once, in any order and process, and raises what a job raises. The second argument
#: has the launcher's options by name, as text.
Launcher = Callable[[Sequence[Job], Mapping[str, str]], None]


def serial(jobs: Sequence[Job], options: Mapping[str, str]) -> None:
    """Launcher that runs jobs one after the other, in this process; it has no options."""
    if options:
        raise ConfigError(f"launcher_options has {brief(min(options))}, but launcher=serial takes none")
    for job in jobs:
        if line := job():
            print(line, flush=True)


#: Launchers by name.
LAUNCHERS: dict[str, Launcher] = {"serial": serial}


def register_launcher(name: str, launcher: Launcher) -> None:
    """Add a launcher, or replace the one of that name.

    >>> register_launcher("backwards", lambda jobs, options: [job() for job in reversed(jobs)])
    >>> sorted(LAUNCHERS)[0], LAUNCHERS.pop("backwards") is not None
    ('backwards', True)
    """
    LAUNCHERS[name] = launcher


@dataclass(frozen=True)
class Cell:
    """One piece of work of an experiment.

    Attributes:
        result: file, or folder of a run (:mod:`vusfa.experiments.runs`), that is there when the cell is done.
        work: makes it, at once and complete, and returns what to print; a module's function, or a ``partial``
            of one, so that it can be pickled.
    """

    result: Path
    work: Callable[[], object]

    @property
    def is_done(self) -> bool:
        """Whether the result is there."""
        return self.result.is_file() or (self.result / "cell.json").is_file()


def run_cells(
    cells: Sequence[Cell], launcher: str = "serial", options: Sequence[str] = (), again: bool = False
) -> None:
    """Run the cells that are not done, each once, and return when all are done.

    Cells that another process is working on are left to it, and waited for at the end.

    Args:
        cells: of one experiment.
        launcher: of :data:`LAUNCHERS`.
        options: of the launcher, ``name=value``.
        again: run those that are done, too.

    Raises:
        ConfigError: an unknown launcher or option, or a folder that cannot be written.
        ResultError: a launcher has ended before all cells are done.

    >>> import tempfile
    >>> from vusfa.files import write_text
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "result.txt"
    ...     for _ in range(2):
    ...         run_cells([Cell(path, partial(write_text, path, "made once"))])
    /.../result.txt
    /.../result.txt: already there
    """
    if launcher not in LAUNCHERS:
        raise ConfigError(f"launcher is {brief(launcher)}: no such launcher; {near(launcher, LAUNCHERS)}")
    chosen = dict(map(_option, options))
    for folder in {cell.result.parent for cell in cells}:
        check_folder(folder, "the folder of results")
    left = list(cells) if again else [cell for cell in cells if not cell.is_done]
    for cell in cells:
        if cell not in left:
            print(f"{cell.result}: already there", flush=True)
    # first without waiting for other processes, then for what these leave
    for wait in [True] if again else [False, True]:
        if left:
            LAUNCHERS[launcher]([partial(run_cell, cell, wait=wait, again=again) for cell in left], chosen)
        left = [cell for cell in left if not cell.is_done]
    if left:
        raise ResultError(
            f"{len(left)} of {len(cells)} cells are not done, {left[0].result} first: run the command again"
        )


def run_cell(cell: Cell, wait: bool = False, again: bool = False) -> str | None:
    """Run a cell unless it is done, or another process is working on it.

    Args:
        cell: to run.
        wait: wait for that process, and run the cell if it leaves it undone.
        again: run it even if it is done.

    Returns:
        what the work returned, as text; None if it was not done here.
    """
    folder = cell.result.parent
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / f".{cell.result.name}.lock", wait):
            return str(cell.work()) if again or not cell.is_done else None
    except LockedError as error:
        say(f"{cell.result}: {error.owner} is working on it")
        return None
    finally:
        for place in missing:  # a cell that fails leaves nothing
            with suppress(OSError):
                place.rmdir()


def _option(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"launcher_options has {brief(text)}; write options as [num_cpus=2,retries=5]")
    return name, value
