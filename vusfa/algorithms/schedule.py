"""Rates and coefficients that change while the agent learns."""

from __future__ import annotations

__all__ = ["annealed"]


def annealed(frames: int, start: float, horizon: int | None, end: float = 0.0) -> float:
    """A learning rate or coefficient: linear in the frames from ``start`` to ``end`` at ``horizon``, then
    constant.

    Without a horizon it stays at ``start``. A function of the frames, not of the number of calls: there is
    nothing to save, and a resumed run cannot miscount.

    >>> annealed(250, start=4.0, horizon=1000), annealed(250, start=4.0, horizon=None)
    (3.0, 4.0)
    >>> annealed(500, start=4.0, horizon=1000, end=1.0), annealed(2000, start=4.0, horizon=1000, end=1.0)
    (2.5, 1.0)
    """
    return start if horizon is None else start + (end - start) * min(1.0, frames / horizon)
