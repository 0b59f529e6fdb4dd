"""Run a job with Hydra: composed settings, one line per error, exit codes.

The only part of the command line that needs Hydra (extra ``recipes``). A job is a function of its settings::

    def main(settings, overrides):
        ...
        return 0

    if __name__ == "__main__":
        launch(main)
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import vusfa.algorithms  # noqa: F401  (registers those of this package)
from vusfa.cli.interrupts import out_of_memory
from vusfa.cli.resume import resumed_settings
from vusfa.conf import FOLDER
from vusfa.conf import compose as conf_compose
from vusfa.conf.schema import (
    check_overrides,
    mistake,
    register_schema,
    unknown_setting,
    validated,
    wrong_value,
)
from vusfa.errors import ConfigError, RankError, ResultError, VusfaError, WorkerError, near
from vusfa.files import say, use_own_temporary_folder
from vusfa.limits import brief
from vusfa.modules.config import resolve_config
from vusfa.training.folder import AUTO, found_checkpoint

__all__ = ["compose", "launch"]

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

Job = Callable[[dict[str, Any], list[str]], int]


def launch(job: Job, folder: Path = FOLDER, name: str = "train") -> None:
    """Compose the settings from the command line, run the job with them, exit with its code.

    A mistake of the user (:class:`~vusfa.errors.VusfaError`, or an error of Hydra) ends in one line on
    standard error and code 2; a failure of the machine (a worker died, the disk is full) in one line and
    code 1; a signal in code 128 plus its number, which ends a sweep, too. A bug keeps its traceback.

    Args:
        job: called with the settings, plain and checked, and the command line's overrides.
        folder: folder of the configuration files.
        name: name of the primary file.
    """
    # Hydra then raises its errors instead of printing them; nothing else changes.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if "RL_LOGGING_LEVEL" not in os.environ:  # enables TorchRL's log
        logging.getLogger("torchrl").setLevel(logging.WARNING)
    use_own_temporary_folder()
    multirun = [word for word in sys.argv[1:] if word in ("--multirun", "-m")]
    others = [word for word in sys.argv[1:] if word not in multirun]
    others = [conf_compose.appended(_quoted(word, sweeps=bool(multirun))) for word in others]
    sys.argv[1:] = [*multirun, *others]  # argparse refuses the option among the settings
    codes: list[int] = []

    def guarded(cfg: DictConfig) -> None:
        # Errors are reported in here: Hydra would add lines to one that passed through it.
        # As typed: reading one with an interpolation would resolve it.
        overrides: Any = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
        codes.append(_report(lambda: job(_settled(cfg, overrides), overrides), folder))
        if codes[-1] > 128:  # a signal is meant for all runs of a sweep; Hydra would begin the next
            raise _Stopped

    def run() -> int:
        for word in sys.argv[1:]:
            if not word.isprintable() and re.search("[\ud800-\udfff]", word):
                raise ConfigError(f"{brief(word)} is no text in this locale; set PYTHONUTF8=1, or rename it")
        register_schema()
        with suppress(_Stopped):
            hydra.main(version_base="1.3", config_path=str(folder.resolve()), config_name=name)(guarded)()
        return max(codes, default=0)  # a sweep has several; --help none

    code = _report(run, folder)
    try:
        sys.stdout.flush()
    except OSError:  # the reader has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


class _Stopped(BaseException):
    """Raised when a signal has ended a run of a sweep."""


def compose(folder: Path = FOLDER, name: str = "train", overrides: Sequence[str] = ()) -> DictConfig:
    """Compose the configuration as the command line would, without running anything.

    Args:
        folder: folder of the configuration files.
        name: name of the primary file.
        overrides: words of the command line.

    >>> compose(overrides=["algorithm=hindsight", "seed=3"]).algorithm.name
    'hindsight'
    """
    register_schema()
    return conf_compose.compose(folder, name, overrides)


def explain(error: Exception, folder: Path) -> str:
    """One line for an error of Hydra: the fault and the remedy."""
    text = " ".join(str(error).split())
    if isinstance(error, OverrideParseException):
        reason = text.split(" See https")[0]
        return f"cannot read {error.override!r} ({reason}); settings are written setting=value"
    if isinstance(error, MissingConfigException) and "Available options" in str(error):
        group, _, choice = (error.missing_cfg_file or "").rpartition("/")
        options = sorted(option.strip() for option in error.options or ())
        return f"{group}={choice[:100]}: there is no such choice; {near(choice, options)}"
    GlobalHydra.instance().clear()
    unknown = re.match(r"Could not override '([^']+)'", text)
    if unknown:
        groups = [entry.name for entry in folder.iterdir() if entry.is_dir()]
        names = [*conf_compose.default_settings(), *groups, "algorithm"]
        return unknown_setting(unknown[1], names)
    merging = re.match(r"Error merging override \+*([\w.]+)=(.*)", text)
    return mistake(error) or (wrong_value(merging[1], merging[2]) if merging else text)


def _settled(cfg: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """Resolve interpolations, check names and types; a resumed run has its checkpoint's settings."""
    model = OmegaConf.select(cfg, "agent.model")
    resolve_config("null" if model is None else str(model))  # before any lookup by its name
    check_overrides(overrides)
    OmegaConf.resolve(cfg)
    context = HydraConfig.get()
    if context.mode == RunMode.MULTIRUN and cfg.resume in (None, AUTO):
        # runs of a sweep may have equal folder names and begin in the same second
        if cfg.folder is None:
            cfg.folder = context.runtime.output_dir
        elif not any(word.startswith("folder=") and set(word) & set(",$(") for word in sys.argv[1:]):
            cfg.folder = str(Path(cfg.folder, str(context.job.num)))
    settings = validated(cfg)
    if settings["resume"] == AUTO:
        settings["resume"] = found_checkpoint(settings["folder"])
        return settings
    return resumed_settings(settings, overrides) if settings["resume"] else settings


def _quoted(argument: str, sweeps: bool = False) -> str:
    """Quote a path with characters that Hydra would interpret (``=``, ``,``, ``(``), and text that it cannot
    read, which is all but ASCII.

    Args:
        argument: a word of the command line.
        sweeps: a comma in the name of the folder separates runs.

    >>> _quoted("resume=runs/lr=1,2/checkpoint.pt"), _quoted("resume=auto"), _quoted("seed=1,2")
    ("resume='runs/lr=1,2/checkpoint.pt'", 'resume=auto', 'seed=1,2')
    >>> _quoted("folder=a,b"), _quoted("folder=a,b", sweeps=True), _quoted("scenes=[bathroom,küche.h5]")
    ("folder='a,b'", 'folder=a,b', "scenes=[bathroom,'küche.h5']")
    """
    name, _, value = argument.partition("=")
    if value[:1] in ("'", '"') or "${" in value or (name == "folder" and "," in value and sweeps):
        return argument
    if name in ("resume", "folder"):
        return f"{name}={conf_compose.as_text(value)}"
    if value.isascii() or re.search(r"['\"{}()]|\[.*\[", value):
        return argument
    if value[:1] == "[" and value[-1:] == "]":
        parts = [part.strip() for part in value[1:-1].split(",")]
        parts = [part if part.isascii() else conf_compose.as_text(part) for part in parts]
        return f"{name}=[{','.join(parts)}]"
    return f"{name}={conf_compose.as_text(value)}"


def _report(job: Callable[[], int], folder: Path) -> int:
    try:
        return job()
    except RankError as error:
        return FAILED if error.is_quiet else _complain(str(error), FAILED)
    except (WorkerError, ResultError) as error:
        return _complain(str(error), FAILED)
    except VusfaError as error:
        return _complain(str(error))
    except (HydraException, OmegaConfBaseException) as error:
        return _complain(explain(error, folder))
    except ValueError as error:
        if "Config group override" not in str(error):  # Hydra's, of optim=null
            raise
        return _complain("a group of settings cannot be null; --help lists the choices of each")
    except BrokenPipeError:
        return FAILED
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _complain(f"{where}{error.strerror or error}; a checkpoint written before is whole", FAILED)
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        where = "; give fewer collector.num_envs or a shorter collector.rollout, or allow more (ulimit)"
        return _complain(f"out of memory{where}; a checkpoint written before is whole", FAILED)
    except KeyboardInterrupt:
        return _complain("interrupted; a checkpoint written before this is whole", INTERRUPTED)


def _complain(message: str, code: int = BAD_INPUT) -> int:
    say(f"error: {message}")
    return code
