"""The networks of the four models, as TensorDictModules."""

from vusfa.modules.agents import Agent, make_agent

__all__ = ["Agent", "make_agent"]
