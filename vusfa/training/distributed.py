"""Data-parallel training: a process per rank, whose gradients are averaged before every optimizer step.

``torchrun --nproc-per-node=N -m vusfa.cli train ...`` starts N ranks with the same settings. Rank r has rows
``r * B`` to ``(r + 1) * B`` of the ``collector.num_envs`` environments, with B = num_envs / N, in all scenes.
It collects and differentiates for itself, in the environments and with the draws that worker r of
``collector=multi_sync`` has: N ranks make the updates of one process with N such workers, to the rounding of
sums. Agent, optimizer and multiplier are the same on all ranks; rank 0 logs, evaluates and saves.

``DistributedDataParallel`` was looked at and left: it averages what the ``forward`` of one module has used,
and here losses run parts of actor and critic in their own way. One all-reduce of all gradients, flat, sends
the same bytes. TorchRL's distributed collectors have one learner, as ``multi_sync`` has.

A rank that dies breaks the connections of the others; one that is silent for ``collector.timeout`` seconds
counts as dead. Every second each rank writes a sign of life to the store of the process group, which is how
the message can name the one that is gone.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn
from torchrl.collectors import BaseCollector

from vusfa.errors import ConfigError, RankError, VusfaError
from vusfa.limits import brief
from vusfa.torchrl_private import process_group_store
from vusfa.training.content import restore
from vusfa.training.ranks import Ranks, check_ranks, merged, share

__all__ = ["ProcessRanks", "joined"]

#: Variables that a launcher sets, such as torchrun or Ray Train.
VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
#: Seconds between signs of life, and without any before a rank is called dead once something is wrong.
BEAT, MISSED = 1.0, 3.0
#: Seconds for all ranks to find each other; and for a ``collector.timeout`` of null.
START, NEVER = 120.0, 1e6


@contextmanager
def joined(settings: Mapping[str, Any], environ: Mapping[str, str] = os.environ) -> Iterator[Ranks]:
    """Context in which this process is one of the ranks that the environment's variables describe.

    A process group that is initialized already (Ray Train's) is used, and left as it is.

    Args:
        settings: of the training, the same on all ranks.
        environ: with :data:`VARIABLES`, and ``LOCAL_RANK``, the GPU's number where ``device=cuda``; where
            they are missing, this process is alone.

    Raises:
        ConfigError: settings that ranks cannot share (on rank 0; a RankError on the others), or variables
            that are no numbers.
        RankError: the ranks do not find each other.
    """
    if any(not environ.get(name) for name in VARIABLES):
        yield Ranks()
        return
    numbers = {name: environ.get(name, "0") for name in (*VARIABLES, "LOCAL_RANK") if name != "MASTER_ADDR"}
    for name, text in numbers.items():
        if not (text.isascii() and text.isdecimal() and len(text) < 10):
            raise ConfigError(f"the environment's {name} is {brief(text)}; torchrun sets it to a number")
    rank, size = int(numbers["RANK"]), int(numbers["WORLD_SIZE"])
    if rank >= max(size, 1):
        raise ConfigError(f"the environment's RANK is {rank}; of {size} ranks the last is {size - 1}")
    if size < 2:
        yield Ranks()
        return
    try:
        check_ranks(settings, size)
    except VusfaError as error:  # all ranks find the same
        raise error if rank == 0 else RankError(f"rank 0: {error}", is_quiet=True) from error
    cuda = str(settings["device"]).startswith("cuda")
    if cuda and torch.cuda.is_available():
        torch.cuda.set_device(int(environ.get("LOCAL_RANK", 0)))
    limit, found = settings["collector"].get("timeout") or NEVER, distributed.is_initialized()
    try:
        if not found:
            backend, wait = "cpu:gloo,cuda:nccl" if cuda else "gloo", timedelta(seconds=START)
            distributed.init_process_group(backend, rank=rank, world_size=size, timeout=wait)
        ranks = ProcessRanks(rank, size, limit, cuda)
    except (RuntimeError, ValueError) as error:
        where, reason = f"{environ['MASTER_ADDR']}:{environ['MASTER_PORT']}", str(error).split("\n")[0]
        raise RankError(f"rank {rank} of {size} does not find the others at {where} ({reason})") from error
    try:
        yield ranks
        ranks.leave("")
    except BaseException as error:
        ranks.leave("" if isinstance(error, RankError) else str(error) or type(error).__name__)
        raise
    finally:
        if not found:
            with suppress(RuntimeError):  # of connections that are broken
                distributed.destroy_process_group()


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
        self._device: Any = distributed.new_group(backend="nccl", timeout=wait) if cuda else self._host
        # torchrun's store outlives the ranks
        self._store: Any = distributed.PrefixStore("vusfa", process_group_store())
        self._steps = self._turns = 0
        self._is_broken, self._stopped = False, 0
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
        self._turns += 1
        key, before, since = f"turn{self._turns}", b"", time.monotonic()
        if self.is_first:
            result = call()
            if not self._is_broken:
                self._store.set(key, json.dumps(result))
            return result
        with self._watched():
            while not self._store.check([key]):
                beat = self._store.get("beat0")
                if beat != before:
                    before, since = beat, time.monotonic()
                if time.monotonic() - since > self._limit or self._store.check(["left0"]):
                    raise RuntimeError("rank 0 does not answer")
                time.sleep(0.02)
            return json.loads(self._store.get(key))

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
            self._is_broken = True
            raise self._lost(error) from error

    def _lost(self, error: RuntimeError) -> RankError:
        """The error of a connection that broke: which rank is gone. The first that is left reports it."""
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
        what = f"the connection between the ranks broke ({str(error).splitlines()[0]})"
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
