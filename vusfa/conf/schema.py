"""Checks of settings with OmegaConf and Hydra's ConfigStore; one line per error.

Needs Hydra (extra ``recipes``).
"""

from __future__ import annotations

import math
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException, ValidationError

from vusfa.conf.compose import default_settings
from vusfa.conf.settings import ALGORITHMS, LARGEST, LOSS_TERMS, POSITIVE, ObjectiveSettings, Settings, flat
from vusfa.errors import ConfigError, near
from vusfa.limits import brief

__all__ = [
    "check_overrides",
    "mistake",
    "register_schema",
    "schema",
    "unknown_setting",
    "validated",
    "wrong_value",
]

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_EXAMPLES = {"scenes": "[bathroom, kitchen]"}


def schema() -> DictConfig:
    """Types of all settings, including the terms of the registered algorithms."""
    types_ = OmegaConf.structured(Settings)
    types_.objective = OmegaConf.structured(ObjectiveSettings)
    types_.objective.terms = dict(LOSS_TERMS)
    return types_


def register_schema() -> None:
    """Register the types with Hydra's ConfigStore as ``settings``, and the group ``algorithm``."""
    store = ConfigStore.instance()
    store.store(name="settings", node=schema())
    for name, settings in ALGORITHMS.items():
        store.store(group="algorithm", name=name, node=settings)


def check_overrides(overrides: Sequence[str]) -> None:
    """Refuse anything but true and false for a boolean setting: OmegaConf would accept ``off``, ``no`` and
    ``0`` as well.

    Args:
        overrides: words of the command line, ``setting=value``.

    Raises:
        ConfigError: a value is neither; the message names setting and value.

    >>> check_overrides(["agent.shared_heads=true"])
    >>> check_overrides(["agent.shared_heads=off"])
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: agent.shared_heads is 'off'; it must be true or false or null
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        kind, optional = _type_of(override.key_or_group)
        if kind is not bool or override.is_sweep_override() or override.is_delete():
            continue
        value = override.value()
        if not isinstance(value, bool) and not (optional and value is None) and "${" not in str(value):
            raise ConfigError(wrong_value(override.key_or_group, value))


def validated(settings: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Check names, types and ranges of settings.

    Args:
        settings: plain or OmegaConf's, all of them.
        where: start of the message, such as a file.

    Raises:
        ConfigError: a setting is unknown, missing, of another type or out of range.
    """
    plain: Any = OmegaConf.to_container(settings) if isinstance(settings, DictConfig) else dict(settings)
    try:
        _check_data(plain)
        groups = {field.name for field in fields(Settings)}
        for setting in flat(plain):
            if setting.partition(".")[0] not in groups:
                raise ConfigError(unknown_setting(setting))
        known = schema()
        name = plain.get("algorithm", {}).get("name") if isinstance(plain.get("algorithm"), dict) else None
        if name not in ALGORITHMS:
            raise ConfigError(
                f"algorithm.name is {brief(name)}: no such algorithm is registered; {near(name, ALGORITHMS)}"
            )
        known.algorithm = OmegaConf.structured(ALGORITHMS[name])
        merged = OmegaConf.merge(known, plain)
        missing = OmegaConf.missing_keys(merged)
        if missing:
            raise ConfigError(f"{min(missing)} is missing; it may be {_example(min(missing))}")
        result: Any = OmegaConf.to_container(merged)
        _check_ranges(result)
        return result
    except OmegaConfBaseException as error:
        raise ConfigError(f"{where}{mistake(error) or brief(str(error))}") from error
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from error


def mistake(error: BaseException) -> str | None:
    """Describe in one line an error of OmegaConf, or of Hydra while composing, about a setting."""
    while error is not None:
        key = getattr(error, "full_key", None)
        if isinstance(error, ConfigKeyError) or type(error).__name__ == "ConfigAttributeError":
            return unknown_setting(str(key))
        if isinstance(error, ValidationError) and key:
            return wrong_value(key, error.value)
        if type(error).__name__ == "ConfigTypeError" and "deletion" in str(error):
            return f"{key} is missing; it may be {_example(str(key))}"
        if error.__cause__ is None:
            break
        error = error.__cause__
    return None


def unknown_setting(name: str, names: Iterable[str] | None = None) -> str:
    """Message for an unknown setting.

    >>> unknown_setting("sed")
    "no setting is called 'sed'; did you mean 'seed'?"
    """
    return f"no setting is called {name!r}; {near(name, names or _names(), '--help lists all settings')}"


def _check_data(plain: Any, prefix: str = "") -> None:
    """Refuse values that OmegaConf would interpolate, and names that a library would act on."""
    if isinstance(plain, dict):
        for key, value in plain.items():
            if not isinstance(key, str) or key.startswith("_"):
                raise ConfigError(f"no setting is called {prefix + str(key)!r}")
            _check_data(value, f"{prefix}{key}.")
    elif isinstance(plain, list):
        for value in plain:
            _check_data(value, prefix)
    elif isinstance(plain, str) and "${" in plain:
        raise ConfigError(f"{prefix.rstrip('.')} is {plain!r}; it must not refer to other settings")
    elif plain is not None and not isinstance(plain, (bool, int, float, str)):
        raise ConfigError(f"{prefix.rstrip('.')} is a {type(plain).__name__}; it must be plain data")


def _check_ranges(settings: Mapping[str, Any]) -> None:
    scenes = [settings["scenes"]] if isinstance(settings["scenes"], str) else settings["scenes"]
    if not isinstance(scenes, list):
        raise ConfigError(f"scenes is {_shown(scenes)}; it must be a list, such as {_example('scenes')}")
    if not all(isinstance(scene, str) for scene in scenes):
        raise ConfigError(f"scenes is {_shown(scenes)}; each entry must be as in {_example('scenes')}")
    every = flat(settings)
    for name in POSITIVE:
        value = every[name]
        if value is not None and value <= 0:
            raise ConfigError(f"{name} is {value}; it must be more than 0")
    for name, value in every.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{name} is {value}; it must be a finite number")
    for name, most in LARGEST.items():
        if (every.get(name) or 0) > most:
            raise ConfigError(f"{name} is {brief(every[name])}; it must be at most {most:,}")
    if (settings["early_stopping"]["success"] or 0) > 1:
        share = settings["early_stopping"]["success"]
        raise ConfigError(
            f"early_stopping.success is {share}; it is a share of episodes, at most 1: give 0.9"
        )
    interval = settings["evaluation"]["interval"]
    if interval not in ("auto", None) and (type(interval) is not int or interval < 1):
        raise ConfigError(
            f"evaluation.interval is {_shown(interval)}; it must be auto, a number of frames such as 100000,"
            " or null"
        )
    lazy = settings["lazy_scenes"]
    if lazy != "auto" and not isinstance(lazy, bool):
        raise ConfigError(f"lazy_scenes is {_shown(lazy)}; it must be auto, true or false")
    if not 0 <= settings["seed"] < 2**32:
        raise ConfigError(f"seed is {brief(settings['seed'])}; it must be 0 to {2**32 - 1}")


def _type_of(name: str) -> tuple[Any, bool]:
    """Type of a setting by its dotted name, and whether it may be null; Any if unknown."""
    kind, optional = Settings, False
    for part in name.split("."):
        hints = get_type_hints(kind) if is_dataclass(kind) else {}
        if name.startswith("algorithm.") and part != "algorithm":
            kinds = [one if isinstance(one, type) else type(one) for one in ALGORITHMS.values()]
            hints = {key: hint for one in kinds for key, hint in get_type_hints(one).items()}
        if get_origin(kind) is dict:
            hints = {part: get_args(kind)[1]}
        if part not in hints:
            return Any, True
        kind, optional = hints[part], False
        if get_origin(kind) in (Union, types.UnionType):
            optional = type(None) in get_args(kind)
            (kind,) = (argument for argument in get_args(kind) if argument is not type(None))
    return kind, optional


def wrong_value(name: str, value: Any) -> str:
    """Message for a value of another type.

    >>> wrong_value("seed", "{a: 1}")
    "seed is '{a: 1}'; it must be a whole number, such as 0"
    """
    kind, optional = _type_of(name)
    if is_dataclass(kind) or get_origin(kind) is dict:
        inner = [key for key in _names() if key.startswith(f"{name}.")] or [f"{name}.NAME"]
        return f"{name} is {_shown(value)}; it is a group of settings: give {'=..., '.join(inner)}=..."
    words = "a list" if get_origin(kind) is list else _WORDS.get(kind, "another value")
    example = "" if kind is bool else _example(name)
    if kind is int and isinstance(value, float) and value.is_integer():
        example = f"{value:.0f}"
    words += f", such as {example}" if example not in ("", "null") else ""
    return f"{name} is {_shown(value)}; it must be {words}{' or null' if optional else ''}"


def _names() -> list[str]:
    return list(default_settings())


def _example(name: str) -> str:
    return _EXAMPLES.get(name) or _shown(default_settings().get(name))


def _shown(value: Any) -> str:
    """A value as written on a command line."""
    if isinstance(value, list):
        return f"[{', '.join(map(str, value[:10]))}{', ...' if len(value) > 10 else ''}]"
    return "null" if value is None else brief(value)
