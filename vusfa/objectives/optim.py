r"""RMSProp as TensorFlow 1 has it, and the information constraint's multiplier.

The released code of Zhu et al. (2017) and of VUSFA trains with TensorFlow's RMSProp, which is not PyTorch's:
epsilon stands inside the root, the accumulator of squared gradients starts at 1 instead of 0 (so that the
first steps are small), and each variable's gradient is clipped by its own norm.
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

    Learning-rate schedulers of torch work as ever; the paper's annealing is a ``LinearLR`` to 0.

    Args:
        params: parameters, or dictionaries of parameter groups.
        lr: learning rate eta.
        alpha: decay of the accumulator.
        eps: added INSIDE the root.
        initial_accumulator: m before the first step. A tensor gets its accumulator with its first gradient.
        max_grad_norm: c, the largest norm of one tensor's gradient; ``None`` leaves gradients as they are.

    Raises:
        ValueError: for a hyperparameter out of its range.
        RuntimeError: in ``step``, for a sparse gradient.

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
        super().__init__(
            params,
            {
                "lr": lr,
                "alpha": alpha,
                "eps": eps,
                "initial_accumulator": initial_accumulator,
                "max_grad_norm": max_grad_norm,
            },
        )

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update the parameters that have a gradient.

        Args:
            closure: re-evaluates the model and returns the loss.

        Returns:
            what ``closure`` returned, else ``None``.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            self._update(group)
        return loss

    def _update(self, group: dict[str, Any]) -> None:
        """Moves the parameters of a group that have a gradient."""
        params, grads, accumulators = self._gather(group)
        if params:
            # few kernels count on a GPU; a tensor at a time stays in a CPU's cache: twice as fast
            foreach = all(param.is_cuda for param in params)
            update = _update_foreach if foreach else _update_one_by_one
            update(
                params,
                grads,
                accumulators,
                group["lr"],
                group["alpha"],
                group["eps"],
                group["max_grad_norm"],
            )

    def _gather(self, group: dict[str, Any]) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        params, grads, accumulators = [], [], []
        for param in group["params"]:
            if param.grad is None:
                continue
            if param.grad.is_sparse:
                raise RuntimeError("TFRMSprop does not take sparse gradients; use dense embeddings")
            state = self.state[param]
            if not state:
                state["square_avg"] = torch.full_like(
                    param, group["initial_accumulator"], memory_format=torch.preserve_format
                )
            params.append(param)
            grads.append(param.grad)
            accumulators.append(state["square_avg"])
        return params, grads, accumulators


def _update_foreach(
    params: list[Tensor],
    grads: list[Tensor],
    accumulators: list[Tensor],
    lr: float,
    alpha: float,
    eps: float,
    max_grad_norm: float | None,
) -> None:
    if max_grad_norm is not None:
        factors = list(torch._foreach_norm(grads))
        torch._foreach_clamp_min_(factors, max_grad_norm)
        torch._foreach_reciprocal_(factors)
        torch._foreach_mul_(factors, max_grad_norm)
        grads = list(torch._foreach_mul(grads, factors))
    torch._foreach_mul_(accumulators, alpha)
    torch._foreach_addcmul_(accumulators, grads, grads, 1.0 - alpha)
    roots = torch._foreach_add(accumulators, eps)
    torch._foreach_sqrt_(roots)
    torch._foreach_addcdiv_(params, grads, roots, -lr)


def _update_one_by_one(
    params: list[Tensor],
    grads: list[Tensor],
    accumulators: list[Tensor],
    lr: float,
    alpha: float,
    eps: float,
    max_grad_norm: float | None,
) -> None:
    for param, grad, accumulator in zip(params, grads, accumulators, strict=True):
        if max_grad_norm is not None and (norm := torch.linalg.vector_norm(grad)) > max_grad_norm:
            grad = grad * (max_grad_norm / norm)
        accumulator.mul_(alpha).addcmul_(grad, grad, value=1.0 - alpha)
        param.addcdiv_(grad, (accumulator + eps).sqrt_(), value=-lr)


class DualAscent:
    r"""Adapts the multiplier of a loss's information bottleneck, as a target updater adapts target networks.

    .. math::
        \beta \leftarrow \max\left(0, \beta + \alpha (KL - I_c)\right)

    KL is that of the loss's last forward pass, I_c its ``information_target`` and beta its
    ``bottleneck_coeff``; all three are buffers of the loss, so that its ``state_dict`` holds everything and
    this object has no state of its own. Before the first forward pass a step changes nothing.

    Args:
        loss: a :class:`~vusfa.objectives.USFLoss` with a bottleneck term.
        step_size: alpha; the paper's code has 1e-6.

    Raises:
        ValueError: when the loss has no bottleneck term, or a number is out of its range.

    >>> from tensordict import TensorDict
    >>> from tensordict.nn import TensorDictModule as Mod, TensorDictSequential as Seq
    >>> from torchrl.modules import ProbabilisticActor
    >>> from vusfa.objectives import USFLoss
    >>> encoder = Mod(torch.nn.Identity(), in_keys=["goal"], out_keys=["goal_loc"])
    >>> scale = Mod(torch.ones_like, in_keys=["goal"], out_keys=["goal_scale"])
    >>> value = Mod(torch.nn.Linear(2, 1), in_keys=["goal"], out_keys=["state_value"])
    >>> policy = Mod(torch.nn.Linear(2, 4), in_keys=["goal"], out_keys=["logits"])
    >>> actor = ProbabilisticActor(
    ...     policy, in_keys=["logits"], distribution_class=torch.distributions.Categorical
    ... )
    >>> loss = USFLoss(actor, Seq(encoder, scale, value), information_target=0.2)
    >>> multiplier = DualAscent(loss, step_size=0.5)
    >>> steps = TensorDict({
    ...     "goal": torch.ones(3, 2), "action": torch.zeros(3, dtype=torch.long),
    ...     "advantage": torch.zeros(3, 1), "value_target": torch.zeros(3, 1),
    ... }, [3])
    >>> loss(steps)["kl"]   # half of 1 nat a feature: the mean is 1, the scale 1
    tensor(0.5000)
    >>> multiplier.step()   # 0 + 0.5 * (0.5 - 0.2)
    >>> loss.bottleneck_coeff
    tensor(0.1500)
    """

    def __init__(self, loss: USFLoss, step_size: float = 1e-6) -> None:
        if getattr(loss, "bottleneck_coeff", None) is None or not loss.has_bottleneck:
            raise ValueError(
                "DualAscent: the loss has no bottleneck term; give USFLoss a bottleneck_coeff (0.0 will do) "
                "and a critic that writes goal_loc and goal_scale, or state_loc and state_scale"
            )
        if step_size < 0:
            raise ValueError(f"DualAscent: step_size is {step_size}; give 0 or more")
        self.loss = loss
        self.step_size = step_size

    def step(self) -> None:
        """Move beta by one step, in place."""
        loss = self.loss
        violation = loss.last_kl - loss.information_target
        loss.bottleneck_coeff.copy_(dual_ascent(loss.bottleneck_coeff, violation, self.step_size))

    def __repr__(self) -> str:
        beta, target = float(self.loss.bottleneck_coeff), float(self.loss.information_target)
        return f"DualAscent(beta={beta:.3g}, information_target={target:.3g}, step_size={self.step_size:.3g})"
