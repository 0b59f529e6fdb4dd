"""Composition of settings from the YAML files, as Hydra's command line does it. Needs Hydra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from vusfa.conf import FOLDER
from vusfa.conf.settings import flat

__all__ = ["compose", "default_settings"]


def compose(folder: Path = FOLDER, name: str = "train", overrides: Sequence[str] = ()) -> DictConfig:
    """Compose the configuration as the command line would, without running anything.

    Args:
        folder: folder of the configuration files.
        name: name of the primary file.
        overrides: words of the command line.
    """
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
