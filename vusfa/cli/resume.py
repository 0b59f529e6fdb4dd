"""Settings of a resumed run: those of its checkpoint, and overrides.

The content of a checkpoint is data. Its settings are checked like any other before they are used; its
recorded command line is never run.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from typing import Any

from vusfa.conf.schema import validated
from vusfa.errors import CheckpointError, ConfigError
from vusfa.training.checkpoint import checkpoint_file, load_checkpoint

__all__ = ["resumed_settings"]


def resumed_settings(given: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Settings to continue with: the checkpoint's, in its folder; overrides take precedence.

    A schedule that ended with the run ends with the new ``total_frames``, unless its horizon is given.

    Args:
        given: settings composed from the command line, checked; ``resume`` names the checkpoint.
        overrides: words of the command line, ``setting=value``.

    Raises:
        CheckpointError: the checkpoint cannot be read, or holds unknown settings.
        ConfigError: an override that a resumed run cannot take.
    """
    path = checkpoint_file(given["resume"])
    state = load_checkpoint(path)
    try:
        stored = validated(_completed(state["config"], given), where=f"{path}: ")
    except (ConfigError, KeyError, TypeError, AttributeError) as error:
        text = str(error) if isinstance(error, ConfigError) else f"{path}: it holds no settings"
        raise CheckpointError(text) from error
    for override in state.get("overrides", ()):
        if str(override).lstrip("+~").startswith("hydra") or "_target_" in str(override):
            raise CheckpointError(
                f"{path}: its command line holds {override!r}, which no training needs; take another"
            )
    settings = copy.deepcopy(stored)
    settings["folder"] = str(path.resolve().parent)
    sources = state["scenes"].get("sources")  # paths that are valid in any folder
    if sources:
        settings["scenes"] = list(sources)
    names = [override.partition("=")[0] for override in overrides]
    for name in names:
        if name.startswith("~") or name.lstrip("+") == "preset":
            raise ConfigError(f"{name} cannot be given beside resume; give the settings themselves")
        _copy(given, settings, name.lstrip("+").split("."))
    lost = next((place for place in sources or () if "/" in place and not os.path.exists(place)), None)
    if lost and "scenes" not in names:
        raise CheckpointError(
            f"{lost}: there is no such file; if the scenes of {path} have moved, put them beside it or give"
            " them as scenes"
        )
    settings["resume"] = str(path)
    for group in ("optim", "entropy"):
        origin = given if group in names else stored
        if origin[group]["horizon"] == origin["total_frames"] and f"{group}.horizon" not in names:
            settings[group]["horizon"] = settings["total_frames"]
    return settings


def _completed(stored: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Stored settings, with the defaults of groups and settings that an earlier version did not have."""
    completed = {**defaults, **stored}
    for name, group in stored.items():
        if isinstance(group, Mapping) and isinstance(defaults.get(name), Mapping) and name != "algorithm":
            completed[name] = {**defaults[name], **group}
    return completed


def _copy(source: Mapping[str, Any], target: dict[str, Any], parts: Sequence[str]) -> None:
    """Copy one entry, by the parts of its dotted name."""
    for part in parts[:-1]:
        source, target = source[part], target.setdefault(part, {})
    target[parts[-1]] = copy.deepcopy(source[parts[-1]])
