"""Deployment of trained agents: at a camera, as ONNX, pretrained.

>>> from vusfa.deploy import Navigator
>>> navigator = Navigator.load("vusfa")  # doctest: +SKIP
>>> navigator.goal("goal.jpg")  # doctest: +SKIP
'kitchen'
>>> navigator.act("now.jpg")  # doctest: +SKIP
Action(name='MoveForward', index=0, confidence=0.87, arrived=False)
"""

from vusfa.deploy.agents import TrainedAgent, load_pretrained, open_agent, pretrained_names
from vusfa.deploy.navigator import Action, Navigator

__all__ = ["Action", "Navigator", "TrainedAgent", "load_pretrained", "open_agent", "pretrained_names"]
