"""Log-probability and entropy of actions, one number per step, for any distribution."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.nn import CompositeDistribution, set_composite_lp_aggregate
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.modules.distributions.utils import composite_entropy, has_analytic_entropy, rsample_and_log_prob

__all__ = ["action_entropy", "action_log_prob"]


def action_log_prob(
    distribution: Distribution, tensordict: TensorDictBase, action_key: NestedKey | list[NestedKey]
) -> Tensor:
    """Log-probability of the actions that a tensordict holds.

    Args:
        distribution: batch shape ``(*batch,)``; components of a composite one are summed.
        tensordict: ``(*batch,)``, with the actions taken.
        action_key: of these; a list of keys for a composite distribution.

    Returns:
        ``(*batch,)``, in nats.

    Raises:
        RuntimeError: an action requires grad: the data would be part of a graph.

    >>> from tensordict import TensorDict
    >>> coin = torch.distributions.Categorical(probs=torch.tensor([[0.5, 0.5]]))
    >>> action_log_prob(coin, TensorDict({"action": torch.tensor([1])}, [1]), "action")
    tensor([-0.6931])
    """
    action: Tensor | TensorDictBase
    if isinstance(distribution, CompositeDistribution):
        action = tensordict.select(*(action_key if isinstance(action_key, list) else [action_key]))
    else:
        action = tensordict.get(action_key)
    leaves = action.values(True, True) if is_tensor_collection(action) else [action]
    if any(leaf.requires_grad for leaf in leaves):
        raise RuntimeError(f"tensordict stored {action_key} requires grad.")
    with set_composite_lp_aggregate(False):
        return _total(distribution.log_prob(action), tensordict.batch_dims)


def action_entropy(distribution: Distribution) -> Tensor:
    """Entropy of the actions, ``(*batch,)``, in nats; estimated from one sample where it has no closed form.

    >>> action_entropy(torch.distributions.Categorical(probs=torch.tensor([[0.5, 0.5]])))
    tensor([0.6931])
    """
    with set_composite_lp_aggregate(False):
        if isinstance(distribution, CompositeDistribution):
            return _total(composite_entropy(distribution), len(distribution.batch_shape))
        if has_analytic_entropy(distribution):
            return distribution.entropy()
        _, log_prob = rsample_and_log_prob(distribution)
        return -log_prob


def _total(values: Tensor | TensorDictBase, batch_dims: int) -> Tensor:
    """Sum over the components of a composite distribution and over their features."""
    if isinstance(values, Tensor):
        return values
    leaves = (
        value.flatten(batch_dims).sum(-1) if value.ndim > batch_dims else value
        for value in values.values(True, True)
    )
    return torch.stack(list(leaves)).sum(0)
