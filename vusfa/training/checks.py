"""What settings must be: none that nothing knows, none missing, every one of its default's kind."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from vusfa.errors import ConfigError
from vusfa.training.loggers import flat

__all__ = ["check_names", "check_types", "near"]

# May be null, and what they are otherwise.
NULLABLE: dict[str, type] = {
    "agent.initial_scale": float,
    "agent.successor_gain": float,
    "entropy.horizon": int,
    "env.collision_reward": float,
    "logger.name": str,
    "objective.bottleneck_maximum": float,
    "objective.n_steps": int,
    "optim.horizon": int,
    "optim.max_grad_norm": float,
    "resume": str,
}
# A run divides by these.
POSITIVE = ("log_every", "checkpoint_every", "total_frames", "optim.horizon", "entropy.horizon")
# Several kinds will do; whoever uses them looks at them.
MIXED = ("env.goals", "env.crop", "evaluation.goals")
# Names and values are checked by make_agent, make_optimiser and resolve_goals.
OPEN = ("agent.", "optim.options.", "env.goals.")
REQUIRED = ("agent.model", "agent.preset")

KINDS: dict[type, tuple[tuple[type, ...], str]] = {
    bool: ((bool,), "true or false"),
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    str: ((str,), "text"),
    list: ((list,), "a list"),
}


def check_names(cfg: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Refuse a setting that the defaults do not have (``+name=value`` would add one), and a lack of one that
    they have.

    Raises:
        ConfigError: naming the setting, and one that comes near.

    >>> check_names({"optim": {"lr": 0.1, "rl": 0.2}}, {"optim": {"lr": 0.1}})
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: no setting is called 'optim.rl'; did you mean 'optim.lr'?
    """
    given, known, groups = flat(cfg), flat(defaults), dict(_groups(defaults))
    for key, value in given.items():
        if key in groups:
            inner = ", ".join(f"{name}=..." for name in flat(groups[key], f"{key}.")) or "{}"
            raise ConfigError(f"{key} is {_shown(value)}; it is a group of settings: give {inner}")
        if key not in known and not key.startswith(OPEN):
            raise ConfigError(f"no setting is called {key!r}{near(key, known)}")
    for key, default in known.items():
        if key in given or any(name.startswith(f"{key}.") for name in given):
            continue
        if not key.startswith(OPEN) or key in REQUIRED:
            raise ConfigError(f"{key} is missing; it may be {_shown(default)}")


def check_types(cfg: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Refuse a word where the default is a number, a fraction where it is a whole number, and so on, and a
    count that is not more than 0.

    Raises:
        ConfigError: naming the setting, its value, and a value that would do.

    >>> check_types({"optim": {"lr": "fast"}}, {"optim": {"lr": 0.1}})
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: optim.lr is 'fast'; it must be a number, such as 0.1
    """
    expected = flat(defaults)
    for key, value in flat(cfg).items():
        default = expected.get(key)
        if key == "scenes" and isinstance(value, str):
            value = [value]
        free = key in MIXED or (value is None and key.startswith("agent.") and key not in REQUIRED)
        kind = NULLABLE.get(key, type(default))
        if free or kind not in KINDS or (value is None and key in NULLABLE):
            continue
        accepted, words = KINDS[kind]
        example = "" if kind is bool or default is None else f", such as {_shown(default)}"
        example += " or null" if key in NULLABLE else ""
        if type(value) not in accepted:
            raise ConfigError(f"{key} is {_shown(value)}; it must be {words}{example}")
        if kind is list and default and any(type(item) is not type(default[0]) for item in value):
            raise ConfigError(f"{key} is {_shown(value)}; each entry must be as in {_shown(default)}")
        if key in POSITIVE and value <= 0:
            raise ConfigError(f"{key} is {value}; it must be more than 0")


def near(word: str, choices: Iterable[str]) -> str:
    """The end of a sentence on an unknown word: the choice that comes near, or all of a few.

    >>> near("optm", ["optim", "env"])
    "; did you mean 'optim'?"
    """
    choices = list(choices)
    found = difflib.get_close_matches(word, choices, n=1, cutoff=0.5)
    if found:
        return f"; did you mean {found[0]!r}?"
    return f"; there are {', '.join(choices)}" if len(choices) <= 12 else "; --help lists all settings"


def _groups(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield f"{prefix}{key}", value
            yield from _groups(value, f"{prefix}{key}.")


def _shown(value: Any) -> str:
    """As on a command line."""
    if isinstance(value, list):
        return f"[{', '.join(map(str, value))}]"
    return "null" if value is None else repr(value)
