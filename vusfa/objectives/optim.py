r"""TensorFlow 1's RMSProp, and the information constraint's multiplier.

The released code of Zhu et al. (2017) and of VUSFA trains with TensorFlow's RMSProp: unlike in PyTorch's,
epsilon stands inside the root, the accumulator of squared gradients starts at 1 (the first steps are small),
and each variable's gradient is clipped by its own norm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from vusfa.objectives.functional import dual_ascent

if TYPE_CHECKING:
    from vusfa.objectives.usf import USFLoss

__all__ = ["DualAscent", "TFRMSprop"]


class TFRMSprop(Optimizer):
    r"""RMSProp with TensorFlow's conventions and per-tensor gradient clipping.

    .. math::
        g &\leftarrow g \min(1, c / \lVert g \rVert_2) \\
        m &\leftarrow \alpha m + (1 - \alpha) g^2, \quad m_0 = 1 \\
        \theta &\leftarrow \theta - \eta \, g / \sqrt{m + \epsilon}

    Torch's learning-rate schedulers apply; the paper anneals with a ``LinearLR`` to 0.

    Args:
        params: parameters, or dictionaries of parameter groups.
        lr: learning rate eta.
        alpha: decay of the accumulator.
        eps: added INSIDE the root.
        initial_accumulator: m before the first step; a tensor gets it with its first gradient.
        max_grad_norm: c, the largest norm of one tensor's gradient; ``None`` does not clip.

    Raises:
        ValueError: a hyperparameter out of its range.
        RuntimeError: in ``step``, a sparse gradient.

    >>> weight = torch.nn.Parameter(torch.tensor([1.0]))
    >>> optimiser = TFRMSprop([weight], lr=0.1, alpha=0.5, eps=0.5)
    >>> weight.sum().backward()
    >>> optimiser.step()   # m = 0.5 * 1 + 0.5 * 1 = 1; 1 - 0.1 / sqrt(1.5)
    >>> weight.data
    tensor([0.9184])
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 7e-4,
        alpha: float = 0.99,
        eps: float = 0.1,
        initial_accumulator: float = 1.0,
        max_grad_norm: float | None = 40.0,
    ) -> None:
        ranges = {
            "lr": (lr, lr >= 0),
            "alpha": (alpha, 0 <= alpha <= 1),
            "eps": (eps, eps >= 0),
            "initial_accumulator": (initial_accumulator, initial_accumulator >= 0),
            "max_grad_norm": (max_grad_norm, max_grad_norm is None or max_grad_norm > 0),
        }
        for name, (value, valid) in ranges.items():
            if not valid:
                raise ValueError(f"TFRMSprop: {name} is {value}, which is out of range")
        super().__init__(params, {name: value for name, (value, _) in ranges.items()})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update the parameters that have a gradient; returns what ``closure`` returned, else ``None``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            self._update(group)
        return loss

    def _update(self, group: dict[str, Any]) -> None:
        params, grads, accumulators = self._gather(group)
        if params:
            # few kernels count on a GPU; a tensor at a time stays in a CPU's cache: twice as fast
            foreach = all(param.is_cuda for param in params)
            (_update_foreach if foreach else _update_one_by_one)(params, grads, accumulators, group)

    def _gather(self, group: dict[str, Any]) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        params, grads, accumulators = [], [], []
        for param in group["params"]:
            if param.grad is None:
                continue
            if param.grad.is_sparse:
                raise RuntimeError("TFRMSprop does not take sparse gradients; use dense embeddings")
            params.append(param)
            grads.append(param.grad)
            accumulators.append(self._accumulator(param, group))
        return params, grads, accumulators

    def _accumulator(self, param: Tensor, group: dict[str, Any]) -> Tensor:
        state = self.state[param]
        if not state:
            state["square_avg"] = torch.full_like(
                param, group["initial_accumulator"], memory_format=torch.preserve_format
            )
        return state["square_avg"]

    def share_memory(self) -> None:
        """Move the accumulators of all parameters to shared memory, for several processes to update."""
        for group in self.param_groups:
            for param in group["params"]:
                self._accumulator(param, group).share_memory_()


def _update_foreach(
    params: list[Tensor], grads: list[Tensor], accumulators: list[Tensor], group: dict[str, Any]
) -> None:
    if (limit := group["max_grad_norm"]) is not None:
        factors = list(torch._foreach_norm(grads))
        torch._foreach_clamp_min_(factors, limit)
        torch._foreach_reciprocal_(factors)
        torch._foreach_mul_(factors, limit)
        grads = list(torch._foreach_mul(grads, factors))
    torch._foreach_mul_(accumulators, group["alpha"])
    torch._foreach_addcmul_(accumulators, grads, grads, 1.0 - group["alpha"])
    roots = torch._foreach_add(accumulators, group["eps"])
    torch._foreach_sqrt_(roots)
    torch._foreach_addcdiv_(params, grads, roots, -group["lr"])


def _update_one_by_one(
    params: list[Tensor], grads: list[Tensor], accumulators: list[Tensor], group: dict[str, Any]
) -> None:
    alpha = group["alpha"]
    for param, grad, accumulator in zip(params, grads, accumulators, strict=True):
        grad = clipped(grad, group["max_grad_norm"])
        accumulator.mul_(alpha).addcmul_(grad, grad, value=1.0 - alpha)
        param.addcdiv_(grad, (accumulator + group["eps"]).sqrt_(), value=-group["lr"])


def clipped(grad: Tensor, max_norm: float | None) -> Tensor:
    """A gradient, scaled down to ``max_norm`` where it is longer."""
    if max_norm is not None and (norm := torch.linalg.vector_norm(grad)) > max_norm:
        return grad * (max_norm / norm)
    return grad


class DualAscent:
    r"""Dual ascent of the multiplier of a loss's information bottleneck, stepped like a target updater.

    .. math::
        \beta \leftarrow \max\left(0, \beta + n \alpha (KL - I_c)\right)

    KL is that of the loss's last forward pass, I_c its ``information_target`` and beta its
    ``bottleneck_coeff``: all three are buffers of the loss, and this object has no state of its own. Before
    the first forward pass a step changes nothing.

    Args:
        loss: a :class:`~vusfa.objectives.USFLoss` with a bottleneck term.
        step_size: alpha; the paper's code has 1e-6.
        threads: n, the updates that one step stands for, as in :class:`~vusfa.objectives.A3CRMSprop`.

    Raises:
        ValueError: the loss has no bottleneck term, or a number is out of its range.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.objectives import USFLoss
    >>> from vusfa.scenes import SceneSet
    >>> agent = make_agent("vusfa", scenes=SceneSet.bundled(["bathroom"]), hidden_size=8, embedding_size=8)
    >>> loss = USFLoss(agent.get_policy_operator(), agent.get_value_operator(), information_target=0.2)
    >>> multiplier = DualAscent(loss, step_size=0.5)
    >>> _ = loss.last_kl.fill_(0.5)   # as a forward pass does
    >>> multiplier.step()   # 0 + 0.5 * (0.5 - 0.2)
    >>> loss.bottleneck_coeff
    tensor(0.1500)
    """

    def __init__(self, loss: USFLoss, step_size: float = 1e-6, threads: int = 1) -> None:
        if getattr(loss, "bottleneck_coeff", None) is None or not loss.has_bottleneck:
            raise ValueError(
                "DualAscent: the loss has no bottleneck term; give USFLoss a bottleneck_coeff (0.0 will do) "
                "and a critic that writes goal_loc and goal_scale, or state_loc and state_scale"
            )
        if step_size < 0:
            raise ValueError(f"DualAscent: step_size is {step_size}; give 0 or more")
        self.loss, self.step_size, self.threads = loss, step_size, threads

    def step(self) -> None:
        """Move beta by one step, in place."""
        loss = self.loss
        violation = loss.last_kl - loss.information_target
        step_size = self.step_size * self.threads
        loss.bottleneck_coeff.copy_(dual_ascent(loss.bottleneck_coeff, violation, step_size))

    def __repr__(self) -> str:
        beta, target = float(self.loss.bottleneck_coeff), float(self.loss.information_target)
        return f"DualAscent(beta={beta:.3g}, information_target={target:.3g}, step_size={self.step_size:.3g})"
