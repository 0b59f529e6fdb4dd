"""How a process becomes one of the ranks of a data-parallel training, and how the ranks find each other."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch
from torch import distributed

from vusfa.errors import ConfigError, RankError, VusfaError
from vusfa.limits import brief
from vusfa.training.distributed import NEVER, ProcessRanks
from vusfa.training.ranks import Ranks, check_ranks

__all__ = ["joined"]

#: Variables that a launcher sets, such as torchrun or Ray Train.
VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
#: Seconds to reach the address where the ranks meet. Who does not listen there yet may be late, and gets
#: ``collector.timeout`` seconds, as all ranks get.
REACH = 15.0


@contextmanager
def joined(settings: Mapping[str, Any], environ: Mapping[str, str] = os.environ) -> Iterator[Ranks]:
    """Context in which this process is one of the ranks that the environment's variables describe.

    A process group that is initialized already (Ray Train's) is used, and left as it is.

    Args:
        settings: of the training, the same on all ranks.
        environ: with :data:`VARIABLES`, and ``LOCAL_RANK``, the GPU's number where ``device=cuda``; where
            they are missing, this process is alone. ``TORCHELASTIC_USE_AGENT_STORE`` is True where torchrun
            listens at the address, rather than rank 0.

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
    if not 0 < int(numbers["MASTER_PORT"]) < 1 << 16:
        raise ConfigError(f"the environment's MASTER_PORT is {numbers['MASTER_PORT']}; give 1 to 65535")
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
            own = rank == 0 and environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
            store = _store(environ["MASTER_ADDR"], int(numbers["MASTER_PORT"]), own, limit)
            backend, wait = "cpu:gloo,cuda:nccl" if cuda else "gloo", timedelta(seconds=limit)
            distributed.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=wait)
        ranks = ProcessRanks(rank, size, limit, cuda)
    except (RuntimeError, ValueError, OSError) as error:
        where, reason = f"{environ['MASTER_ADDR']}:{environ['MASTER_PORT']}", str(error).split("\n")[0]
        raise RankError(
            f"rank {rank} of {size} does not find the others at {where} ({reason}); MASTER_ADDR and"
            " MASTER_PORT must lead to rank 0, or to torchrun where it began"
        ) from error
    try:
        with ranks.terminable():
            yield ranks
        ranks.leave("")
    except BaseException as error:
        ranks.leave("" if isinstance(error, RankError) else str(error) or type(error).__name__)
        raise
    finally:
        if not found:
            with suppress(RuntimeError):  # of connections that are broken
                distributed.destroy_process_group()


def _store(host: str, port: int, is_own: bool, patience: float) -> distributed.Store:
    """The store at an address, begun by the one process that it is the own of.

    Raises:
        OSError, RuntimeError: nobody answers, for :data:`REACH` seconds; or nobody listens there, for
            ``patience`` seconds.
    """
    began = time.monotonic()
    while True:
        try:
            if is_own:
                socket.getaddrinfo(host, port)
            else:
                socket.create_connection((host, port), timeout=REACH).close()
            break
        except OSError as error:
            is_late = isinstance(error, ConnectionRefusedError)
            if time.monotonic() - began > (patience if is_late else min(REACH, patience)):
                raise
        time.sleep(0.1)
    wait = timedelta(seconds=REACH)
    store = distributed.TCPStore(
        host, port, is_master=is_own, timeout=wait, wait_for_workers=False, multi_tenant=True
    )
    store.set_timeout(timedelta(seconds=patience))
    return store
