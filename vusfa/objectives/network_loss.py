"""The base of the losses: networks with or without their parameters apart, keys, masks and reductions."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from vusfa.objectives.networks import use_params

__all__ = ["NetworkLoss"]

# what a loss reads of each network, the agent's method that gives such a network, and what else will do
_NETWORKS = {
    "actor_network": (("get_dist", "dist_sample_keys"), "get_policy_operator", "a ProbabilisticActor"),
    "critic_network": (("in_keys", "out_keys"), "get_value_operator", "a TensorDictModule"),
}


class NetworkLoss(LossModule):
    """Base of losses of an ``actor_network``, a ``critic_network``, or both, in this order.

    The other arguments are those of :class:`~vusfa.objectives.USFLoss`.
    """

    actor_network: TensorDictModule
    critic_network: TensorDictModule
    actor_network_params: TensorDictParams | None
    critic_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None
    target_critic_network_params: TensorDictParams | None

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        *,
        reduction: str | None,
        functional: bool,
        separate_losses: bool = False,
    ) -> None:
        reduction, name = reduction or "mean", type(self).__name__
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"{name}: reduction is {reduction!r}; give one of ('none', 'mean', 'sum')")
        if separate_losses and not functional:
            raise ValueError(f"{name}: separate_losses=True needs functional=True")
        for argument, network in networks.items():
            _check_network(name, argument, network)
        self._functional = functional
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        super().__init__()
        constants: list[nn.Parameter] | None = None
        for argument, network in networks.items():
            if functional:
                self.convert_to_functional(network, argument, compare_against=constants)
                constants = list(network.parameters()) if separate_losses else None
            else:
                setattr(self, argument, network)
                setattr(self, f"{argument}_params", None)
                setattr(self, f"target_{argument}_params", None)
        self._network_names = tuple(networks)
        self.reduction = reduction
        self.separate_losses = separate_losses

    @property
    def functional(self) -> bool:
        """Whether the loss holds the parameters apart from the modules."""
        return self._functional

    @property
    def in_keys(self) -> list[NestedKey]:
        """Everything that ``forward`` may read; can be set."""
        if self._in_keys is not None:
            return self._in_keys
        return list(dict.fromkeys(unravel_key(key) for key in self._default_in_keys()))

    @in_keys.setter
    def in_keys(self, value: list[NestedKey] | None) -> None:
        self._in_keys = value

    @property
    def out_keys(self) -> list[NestedKey]:
        """What ``forward`` returns, in this order when called without a tensordict; can be set."""
        return self._default_out_keys() if self._out_keys is None else self._out_keys

    @out_keys.setter
    def out_keys(self, value: list[NestedKey] | None) -> None:
        self._out_keys = value

    def check(self) -> None:
        """Raise where the networks lack an entry that a term needs; ``forward`` does so, too."""
        raise NotImplementedError

    def _default_in_keys(self) -> list[NestedKey]:
        raise NotImplementedError

    def _default_out_keys(self) -> list[NestedKey]:
        raise NotImplementedError

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        """There is no estimator, unless a subclass has one."""

    @contextlib.contextmanager
    def _params_in_place(self, *names: str) -> Iterator[None]:
        """The networks run with the parameters of this loss; all of them when none is named."""
        with contextlib.ExitStack() as stack:
            for name in (names or self._network_names) if self.functional else ():
                stack.enter_context(use_params(getattr(self, name), getattr(self, f"{name}_params")))
            yield

    def _register_coefficients(self, **values: Any) -> None:
        """Buffers of floating point, even for whole numbers: they are set by assignment later on."""
        device, dtype = self._default_device, torch.get_default_dtype()
        for name, value in values.items():
            if isinstance(value, int | float) and not math.isfinite(value):
                raise ValueError(f"{type(self).__name__}: {name} is {value}; give a finite number")
            self.register_coeff_buffer(name, value, device=device, dtype=dtype)

    def _set_action_keys(self) -> None:
        """Take the actor's own names of its action and of the action's log-probability."""
        actor, accepted = self.actor_network, self._AcceptedKeys.__dataclass_fields__
        names = {"action": actor.dist_sample_keys, "sample_log_prob": actor.log_prob_keys}
        found = {name: keys if len(keys) > 1 else keys[0] for name, keys in names.items()}
        self.set_keys(**{name: key for name, key in found.items() if name in accepted})

    def _action_keys(self) -> list[NestedKey]:
        action = self.tensor_keys.action
        return list(action) if isinstance(action, list) else [action]

    def _critic_writes(self, *keys: NestedKey) -> bool:
        written = {unravel_key(key) for key in self.critic_network.out_keys}
        return all(unravel_key(key) in written for key in keys)

    def _check_written(self, *names: str, way_out: str = "") -> None:
        """Raise for the first of these entries of ``tensor_keys`` that the critic does not write."""
        for name in names:
            key = getattr(self.tensor_keys, name)
            if not self._critic_writes(key):
                written = ", ".join(repr(written) for written in self.critic_network.out_keys[:30])
                raise ValueError(
                    f"{type(self).__name__}: the critic writes no {key!r}, but {written}; name the entry by"
                    f" loss.set_keys({name}=...){way_out}"
                )

    def _valid(self, tensordict: TensorDictBase, like: Tensor) -> Tensor | None:
        """Which rows the masks of a batch leave, in the shape of ``like``; None without a mask."""
        masks = [tensordict.get(key, None) for key in self._loss_mask_keys()]
        expanded = [self._expand_loss_mask(mask, like) for mask in masks if mask is not None]
        return torch.stack(expanded).all(0) if expanded else None


def _check_network(loss: str, argument: str, network: object) -> None:
    needed, method, otherwise = _NETWORKS[argument]
    missing = [name for name in needed if not hasattr(network, name)]
    if missing:
        give = f"agent.{method}()" if hasattr(network, method) else otherwise
        raise TypeError(
            f"{loss}: {argument} is of class {type(network).__name__}, which has no {missing[0]}; give {give}"
        )
