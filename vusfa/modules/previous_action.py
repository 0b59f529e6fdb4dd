"""The action before, for agents that remember: as an entry of the environment's, and as a layer's input."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical, Composite, TensorSpec
from torchrl.envs.transforms import Transform

__all__ = ["ActionInput", "PreviousAction"]


class PreviousAction(Transform):
    """Adds ``previous_action`` (\\*B,) int64: the action that led here, A at the start of an episode.

    Args:
        num_actions: A.

    >>> from torchrl.envs import TransformedEnv
    >>> from vusfa.envs import TargetNavEnv
    >>> from vusfa.scenes import SceneSet
    >>> env = TransformedEnv(TargetNavEnv(SceneSet.bundled(["bathroom"]), batch_size=[2]), PreviousAction(4))
    >>> walk = env.rollout(3)
    >>> bool((walk["previous_action"][:, 0] == 4).all())
    True
    >>> bool((walk["previous_action"][:, 1:] == walk["action"][:, :-1]).all())
    True
    """

    def __init__(self, num_actions: int) -> None:
        super().__init__(in_keys=[], out_keys=["previous_action"])
        self.num_actions = num_actions

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("previous_action", tensordict.get("action").clone())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        rows = tensordict_reset
        none = torch.full(rows.batch_size, self.num_actions, dtype=torch.int64, device=rows.device)
        before, mask = tensordict.get("previous_action", None), tensordict.get("_reset", None)
        if before is not None and mask is not None:
            none = torch.where(mask.view(none.shape), none, before)
        return rows.set("previous_action", none)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """With the entry."""
        assert isinstance(observation_spec, Composite)
        shape = observation_spec.shape
        spec = Categorical(self.num_actions + 1, shape, device=observation_spec.device, dtype=torch.int64)
        observation_spec["previous_action"] = spec
        return observation_spec


class ActionInput(nn.Module):
    """A code plus a learned vector of the action before.

    >>> ActionInput(4, 32)(torch.rand(5, 32), torch.tensor([0, 1, 2, 3, 4])).shape
    torch.Size([5, 32])
    """

    def __init__(self, num_actions: int, hidden_size: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(num_actions + 1, hidden_size)

    def forward(self, fused: Tensor, previous_action: Tensor) -> Tensor:
        """(\\*B, hidden_size) and (\\*B,) int64, A for none, to (\\*B, hidden_size)."""
        return fused + self.embedding(previous_action).to(fused.dtype)
