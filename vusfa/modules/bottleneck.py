"""Variational siamese bottleneck: embeddings are Gaussians, and omega reads a sample of the goal's.

pi and psi read the means. The KL term of :class:`vusfa.objectives.USFLoss` limits what z may say.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchrl.objectives import add_random_module

from vusfa.errors import ConfigError

__all__ = ["GaussianBottleneck", "LatentSampler", "gaussian_kl"]


def gaussian_kl(loc: Tensor, scale: Tensor, eps: float = 1e-8) -> Tensor:
    r"""Divergence of N(loc, scale^2) from N(0, 1), elementwise, in nats.

    .. math::
        \tfrac12 \left(\mu^2 + \sigma^2 - \log(\sigma^2 + \epsilon) - 1\right)

    Args:
        loc: mean, any shape; that of the result, too.
        scale: standard deviation, the same shape; of either sign, for only its square counts.
        eps: keeps the logarithm finite at scale 0.

    Raises:
        ValueError: the shapes differ.

    >>> gaussian_kl(torch.tensor([0.0, 2.0]), torch.tensor([1.0, -1.0]))
    tensor([0., 2.])
    """
    if loc.shape != scale.shape:
        shapes = {"loc": tuple(loc.shape), "scale": tuple(scale.shape)}
        raise ValueError(f"gaussian_kl: shapes differ: {shapes}; give equal ones")
    if loc.dtype in (torch.bfloat16, torch.float16):
        # eps and the difference of near-equal numbers need more digits, as under autocast
        loc, scale = loc.float(), scale.float()
    variance = scale.square()
    return 0.5 * (loc.square() + variance - torch.log(variance + eps) - 1.0)


class GaussianBottleneck(nn.Module):
    """Codes of size 2 E as mean and scale of a Gaussian of size E.

    Args:
        scale: ``"softplus"`` of the code's second half; or ``"raw"``: that half, as in the released code.
        initial_scale: scale at the start, set by the bias of the layer that makes the code (``"softplus"``
            only); ``None`` leaves the bias as it is drawn: near log 2.

    Raises:
        ConfigError: ``initial_scale`` with ``"raw"``, or not positive.

    >>> loc, scale, kl = GaussianBottleneck()(torch.randn(3, 12))
    >>> loc.shape, bool((scale > 0).all()), kl.shape
    (torch.Size([3, 6]), True, torch.Size([3, 1]))
    """

    def __init__(
        self, scale: Literal["softplus", "raw"] = "softplus", initial_scale: float | None = None
    ) -> None:
        super().__init__()
        if scale not in ("softplus", "raw"):
            raise ConfigError(f"scale is {scale!r}; it must be 'softplus' or 'raw'")
        if initial_scale is not None and (scale == "raw" or initial_scale <= 0):
            raise ConfigError(
                f"initial_scale is {initial_scale} with scale {scale!r};"
                " give a number above 0 with 'softplus', or None"
            )
        self.scale = scale
        self.initial_scale = initial_scale

    @torch.no_grad()
    def start(self, layer: nn.Linear) -> None:
        """Set the bias of the layer that makes the code so that scales begin near ``initial_scale``."""
        if self.initial_scale is not None:
            layer.bias[layer.out_features // 2 :] = math.log(math.expm1(self.initial_scale))

    def forward(self, code: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean and scale (\\*B, E), and KL, summed over E, (\\*B, 1), of codes (\\*B, 2 E)."""
        loc, scale = code.chunk(2, -1)
        if self.scale == "softplus":
            scale = functional.softplus(scale)
        return loc, scale, gaussian_kl(loc, scale).sum(-1, keepdim=True)


class LatentSampler(nn.Module):
    """z = mean + scale * eps while training; in evaluation mode the mean, or a sample if asked for.

    It is no distribution of TorchRL's, whose losses switch every distribution to its mean.

    Args:
        eval_latent: what evaluation mode gives, ``"mean"`` or ``"sample"``.

    >>> sampler, loc, scale = LatentSampler(), torch.zeros(2, 3), torch.ones(2, 3)
    >>> bool((sampler(loc, scale) == 0).any()), bool((sampler.eval()(loc, scale) == 0).all())
    (False, True)
    """

    def __init__(self, eval_latent: Literal["mean", "sample"] = "mean") -> None:
        super().__init__()
        if eval_latent not in ("mean", "sample"):
            raise ConfigError(f"eval_latent is {eval_latent!r}; it must be 'mean' or 'sample'")
        self.eval_latent = eval_latent

    def noise(self, loc: Tensor) -> Tensor:
        """Draw eps, standard normal of the mean's shape, from torch's global generator."""
        return torch.randn(loc.shape, dtype=loc.dtype, device=loc.device)

    def forward(self, loc: Tensor, scale: Tensor) -> Tensor:
        """z (\\*B, E) of means and scales (\\*B, E)."""
        if self.training or self.eval_latent == "sample":
            return loc + scale * self.noise(loc)
        return loc


add_random_module(LatentSampler)  # TorchRL's vmap over a critic lets it draw
