"""Hydra around a job: settings in, one line on whatever is wrong with them, exit codes out.

The one part of the command line that needs Hydra (extra ``recipes``). A job is a function of its settings::

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
from vusfa.cli.resume import resumed_settings
from vusfa.conf import FOLDER
from vusfa.conf import compose as conf_compose
from vusfa.conf.schema import check_overrides, mistake, near, register_schema, validated
from vusfa.errors import VusfaError
from vusfa.modules.config import resolve_config

__all__ = ["compose", "launch"]

BAD_INPUT = 2
INTERRUPTED = 130

Job = Callable[[dict[str, Any], list[str]], int]


def launch(job: Job, folder: Path = FOLDER, name: str = "train") -> None:
    """Composes the settings from the command line, runs the job with them, exits with the code that it
    returns.

    What a user got wrong (:class:`~vusfa.errors.VusfaError`, or an error of Hydra's) ends in one line on
    standard error and code 2. An error of ours keeps its traceback.

    Args:
        job: gets the settings, plain and checked, and the command line's overrides.
        folder: of the configuration files.
        name: of the primary one.
    """
    # Hydra then raises its errors instead of printing them; nothing else changes.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if "RL_LOGGING_LEVEL" not in os.environ:  # how TorchRL's log is asked for
        logging.getLogger("torchrl").setLevel(logging.WARNING)
    codes: list[int] = []

    def guarded(cfg: DictConfig) -> None:
        # Errors are reported in here: one that passed through Hydra would get lines of Hydra's around it.
        # As typed: one with an interpolation would be resolved by being looked at.
        overrides: Any = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
        codes.append(_report(lambda: job(_settled(cfg, overrides), overrides), folder))

    def run() -> int:
        register_schema()
        hydra.main(version_base="1.3", config_path=str(folder.resolve()), config_name=name)(guarded)()
        return max(codes, default=0)  # a sweep has several; --help none

    sys.exit(_report(run, folder))


def compose(folder: Path = FOLDER, name: str = "train", overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration as the command line would make it, without running anything.

    Args:
        folder: of the configuration files.
        name: of the primary one.
        overrides: what would be on the command line.

    >>> compose(overrides=["algorithm=hindsight", "seed=3"]).algorithm.name
    'hindsight'
    """
    register_schema()
    return conf_compose.compose(folder, name, overrides)


def explain(error: Exception, folder: Path) -> str:
    """One line for an error of Hydra's: what is wrong, and what would be right."""
    text = " ".join(str(error).split())
    if isinstance(error, OverrideParseException):
        reason = text.split(" See https")[0]
        return f"cannot read {error.override!r} ({reason}); settings are written setting=value"
    if isinstance(error, MissingConfigException) and "Available options" in str(error):
        group, _, choice = (error.missing_cfg_file or "").rpartition("/")
        options = sorted(option.strip() for option in error.options or ())
        return f"{group}={choice}: there is no such choice{near(choice, options)}"
    GlobalHydra.instance().clear()
    unknown = re.match(r"Could not override '([^']+)'", text)
    if unknown:
        groups = [entry.name for entry in folder.iterdir() if entry.is_dir()]
        names = [*conf_compose.default_settings(), *groups, "algorithm"]
        return f"no setting is called {unknown[1]!r}{near(unknown[1], names)}"
    return mistake(error) or text


def _settled(cfg: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """Interpolations resolved, names and types checked; of a resumed run, its checkpoint's settings."""
    model = OmegaConf.select(cfg, "agent.model")
    resolve_config("null" if model is None else str(model))  # before anything is looked up by its name
    check_overrides(overrides)
    OmegaConf.resolve(cfg)
    context = HydraConfig.get()
    if context.mode == RunMode.MULTIRUN and not any(name.startswith("folder=") for name in overrides):
        # runs of one sweep may differ in what their folder's name does not tell, and begin in the same second
        cfg.folder = context.runtime.output_dir
    settings = validated(cfg)
    return resumed_settings(settings, overrides) if settings["resume"] else settings


def _report(job: Callable[[], int], folder: Path) -> int:
    try:
        return job()
    except VusfaError as error:
        return _complain(str(error))
    except (HydraException, OmegaConfBaseException) as error:
        return _complain(explain(error, folder))
    except ValueError as error:
        if "Config group override" not in str(error):  # Hydra's, of optim=null
            raise
        return _complain("a group of settings cannot be null; --help lists the choices of each")
    except KeyboardInterrupt:
        return _complain("interrupted; a checkpoint written before this is whole", INTERRUPTED)


def _complain(message: str, code: int = BAD_INPUT) -> int:
    print(f"error: {message}", file=sys.stderr)
    return code
