"""Rates and coefficients that change while the agent learns, and how many updates one step stands for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vusfa.errors import ConfigError

__all__ = ["annealed", "threads_per_step"]


def annealed(frames: int, start: float, horizon: int | None, end: float = 0.0) -> float:
    """A rate or coefficient: linear in the frames from ``start`` to ``end`` at ``horizon``, then constant.

    Without a horizon it stays at ``start``. As a function of the frames it needs no state: a resumed run
    cannot miscount.

    >>> annealed(250, start=4.0, horizon=1000), annealed(250, start=4.0, horizon=None)
    (3.0, 4.0)
    >>> annealed(500, start=4.0, horizon=1000, end=1.0), annealed(2000, start=4.0, horizon=1000, end=1.0)
    (2.5, 1.0)
    """
    return start if horizon is None else start + (end - start) * min(1.0, frames / horizon)


def threads_per_step(settings: Mapping[str, Any]) -> int | None:
    """Threads, one per environment, whose updates one optimizer step stands for
    (:class:`~vusfa.objectives.A3CRMSprop`).

    Args:
        settings: all settings of a training; ``optim.options.threads_per_update`` is the number, None for all
            environments of a batch.

    Returns:
        None for any other optimizer, which makes one update with the batch's mean gradient.

    Raises:
        ConfigError: a number that does not divide the batch's environments.

    >>> optim = {"kind": "a3c_rmsprop", "options": {"threads_per_update": None}}
    >>> threads_per_step({"optim": optim, "collector": {"kind": "single", "num_envs": 100}})
    100
    """
    optim = settings.get("optim", {})  # your own algorithm may have no settings at all
    if optim.get("kind") != "a3c_rmsprop":
        return None
    collector = settings["collector"]
    workers = collector["num_workers"] if collector["kind"] in ("multi_async", "hogwild") else 1
    threads = collector["num_envs"] // workers
    given = optim["options"].get("threads_per_update")
    if given is None:
        return threads
    name = f"optim.options.threads_per_update is {given!r}"
    if not isinstance(given, int) or isinstance(given, bool) or given < 1:
        raise ConfigError(f"{name}; give a whole number of 1 or more")
    if threads % given:
        divisors = [n for n in range(1, threads + 1) if threads % n == 0]
        near = [max(n for n in divisors if n < given), *(n for n in divisors if n > given)][:2]
        raise ConfigError(
            f"{name}, which does not divide the {threads} threads; give {' or '.join(map(str, near))}"
        )
    return given
