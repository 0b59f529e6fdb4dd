"""Agents taken to other scenes."""

from __future__ import annotations

import dataclasses
from typing import Any

from vusfa.errors import ConfigError
from vusfa.modules.agents import Agent, make_agent
from vusfa.modules.config import AgentConfig
from vusfa.scenes import check_scenes

__all__ = ["transplant"]


def transplant(agent: Agent, scenes: Any) -> Agent:
    """A copy of an agent with ``shared_heads`` for other scenes, with the same weights, device and mode.

    Features are normalized by the mean and deviation of the training scenes, which are among the weights.

    Args:
        agent: built with ``shared_heads=True``.
        scenes: a ``SceneSet`` with features of the same size and as many actions.

    Raises:
        ConfigError: the agent has heads for each scene, or the scenes do not fit it.

    >>> from vusfa.scenes import SceneSet
    >>> home, other = SceneSet.bundled(["bathroom"]), SceneSet.bundled(["kitchen", "bedroom"])
    >>> agent = make_agent("vusfa", scenes=home, hidden_size=8, embedding_size=8, shared_heads=True)
    >>> transplant(agent, other).config["scenes"]
    ['kitchen', 'bedroom']
    """
    check_scenes(scenes)
    if not agent.config["shared_heads"]:
        raise ConfigError(
            "the agent has heads of its own for each scene; train one with agent.shared_heads=true to take"
            " it to other scenes"
        )
    if scenes.num_actions != agent.config["num_actions"]:
        raise ConfigError(
            f"the agent chooses among {agent.config['num_actions']} actions, the scenes have"
            f" {scenes.num_actions}"
        )
    fields = {field.name for field in dataclasses.fields(AgentConfig)}
    copy = make_agent(scenes=scenes, **{k: v for k, v in agent.config.items() if k in fields})
    try:
        copy.load_state_dict(agent.state_dict())
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise ConfigError(f"the agent does not fit the scenes' features ({first})") from error
    return copy.to(next(agent.parameters()).device).train(agent.training)
