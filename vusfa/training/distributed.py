"""Data-parallel training: a process per rank, whose gradients are averaged before every optimizer step.

``torchrun --nproc-per-node=N -m vusfa.cli train ...`` starts N ranks with the same settings. Rank r has rows
``r * B`` to ``(r + 1) * B`` of the ``collector.num_envs`` environments, with B = num_envs / N, in all scenes.
It collects and differentiates for itself, in the environments and with the draws that worker r of
``collector=multi_sync`` has: N ranks make the updates of one process with N such workers, to the rounding of
sums. Agent, optimizer and multiplier are the same on all ranks. Evaluations are shared out; rank 0 logs and
saves.

``DistributedDataParallel`` was looked at and left: it averages what the ``forward`` of one module has used,
and here losses run parts of actor and critic in their own way. One all-reduce of all gradients, flat, sends
the same bytes. TorchRL's distributed collectors have one learner, as ``multi_sync`` has.

A rank that dies breaks the connections of the others; one that is silent for ``collector.timeout`` seconds
counts as dead. Every second each rank writes a sign of life to the store of the process group, which is how
the message can name the one that is gone.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn
from torchrl.collectors import BaseCollector

from vusfa.errors import RankError, VusfaError
from vusfa.torchrl_private import process_group_store
from vusfa.training.content import restore
from vusfa.training.ranks import Ranks, merged, share

__all__ = ["ProcessRanks"]

#: Seconds between signs of life, and without any before a rank is called dead once something is wrong.
BEAT, MISSED = 1.0, 3.0
#: Seconds for a ``collector.timeout`` of null, and for waits as long as the others give signs of life.
NEVER = 1e6


class ProcessRanks(Ranks):
    """Ranks that are processes of :mod:`torch.distributed`, seen by one of them.

    Args:
        rank, size: its number, from 0 on, and how many there are.
        limit: seconds after which a silent rank counts as dead.
        cuda: whether the agent is on a GPU.
    """

    def __init__(self, rank: int, size: int, limit: float, cuda: bool) -> None:
        super().__init__(rank, size)
        self._limit, wait = limit, timedelta(seconds=limit)
        self._host: Any = distributed.new_group(backend="gloo", timeout=wait)
        self._patient: Any = distributed.new_group(backend="gloo", timeout=timedelta(seconds=NEVER))
        self._device: Any = distributed.new_group(backend="nccl", timeout=wait) if cuda else self._host
        # torchrun's store outlives the ranks
        self._store: Any = distributed.PrefixStore("vusfa", process_group_store())
        self._steps, self._is_broken, self._stopped = 0, False, 0
        self._left = threading.Event()
        self._store.set(f"who{rank}", f"rank {rank} (process {os.getpid()} on {socket.gethostname()})")
        self._beat()
        threading.Thread(target=self._live, daemon=True).start()

    def average(self, params: Sequence[nn.Parameter], terms: dict[str, Tensor]) -> None:
        """One all-reduce of all numbers. A gradient that some ranks do not have counts as 0 there."""
        names, device = list(terms), params[0].device
        received = torch.tensor([float(self.signal() or 0)])
        if device.type != "cpu":  # finds a rank that is gone, for which NCCL would wait
            self._reduce(received, self._host)
        present = torch.tensor([float(param.grad is not None) for param in params])
        parts = [torch.zeros_like(param) if param.grad is None else param.grad for param in params]
        parts += [torch.stack([terms[name].detach().float() for name in names]), present, received]
        flat = torch.cat([part.flatten().to(device) for part in parts])
        self._reduce(flat, self._device)
        *means, scalars, present, received = flat.split([part.numel() for part in parts])
        for param, mean, known in zip(params, means, present.tolist(), strict=True):
            if known:
                param.grad = mean.view_as(param)
        terms.update(zip(names, scalars.unbind(), strict=True))
        if float(received):
            self._stopped = self.signal() or signal.SIGTERM

    @property
    def stopped(self) -> int | None:
        """Signal that any rank had received at the last average."""
        return self._stopped or None

    def mean(self, value: Tensor) -> Tensor:
        """By an all-reduce."""
        value = value.clone()
        self._reduce(value, self._device if value.is_cuda else self._host)
        return value

    def equalize(self, params: Sequence[Tensor]) -> None:
        """By broadcasts."""
        with self._watched(), torch.no_grad():
            for param in params:
                distributed.broadcast(param, 0, group=self._device)

    def seed(self, collector: BaseCollector, seed: int) -> None:
        """As ``MultiSyncCollector.set_seed`` seeds its worker of this number."""
        for _ in range(self.rank):
            seed = collector.set_seed(seed)
        collector.set_seed(seed)
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        collector.reset()

    def gather(self, state: Any) -> list[Any]:
        """Pickled, to processes of the same program."""
        if self._is_broken:
            return [state]
        found: list[Any] | None = [None] * self.size if self.is_first else None
        with self._watched():
            distributed.gather_object(state, found, 0, group=self._host)
        return [] if found is None else found

    def first(self, call: Callable[[], Any]) -> Any:
        """The others wait for as long as rank 0 gives signs of life."""
        found = [call() if self.is_first else None]
        with self._watched():
            self._meet()
            distributed.broadcast_object_list(found, 0, group=self._host)
        return found[0]

    def collect(self, own: list[Any]) -> list[Any]:
        """Pickled, to processes of the same program."""
        with self._watched():
            self._meet()
        found = self.gather(own)
        return [found[part % self.size][part // self.size] for part in range(sum(map(len, found)))]

    def _meet(self) -> None:
        """Wait for all ranks. A connection that breaks ends it at once, and so does a silent rank: each
        watches over the next."""
        work: Any = distributed.all_reduce(torch.zeros(1), group=self._patient, async_op=True)
        other, before, since, looked = (self.rank + 1) % self.size, b"", time.monotonic(), 0.0
        while not work.is_completed():
            time.sleep(0.002)
            if time.monotonic() - looked < BEAT:
                continue
            looked, beat = time.monotonic(), self._store.get(f"beat{other}")
            if beat != before:
                before, since = beat, looked
            has_left = self._store.check([f"left{other}"])
            if looked - since > (MISSED if has_left else self._limit):
                raise RuntimeError(f"rank {other} {'has left' if has_left else 'does not answer'}")
        work.wait()

    @contextmanager
    def preparing(self) -> Iterator[None]:
        """The ranks exchange their errors at the end of the context."""
        mine: VusfaError | None = None
        try:
            yield
        except VusfaError as error:
            mine = error
        found: list[str | None] = [None] * self.size
        with self._watched():
            self._meet()
            distributed.all_gather_object(found, None if mine is None else str(mine), group=self._host)
        failed = next((rank for rank, message in enumerate(found) if message is not None), None)
        if mine is not None and failed == self.rank:
            raise mine
        if failed is not None:
            raise RankError(f"rank {failed}: {found[failed]}", is_quiet=True) from mine

    def merge(self, own: dict[str, Any], algorithm: Callable[[list[Any]], Any]) -> dict[str, Any]:
        """On the others: the own entries, which nobody needs."""
        parts = self.gather(own)
        return merged(parts, self.size, algorithm) if parts else own

    def share_of_state(
        self, path: str | Path, state: dict[str, Any], algorithm: Callable[..., Any]
    ) -> dict[str, Any]:
        """Errors of :func:`~vusfa.training.content.restore`."""
        found: dict[str, Any] = {}
        restore(path, "ranks", lambda _: found.update(share(state, self.rank, self.size, algorithm)), state)
        return found

    @contextmanager
    def terminable(self) -> Iterator[None]:
        """Context in which SIGTERM, which a launcher sends to the others when a rank has ended, is the error
        that names this rank."""
        if threading.current_thread() is not threading.main_thread():  # only that one may set handlers
            yield
            return
        before = signal.signal(signal.SIGTERM, self._terminated)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, before or signal.SIG_DFL)

    def leave(self, reason: str) -> None:
        """End the signs of life; the reason is empty where another rank has ended before, or all is done."""
        self._left.set()
        with suppress(RuntimeError):
            self._store.set(f"left{self.rank}", reason)

    def _reduce(self, value: Tensor, group: Any) -> None:
        self._steps += 1
        with self._watched():
            distributed.all_reduce(value, group=group)
        value /= self.size

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise self._lost(f"the connection between the ranks broke ({reason})") from error

    def _terminated(self, number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise self._lost(f"rank {self.rank} was ended by SIGTERM")

    def _lost(self, what: str) -> RankError:
        """The error that names the rank that is gone, or says what happened where none is. The first rank
        that is left reports it."""
        self._is_broken = True
        try:
            before = self._signs("beat")
            time.sleep(MISSED)
            beats, left, who = self._signs("beat"), self._signs("left"), self._signs("who")
        except RuntimeError:  # the store is gone with rank 0, or with its machine
            return RankError("rank 0 has ended, or its machine is gone", is_quiet=self.rank != 1)
        others = [rank for rank in range(self.size) if rank != self.rank]
        ended = [rank for rank in others if left.get(rank)]
        dead = [rank for rank in others if rank not in left and beats[rank] == before[rank]]
        late = [rank for rank in others if int(beats[rank].split()[1]) < self._steps and rank not in left]
        if ended:
            what = f"{who[ended[0]]} has ended: {left[ended[0]]}"
        elif dead:
            what = f"{', '.join(who[rank] for rank in dead)} has ended, or does not answer"
        elif late:
            what = f"{', '.join(who[rank] for rank in late)} has sent nothing for {self._limit:g} s"
            what += " (collector.timeout)"
        first = min(rank for rank in range(self.size) if rank not in [*ended, *(dead or late)])
        return RankError(what, is_quiet=0 in ended or first != self.rank)

    def _signs(self, kind: str) -> dict[int, str]:
        keys = {rank: f"{kind}{rank}" for rank in range(self.size)}
        return {rank: self._store.get(key).decode() for rank, key in keys.items() if self._store.check([key])}

    def _beat(self) -> None:
        self._store.set(f"beat{self.rank}", f"{time.monotonic()} {self._steps}")

    def _live(self) -> None:
        with suppress(RuntimeError):  # the store is gone
            while not self._left.wait(BEAT):
                self._beat()
