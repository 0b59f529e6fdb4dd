"""Ranks of a data-parallel training: what the trainer knows of them, and whose share of it is whose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.collectors import BaseCollector

from vusfa.errors import ConfigError

__all__ = ["Ranks", "check_ranks", "merged", "settings_of_rank", "share"]

#: Settings that count for all ranks together, of every training and of some algorithms.
_SHARED = {"": ("collector.num_envs",), "replay_search": ("algorithm.batch_size", "algorithm.num_goals")}
for _name in ("contrastive", "forward_backward", "implicit_q"):
    _SHARED[_name] = ("algorithm.batch_size", "algorithm.policy_pairs", "algorithm.capacity")
_SHARED["hindsight"] = ("hindsight.batch_size", "hindsight.capacity")


def _shared(settings: Mapping[str, Any]) -> dict[tuple[str, str], int]:
    names = (*_SHARED[""], *_SHARED.get(settings["algorithm"]["name"], ()))
    keys = [tuple(name.split(".")) for name in names]
    return {(group, key): settings[group][key] for group, key in keys}


def check_ranks(settings: Mapping[str, Any], size: int) -> None:
    """Refuse with a ConfigError what so many ranks cannot share.

    >>> check_ranks({"collector": {"kind": "multi_sync", "num_envs": 8}}, 2)
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: collector.kind=multi_sync has processes of its own, and so have 2 ranks; ...
    """
    kind = settings["collector"]["kind"]
    if kind != "single":
        raise ConfigError(
            f"collector.kind={kind} has processes of its own, and so have {size} ranks; give"
            " collector=single, or start vusfa train without torchrun"
        )
    for (group, key), number in _shared(settings).items():
        what = "not a multiple of" if number % size and key != "capacity" else ""
        what = "fewer than" if number < size else what
        if what:
            raise ConfigError(f"{group}.{key}={number} is {what} the {size} ranks; give a multiple of {size}")
    if settings["optim"]["kind"] == "a3c_rmsprop":
        raise ConfigError(
            "optim.kind=a3c_rmsprop makes an update per environment, and ranks one update of all; give"
            " another optim, or collector=hogwild without torchrun"
        )


def settings_of_rank(settings: Mapping[str, Any], size: int) -> dict[str, Any]:
    """Settings with one rank's share of environments, and of what is drawn from replay.

    >>> whole = {"collector": {"num_envs": 8, "rollout": 5}, "algorithm": {"name": "usf"}}
    >>> settings_of_rank(whole, 2)["collector"]
    {'num_envs': 4, 'rollout': 5}
    """
    result = {**settings}
    for (group, key), number in _shared(settings).items():
        result[group] = {**result[group], key: number // size}
    return result


class Ranks:
    """The ranks of a training. Of this class itself: one process alone, which shares nothing.

    All ranks call the same methods in the same order.

    Args:
        rank, size: this one's number, from 0 on, and how many there are.

    Attributes:
        is_first: whether this is rank 0, which logs and saves.
        own_parts: which parts of a work are this rank's: part i is that of rank i mod N.
        signal: gives the number of a signal that this rank has received, or None.

    >>> ranks = Ranks()
    >>> ranks.size, ranks.first(lambda: 5), ranks.gather("state")
    (1, 5, ['state'])
    """

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size, self.is_first = rank, size, rank == 0
        self.own_parts = slice(rank, None, size)
        self.signal: Callable[[], int | None] = lambda: None

    @property
    def stopped(self) -> int | None:
        """Signal after which all ranks stop, the same on all after the same update; None: they go on."""
        return self.signal()

    def average(self, params: Sequence[nn.Parameter], terms: dict[str, Tensor]) -> None:
        """Replace gradients of parameters, and terms, by their means over all ranks."""

    def mean(self, value: Tensor) -> Tensor:
        """Mean of a tensor over all ranks."""
        return value

    def equalize(self, params: Sequence[Tensor]) -> None:
        """Give all ranks the numbers of rank 0."""

    def seed(self, collector: BaseCollector, seed: int) -> None:
        """Seed a rank's environments and its other draws."""

    def gather(self, state: Any) -> list[Any]:
        """States of all ranks, on rank 0; none on the others. After the loss of a rank: the own one."""
        return [state]

    def first(self, call: Callable[[], Any]) -> Any:
        """What a function returns on rank 0, on all ranks, however long it takes."""
        return call()

    def collect(self, own: list[Any]) -> list[Any]:
        """Results of all parts of a work, on rank 0, from each rank's own; none on the others. The ranks wait
        for each other, however long it takes.

        Args:
            own: in order, of the parts that :attr:`own_parts` chooses from their list.
        """
        return own

    @contextmanager
    def preparing(self) -> Iterator[None]:
        """Context of what each rank does for itself before the first batch: an error on one ends all, and the
        first that has one reports it."""
        yield

    def merge(self, own: dict[str, Any], algorithm: Callable[[list[Any]], Any]) -> dict[str, Any]:
        """Entries of a checkpoint for all ranks, on rank 0, from each one's own.

        Args:
            own: ``algorithm``, ``collector``, ``meter``, ``rng``.
            algorithm: :meth:`vusfa.algorithms.Algorithm.merge_states`.
        """
        return own

    def share_of_state(
        self, path: str | Path, state: dict[str, Any], algorithm: Callable[..., Any]
    ) -> dict[str, Any]:
        """This rank's share of a checkpoint's content; its ``rng`` is None where draws begin anew.

        Args:
            path: for messages.
            state: of any number of ranks.
            algorithm: :meth:`vusfa.algorithms.Algorithm.share_of_state`.
        """
        return state


def merged(parts: list[dict[str, Any]], size: int, algorithm: Callable[[list[Any]], Any]) -> dict[str, Any]:
    """Entries of a checkpoint for all ranks; see :meth:`Ranks.merge`.

    The environments are those of all. Where a rank is gone, ``collector`` is empty: new episodes begin.

    Args:
        parts: of the ranks, in order.
        size: how many ranks there were.
        algorithm: as there.
    """
    gone = [None] * (size - len(parts))
    whole = {**parts[0], "algorithm": algorithm([*(part["algorithm"] for part in parts), *gone])}
    if gone:
        return {**whole, "collector": {}}
    collectors = [part["collector"] for part in parts]
    rows: Any = torch.cat([TensorDict(each["carrier"], each["batch_size"]) for each in collectors])
    whole["collector"] = {**collectors[0], "batch_size": list(rows.batch_size), "carrier": rows.to_dict()}
    meters = [part["meter"]["episodes"] for part in parts]
    sums = {name: torch.stack([meter[name] for meter in meters]).sum(0) for name in meters[0]}
    if "totals" in sums:  # rank 0 has those of all
        sums["totals"] = meters[0]["totals"]
    whole["meter"] = {**parts[0]["meter"], "episodes": sums}
    draws = [{name: each[name] for name in ("env", "generator")} for each in collectors]
    return {**whole, "ranks": [{"rng": part["rng"], **each} for part, each in zip(parts, draws, strict=True)]}


def share(state: dict[str, Any], rank: int, size: int, algorithm: Callable[..., Any]) -> dict[str, Any]:
    """One rank's share of a checkpoint's content; see :meth:`Ranks.share_of_state`.

    With as many ranks as have saved it, each draws on where it stood; with another number they draw anew.
    """
    result = {**state, "algorithm": algorithm(state["algorithm"], rank, size)}
    episodes = state["meter"]["episodes"]
    if rank:
        cleared = {name: torch.zeros_like(value) for name, value in episodes.items()}
        result["meter"] = {**state["meter"], "episodes": cleared}
    collector, draws = state["collector"], state.get("ranks")
    if not collector:
        return {**result, "rng": None}
    rows = TensorDict(collector["carrier"], collector["batch_size"]).chunk(size)[rank].clone()
    result["collector"] = {**collector, "batch_size": list(rows.batch_size), "carrier": rows.to_dict()}
    if not draws or len(draws) != size:
        result["collector"] |= {"env": None, "generator": None}
        return {**result, "rng": None}
    own = draws[rank]
    result["collector"] |= {name: own[name] for name in ("env", "generator")}
    return {**result, "rng": own["rng"]}
