"""The navigation task for TorchRL and Gymnasium.

>>> from vusfa.scenes import SceneSet
>>> env = TargetNavEnv(SceneSet.bundled(["bathroom"]), goals="paper", batch_size=[5], seed=0)
>>> env.rollout(7, break_when_any_done=False)["state_id"].shape
torch.Size([5, 7, 4])
"""

from vusfa.envs import gym
from vusfa.envs.goals import resolve_goals, spread_goals
from vusfa.envs.navigation import TargetNavEnv
from vusfa.envs.observation import SceneObservation
from vusfa.envs.rotation import SceneRotation

__all__ = ["SceneObservation", "SceneRotation", "TargetNavEnv", "resolve_goals", "spread_goals"]

gym.register()
