"""Composition of settings from the YAML files, as Hydra's command line does it. Needs Hydra."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from vusfa.conf import FOLDER
from vusfa.conf.settings import flat

__all__ = ["appended", "as_text", "compose", "default_settings"]


def appended(override: str) -> str:
    """An override as Hydra wants it, which takes new keys of a mapping only as an addition.

    >>> appended("env.scene_weights={hall: 2}"), appended("seed=1")
    ('++env.scene_weights={hall: 2}', 'seed=1')
    """
    return f"++{override}" if re.match(r"(env\.scene_weights|optim\.options)[.=]", override) else override


def as_text(value: str) -> str:
    """A value as Hydra reads it: in quotes where it has characters that mean something to it, or that it
    cannot read, which is all but ASCII.

    >>> as_text("runs/first"), as_text("runs/lr=1,2"), as_text("küche")
    ('runs/first', "'runs/lr=1,2'", "'küche'")
    """
    if re.fullmatch(r"[\w./~@%+*$-]*", value, re.ASCII):
        return value
    escaped = re.sub(r"(\\*)('|\Z)", lambda found: found[1] * 2 + "\\'" * bool(found[2]), value)
    return f"'{escaped}'"


def compose(folder: Path = FOLDER, name: str = "train", overrides: Sequence[str] = ()) -> DictConfig:
    """Compose the configuration as the command line would, without running anything.

    Args:
        folder: folder of the configuration files.
        name: name of the primary file.
        overrides: words of the command line.
    """
    overrides = [appended(override) for override in overrides]
    if GlobalHydra.instance().is_initialized():  # within a job
        return hydra.compose(name, list(overrides))
    with hydra.initialize_config_dir(str(folder.resolve()), version_base="1.3"):
        return hydra.compose(name, list(overrides))


@cache
def default_settings() -> Mapping[str, Any]:
    """Every setting by its dotted name, with its default in ``vusfa train``."""
    settings = compose()
    OmegaConf.resolve(settings)
    return flat(OmegaConf.to_container(settings))  # type: ignore[arg-type]
