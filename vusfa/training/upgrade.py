"""Checkpoints of version 0.1 (format 1) as this version has them (format 2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["upgrade", "upgrade_config"]


def upgrade(state: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a checkpoint of format 1, in format 2.

    Args:
        state: not changed.
    """
    new = {key: value for key, value in state.items() if key not in ("loss", "replay", "optimiser")}
    algorithm = {"loss": state.get("loss", {})}
    if state.get("replay"):
        algorithm["replay"] = state["replay"]
    new |= {"format": 2, "algorithm": algorithm, "optimizer": state.get("optimiser", {})}
    new["config"] = upgrade_config(state.get("config", {}))
    return new


def upgrade_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of version 0.1 under their names of today.

    >>> upgrade_config({"hindsight": {"updates": 10}, "objective": {"reward_coeff": 0.0}})
    {'hindsight': {'updates': 10}, 'objective': {'terms': {'reward': 0.0}},
     'algorithm': {'name': 'hindsight'}}
    """
    new = {key: dict(value) if isinstance(value, Mapping) else value for key, value in config.items()}
    if "terms" not in new.get("objective", {"terms": {}}):
        new["objective"]["terms"] = {"reward": new["objective"].pop("reward_coeff", 0.0)}
    hindsight = bool(new.get("hindsight", {}).get("updates", 0))
    autoencoder = new.get("agent", {}).get("pretrained") == "autoencoder"
    name = "hindsight" if hindsight else "autoencoder" if autoencoder else "usf"
    return {**new, "algorithm": new.get("algorithm", {"name": name})}
