"""Every private name of TorchRL, TensorDict and torch that this package uses; no other file names any.

``TensorDict._new_unsafe``
    saves 10 to 12 % of the environment's processor time (16 and 128 rows);
    the public way is ``TensorDict(entries, ...)``, which checks every entry.
``EnvBase._step_and_maybe_reset``
    saves 20 % (16 rows) to 40 % (1024 rows) of it;
    the public way is not to define it: EnvBase then steps, and resets with a mask.
``EnvBase._supports_set_state``
    declares that ``reset(tensordict, set_state=True)`` resumes episodes; there is no public way.
``Collector._carrier``
    is what a collector steps on from: a resumed training goes on in mid-episode, number for number; the
    public way is ``Collector.reset``, which begins new episodes.
``BaseCollector._weight_sync_schemes``
    are the threads that share weights with workers. Left to the garbage collector, they end when the
    interpreter does, which then waits forever; the public way, ``BaseCollector.shutdown``, leaves them
    running.
``torch.distributed.distributed_c10d._get_default_store``
    is the store of the process group, where ranks leave signs of life; the public way is a store of one's
    own, on a port that all ranks would have to agree on.

``tests/test_torchrl_private.py`` fails when a new TorchRL changes one of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, distributed
from torchrl.envs import EnvBase

if TYPE_CHECKING:
    from torchrl.collectors import BaseCollector, Collector

__all__ = [
    "StatelessEnv",
    "carrier",
    "end_weight_sharing",
    "process_group_store",
    "put_carrier",
    "unchecked_tensordict",
]


def carrier(collector: Collector) -> TensorDict:
    """A copy of what a collector steps on from."""
    return collector._carrier.clone()


def put_carrier(collector: Collector, content: dict[str, Any]) -> None:
    """Make a collector step on from what :func:`carrier` gave, as nested dictionaries of tensors."""
    before = collector._carrier
    collector._carrier = TensorDict(content, batch_size=before.batch_size, device=before.device)


def end_weight_sharing(collector: BaseCollector) -> None:
    """End the threads that share weights with a collector's workers."""
    for scheme in (collector._weight_sync_schemes or {}).values():
        scheme.shutdown()


def process_group_store() -> Any:
    """The key-value store of the process group that :func:`torch.distributed.init_process_group` has made."""
    return distributed.distributed_c10d._get_default_store()


def unchecked_tensordict(
    entries: dict[str, Tensor], batch_size: torch.Size, device: torch.device | None
) -> TensorDict:
    """A tensordict of entries that are known to have its batch size and device.

    >>> unchecked_tensordict({"a": torch.zeros(2, 1)}, torch.Size([2]), torch.device("cpu"))["a"].shape
    torch.Size([2, 1])
    """
    return TensorDict._new_unsafe(source=entries, batch_size=batch_size, device=device)


class StatelessEnv(EnvBase):
    """Base of environments that keep no state of their own: where an episode is stands in the tensordict.

    ``reset(tensordict, set_state=True)`` resumes the episodes that a tensordict describes. A step that ends
    episodes begins new ones by :meth:`_renew`, without the detour through :meth:`reset`, which checks and
    merges what is known here; with many rows some episode ends at almost every step.
    """

    _supports_set_state = True

    def _renew(self, following: TensorDictBase, done: Tensor) -> dict[str, Tensor]:
        """Entries of the rows after a step, those of the rows that are ``done`` (*B, 1) replaced by new
        episodes'."""
        raise NotImplementedError

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """One step, and new episodes where one ended.

        The same as :class:`EnvBase` does, draw for draw. Entries that the environment does not know, such as
        a policy's outputs, stay as they are.
        """
        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)
        if "next" in tensordict or "_step" in tensordict:
            return super()._step_and_maybe_reset(tensordict)
        following = self._step(tensordict)
        tensordict.set("next", following)
        root = self.step_mdp(tensordict)
        done = following.get("done")
        if done.any():
            entries = {**dict(root.items()), **self._renew(following, done)}
            root = unchecked_tensordict(entries, root.batch_size, root.device)
        return tensordict, root

    def _set_seed(self, seed: int | None) -> Any:
        raise NotImplementedError
