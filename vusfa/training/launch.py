"""Hydra around a recipe: settings in, one line on whatever is wrong with them, exit codes out.

The one part of this package that needs Hydra (extra ``recipes``). A recipe is a function of its settings::

    def main(cfg, overrides):
        ...
        return 0

    if __name__ == "__main__":
        launch(main, CONF, "train")
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vusfa.errors import VusfaError
from vusfa.modules.presets import resolve_config
from vusfa.training.checkpoint import load_checkpoint
from vusfa.training.checks import check_names, check_types, near
from vusfa.training.loggers import flat

__all__ = ["compose", "launch", "with_saved_overrides"]

BAD_INPUT = 2
INTERRUPTED = 130


def launch(job: Callable[[DictConfig, list[str]], int], folder: Path, name: str) -> None:
    """Compose the configuration from the command line, run the job with it, exit with the code that it
    returns.

    What a user got wrong (:class:`~vusfa.errors.VusfaError`, or an error of Hydra's) ends in one line on
    standard error and code 2. An error of ours keeps its traceback.

    Args:
        job: gets the settings, resolved and checked, and the command line's overrides.
        folder: of the configuration files.
        name: the primary one.
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
        overrides.insert(0, f"--config-name={HydraConfig.get().job.config_name}")  # train resumes demo
        codes.append(_report(lambda: job(_settled(cfg, folder, name), overrides), folder, name))

    def run() -> int:
        sys.argv[1:] = with_saved_overrides(sys.argv[1:])
        hydra.main(version_base="1.3", config_path=str(folder.resolve()), config_name=name)(guarded)()
        return max(codes, default=0)  # a sweep has several; --help none

    sys.exit(_report(run, folder, name))


def compose(folder: Path, name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration as the command line would make it, without running anything.

    Args:
        folder: of the configuration files.
        name: the primary one.
        overrides: what would be on the command line.
    """
    if GlobalHydra.instance().is_initialized():  # within a job
        return hydra.compose(name, list(overrides))
    with hydra.initialize_config_dir(str(folder.resolve()), version_base="1.3"):
        return hydra.compose(name, list(overrides))


def with_saved_overrides(arguments: Sequence[str]) -> list[str]:
    """The command line of a resumed run: that of the run it resumes, of whichever recipe, then what was given
    now.

    ``resume=RUN/checkpoint.pt`` alone continues with the same settings, in the same folder. What is given now
    wins.

    Raises:
        CheckpointError: the checkpoint cannot be read.

    >>> with_saved_overrides(["seed=3"])
    ['seed=3']
    """
    paths = [argument.partition("=")[2] for argument in arguments if argument.startswith("resume=")]
    if not paths or paths[-1] in ("", "null"):
        return list(arguments)
    given = {"folder", *_keys(arguments)}
    state = load_checkpoint(paths[-1])
    sources = state["scenes"].get("sources", [])  # as they are found from any folder
    kept = [override for override in state.get("overrides", []) if not _keys([override]) & given]
    if sources and "scenes" not in given:
        kept = [override for override in kept if _keys([override]) != {"scenes"}]
        kept.append(f"scenes=[{','.join(map(_quoted, sources))}]")
    return [*kept, f"folder={_quoted(Path(paths[-1]).resolve().parent)}", *arguments]


def explain(error: Exception, folder: Path, name: str) -> str:
    """One line for an error of Hydra's: what is wrong, and what would be right."""
    text = " ".join(str(error).split())
    if isinstance(error, OverrideParseException):
        reason = text.split(" See https")[0]
        return f"cannot read {error.override!r} ({reason}); settings are written setting=value"
    if isinstance(error, MissingConfigException) and "Available options" in str(error):
        wanted = (error.missing_cfg_file or "").rpartition("/")
        options = sorted(option.strip() for option in error.options or ())
        return f"{wanted[0]}={wanted[2]}: there is no such choice{near(wanted[2], options)}"
    unknown = re.match(r"Could not override '([^']+)'", text)
    if unknown:
        GlobalHydra.instance().clear()
        known = compose(folder, name)
        groups = [entry.name for entry in folder.iterdir() if entry.is_dir()]
        keys = [*flat(OmegaConf.to_container(known)), *groups]  # type: ignore[arg-type]
        return f"no setting is called {unknown[1]!r}{near(unknown[1], keys)}"
    return text


def _quoted(path: object) -> str:
    return "'" + str(path).replace("'", "\\'") + "'"


def _keys(overrides: Iterable[str]) -> set[str]:
    return {override.partition("=")[0].lstrip("+~") for override in overrides}


def _settled(cfg: DictConfig, folder: Path, name: str) -> DictConfig:
    """Interpolations resolved, names and types checked."""
    model = OmegaConf.select(cfg, "agent.model")
    if "agent" in cfg:
        # before anything is looked up by the model's name
        resolve_config("null" if model is None else str(model))
    OmegaConf.resolve(cfg)
    context = HydraConfig.get()
    if context.mode == RunMode.MULTIRUN and "folder" in cfg and "folder" not in _keys(context.overrides.task):
        # runs of one sweep may differ in what their folder's name does not tell, and begin in the same second
        cfg.folder = context.runtime.output_dir
    choices = context.runtime.choices
    groups = [f"{group}={choice}" for group, choice in choices.items() if not group.startswith("hydra/")]
    defaults = compose(folder, name, [*groups, *([f"agent.model={model}"] if model is not None else [])])
    OmegaConf.resolve(defaults)
    given, expected = OmegaConf.to_container(cfg), OmegaConf.to_container(defaults)
    check_names(given, expected)  # type: ignore[arg-type]
    check_types(given, expected)  # type: ignore[arg-type]
    return cfg


def _report(job: Callable[[], int], folder: Path, name: str) -> int:
    try:
        return job()
    except VusfaError as error:
        return _complain(str(error))
    except (HydraException, OmegaConfBaseException) as error:
        return _complain(explain(error, folder, name))
    except ValueError as error:
        if "Config group override" not in str(error):  # Hydra's, of optim=null
            raise
        return _complain("a group of settings cannot be null; --help lists the choices of each")
    except KeyboardInterrupt:
        return _complain("interrupted; a checkpoint written before this is whole", INTERRUPTED)


def _complain(message: str, code: int = BAD_INPUT) -> int:
    print(f"error: {message}", file=sys.stderr)
    return code
