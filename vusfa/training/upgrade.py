"""Checkpoints of version 0.1 (format 1) as this version has them (format 2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vusfa.errors import CheckpointError
from vusfa.modules import upgrade_agent_config, upgrade_agent_state

__all__ = ["upgrade", "upgrade_config"]


_RENAMED = {"preset": "architecture", "normalise_features": "normalize_features"}
# settings of version 0.1 that no preset and no document set, with the values that this version has for all
_DROPPED: dict[str, dict[str, Any]] = {
    "agent": {"successor_gain": 1.0},
    "objective": {
        "bottleneck_maximum": None,
        "information_reduction": "mean",
        "loss_critic_type": "l2",
        "n_steps": None,
        "embedding_at": "next",
    },
}


def upgrade(state: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a checkpoint of format 1, in format 2.

    Args:
        state: not changed.
    """
    new = {key: value for key, value in state.items() if key not in ("loss", "replay", "optimiser")}
    algorithm = {"loss": state.get("loss", {})}
    if state.get("replay"):
        replay = dict(state["replay"])
        replay["writer"] = replay.pop("cursor")
        algorithm["replay"] = replay
    new |= {"format": 2, "algorithm": algorithm, "optimizer": state.get("optimiser", {})}
    collector = state.get("collector")
    if isinstance(collector, Mapping) and isinstance(collector.get("carrier"), Mapping):
        names = {"step_count": "elapsed_steps"}
        stands = {names.get(name, name): value for name, value in collector["carrier"].items()}
        new["collector"] = {**collector, "carrier": stands}
    new["config"] = upgrade_config(state.get("config", {}))
    new["agent"] = upgrade_agent_state(state["agent"], state["agent_config"])
    new["agent_config"] = upgrade_agent_config(state["agent_config"])
    return new


def upgrade_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of version 0.1 under their names of today.

    >>> upgrade_config({"hindsight": {"updates": 10}, "objective": {"reward_coeff": 0.0}})
    {'hindsight': {'updates': 10}, 'objective': {'terms': {'reward': 0.0}},
     'algorithm': {'name': 'hindsight'}}
    """
    new = {key: dict(value) if isinstance(value, Mapping) else value for key, value in config.items()}
    agent = new.get("agent", {})
    for old, name in _RENAMED.items():
        if old in agent:
            agent[name] = agent.pop(old)
    for group, names in _DROPPED.items():
        for name, default in names.items():
            value = new.get(group, {}).pop(name, default)
            if value is not None and value != default:
                raise CheckpointError(f"trained with {group}.{name}={value}, which only version 0.1 has")
    if "terms" not in new.get("objective", {"terms": {}}):
        new["objective"]["terms"] = {"reward": new["objective"].pop("reward_coeff", 0.0)}
    hindsight = bool(new.get("hindsight", {}).get("updates", 0))
    if not hindsight and "algorithm" not in new:
        new.pop("hindsight", None)  # it had no numbers there; those of today are added
    autoencoder = new.get("agent", {}).get("pretrained") == "autoencoder"
    name = "hindsight" if hindsight else "autoencoder" if autoencoder else "usf"
    return {**new, "algorithm": new.get("algorithm", {"name": name})}
