r"""A3C's step for a batch of threads.

In A3C (Mnih et al. 2016, https://arxiv.org/abs/1602.01783, Algorithm S3) each of K threads computes the
gradient of its own few steps and applies it to the shared weights: K updates for K rollouts. A batch of K
environments has the mean of these gradients, and one update with the mean moves the weights K times less.
:class:`A3CRMSprop` takes the step that the K updates take together.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from vusfa.objectives.optim import TFRMSprop

__all__ = ["A3CRMSprop", "check_threads"]

#: Numbers of a tensor that are updated at once on a processor.
PIECE = 32768


class A3CRMSprop(TFRMSprop):
    r"""TensorFlow's RMSProp, applied for several threads at once.

    Take gradients :math:`g_1 \dots g_n` of n threads, all computed at the same weights, and let
    :math:`\hat g_k = g_k \min(1, c / \lVert g_k \rVert_2)`, tensor by tensor. Then n updates of
    :class:`~vusfa.objectives.TFRMSprop`, one per thread, give

    .. math::
        m_k &= \alpha^k m_0 + (1 - \alpha) \sum_{j \le k} \alpha^{k - j} \hat g_j^2 \\
        \theta_n &= \theta_0 - \eta \sum_k \hat g_k / \sqrt{m_k + \epsilon}

    In A3C each thread's gradient is of weights that other threads have moved since; by Taylor's theorem that
    changes :math:`\theta_n` by terms of second order in :math:`\eta`. With only the mean :math:`\bar g` of
    the gradients at hand, this class sets :math:`\hat g_k^2 \approx \bar g^2` and takes the root in the
    middle of the sequence:

    .. math::
        m_{mid} &= \alpha^{(n + 1) / 2} m_0 + (1 - \alpha^{(n + 1) / 2}) \bar g^2 \\
        \theta_n &= \theta_0 - \eta \, n \bar g / \sqrt{m_{mid} + \epsilon} \\
        m_n &= \alpha^n m_0 + (1 - \alpha^n) \bar g^2

    With n = 1 this is :class:`~vusfa.objectives.TFRMSprop`, number for number. What is approximated:

    - **The root's place.** The accumulator falls from its initial 1; once it stands still, nothing is lost.
    - **The second moment.** The mean of :math:`g_k^2` lies between :math:`\bar g^2` and :math:`n \bar g^2`.
      The difference matters where it is not small beside epsilon.
    - **Clipping.** The mean is clipped at c. That is clipping per thread unless some thread's gradient of a
      tensor is longer than c.

    Measured with the gradients of 50 threads of the untrained GVF of ``preset=paper`` in the bathroom: the
    step differs from that of 50 updates by 1.1 % of its length when the accumulator starts at 1 (0.2 % in
    groups of 10 threads) and by 0.02 % when it holds the threads' second moment; one update with the mean
    differs by 98 %. The longest gradient of a tensor was 0.18, far from 40.

    With fewer threads per step (``threads``) less is approximated, and each step's gradient is of the weights
    that the step before has left; ``threads=1`` is the sequence itself.

    Args:
        params, lr, alpha, eps, initial_accumulator, max_grad_norm: of
            :class:`~vusfa.objectives.TFRMSprop`, per thread.
        threads: n, the threads whose gradients' mean is in ``.grad``. A thread's gradient is that of the SUM
            of its losses over its steps (the released code's), so a mean loss over threads and T steps counts
            T times.

    Raises:
        ValueError: for a hyperparameter out of its range.

    >>> weight = torch.nn.Parameter(torch.tensor([1.0]))
    >>> optimizer = A3CRMSprop([weight], threads=100)
    >>> weight.sum().backward()
    >>> optimizer.step()   # nearly 100 steps of 7e-4 / sqrt(1 + 0.1)
    >>> weight.data
    tensor([0.9333])
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 7e-4,
        alpha: float = 0.99,
        eps: float = 0.1,
        initial_accumulator: float = 1.0,
        max_grad_norm: float | None = 40.0,
        *,
        threads: int = 1,
    ) -> None:
        if not isinstance(threads, int) or isinstance(threads, bool) or threads < 1:
            raise ValueError(f"A3CRMSprop: threads is {threads!r}; give a whole number of 1 or more")
        super().__init__(params, lr, alpha, eps, initial_accumulator, max_grad_norm)
        for group in self.param_groups:
            group["threads"] = threads

    def _update(self, group: dict[str, Any]) -> None:
        """As ``threads`` updates would move them."""
        for param, grad, accumulator in zip(*self._gather(group), strict=True):
            _step_of_threads(param, grad, accumulator, group)


def _step_of_threads(param: Tensor, grad: Tensor, accumulator: Tensor, group: dict[str, Any]) -> None:
    threads, alpha, limit = group["threads"], group["alpha"], group["max_grad_norm"]
    if limit is not None and (norm := torch.linalg.vector_norm(grad)) > limit:
        grad = grad * (limit / norm)
    after, middle = alpha**threads, alpha ** ((threads + 1) / 2)
    for weight, slope, square in _pieces(param, grad, accumulator):
        root = (square * middle).addcmul_(slope, slope, value=1.0 - middle).add_(group["eps"])
        square.mul_(after).addcmul_(slope, slope, value=1.0 - after)
        weight.addcdiv_(slope, root.sqrt_(), value=-group["lr"] * threads)


def _pieces(*tensors: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """The same parts of tensors of one shape, each small enough to stay in a processor's cache."""
    if tensors[0].is_cuda or not all(tensor.is_contiguous() for tensor in tensors):
        return [tensors]
    return zip(*(tensor.view(-1).split(PIECE) for tensor in tensors), strict=True)


def check_threads(threads: int, threads_per_update: int | None) -> int:
    """The number of threads per update: ``threads_per_update``, or all of them for None.

    Args:
        threads: K, environments of a batch, one per thread.
        threads_per_update: n; K must be a multiple of it.

    Raises:
        ValueError: n is no whole number, below 1, or does not divide K.

    >>> check_threads(100, None), check_threads(100, 25)
    (100, 25)
    >>> check_threads(100, 30)
    Traceback (most recent call last):
    ...
    ValueError: threads_per_update is 30, which does not divide the 100 threads; give 25 or 50
    """
    if threads_per_update is None:
        return threads
    if (
        not isinstance(threads_per_update, int)
        or isinstance(threads_per_update, bool)
        or threads_per_update < 1
    ):
        raise ValueError(f"threads_per_update is {threads_per_update!r}; give a whole number of 1 or more")
    if threads % threads_per_update:
        divisors = [n for n in range(1, threads + 1) if threads % n == 0]
        below = max(n for n in divisors if n < threads_per_update)
        above = min((n for n in divisors if n > threads_per_update), default=None)
        near = f"{below}" if above is None else f"{below} or {above}"
        raise ValueError(
            f"threads_per_update is {threads_per_update}, which does not divide the {threads} threads;"
            f" give {near}"
        )
    return threads_per_update
