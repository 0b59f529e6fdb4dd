"""Agents of version 0.1: their settings and weights under this version's names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from vusfa.errors import ConfigError

__all__ = ["upgrade_agent_config", "upgrade_agent_state"]

#: Fields of version 0.1 and what they are called now.
_RENAMED = {
    "preset": "architecture",
    "normalise_features": "normalize_features",
    "normalise_embedding": "normalize_embedding",
}
_WRAPPED = re.compile(r"^(encoder\.)+")


def upgrade_agent_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """An agent's settings in this version's names, from those of version 0.1 or of this one.

    Raises:
        ConfigError: a setting of version 0.1 that does not exist any more, at another value than its default.

    >>> upgrade_agent_config({"model": "gvf", "preset": "paper", "normalise_features": True})
    {'model': 'gvf', 'architecture': 'paper', 'normalize_features': True}
    """
    upgraded = {_RENAMED.get(name, name): value for name, value in config.items()}
    if upgraded.pop("successor_gain", None) not in (None, 1.0):
        raise ConfigError("successor_gain went with version 0.2; evaluate this agent with version 0.1")
    if upgraded.get("successor_norm") == "rms":
        raise ConfigError("successor_norm='rms' went with version 0.2; evaluate this agent with version 0.1")
    return upgraded


def upgrade_agent_state(state: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """An agent's ``state_dict`` under this version's names, from that of version 0.1 or of this one.

    Version 0.1 wrapped the encoder in modules for the bottleneck and the normalization. The order of the
    weights is the same. The agent's ``config`` makes no difference yet.

    >>> list(upgrade_agent_state({"encoder.encoder.encoder.branch.first.bias": 0}, {}))
    ['encoder.branch.first.bias']
    """
    return {_WRAPPED.sub("encoder.", name): value for name, value in state.items()}
