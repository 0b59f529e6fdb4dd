"""The variational siamese bottleneck: embeddings become Gaussians, and omega reads a sample of the goal's.

The encoder gives mean and scale of z for state and goal. pi and psi read the means; omega reads z_g = mean
+ scale * eps while training. How much z may say is held by the KL term of :class:`vusfa.objectives.USFLoss`.
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.modules.siamese import Head, Heads, SiameseEncoder, as_it_is, interleaved, num_parts
from vusfa.objectives.functional import gaussian_kl

__all__ = ["GaussianEncoder", "LatentSampler"]


class GaussianEncoder(nn.Module):
    """A siamese encoder whose code of size 2 E is the mean and the scale of a Gaussian of size E.

    Args:
        encoder: siamese encoder with ``out_features = 2 E``.
        scale: ``"softplus"``: ``softplus`` of the second half, positive. ``"raw"``: the second half as it
            is, of either sign, as in the released code.
        initial_scale: what the scale starts near, by the bias of its layer; ``"softplus"`` only. ``None``
            leaves the bias as it is drawn: near log 2.

    Raises:
        ConfigError: ``initial_scale`` with ``"raw"``, or not positive.

    >>> from vusfa.modules.frames import FeatureFrames
    >>> encoder = SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 4, 16, 2 * 6)
    >>> gaussian, state_id = GaussianEncoder(encoder, initial_scale=0.1), torch.zeros(3, 4, dtype=torch.int64)
    >>> *of_state, goal_loc, goal_scale, goal_kl = gaussian(state_id, torch.arange(3))
    >>> goal_scale.shape, bool((goal_scale > 0).all()), goal_kl.shape
    (torch.Size([3, 6]), True, torch.Size([3, 1]))
    """

    def __init__(
        self,
        encoder: SiameseEncoder,
        scale: Literal["softplus", "raw"] = "softplus",
        initial_scale: float | None = None,
    ) -> None:
        super().__init__()
        if scale not in ("softplus", "raw"):
            raise ConfigError(f"scale is {scale!r}; it must be 'softplus' or 'raw'")
        self.encoder = encoder
        self.scale = scale
        if initial_scale is not None:
            if scale == "raw" or initial_scale <= 0:
                raise ConfigError(
                    f"initial_scale is {initial_scale} with scale {scale!r};"
                    " give a number above 0 with 'softplus', or None"
                )
            for branch in {encoder.branch, encoder.goal_branch or encoder.branch}:
                last = branch.last
                assert last is not None, "a Gaussian code comes from a linear second layer"
                with torch.no_grad():
                    last.bias[last.out_features // 2 :] = math.log(math.expm1(initial_scale))

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Embeddings of state and goal, which are the means; then mean, scale and KL of each; all (\\*B, E),
        the KL (\\*B, 1)."""
        return interleaved(*self.both(state, goal, (as_it_is, as_it_is)))

    def both(self, state: Tensor, goal: Tensor, heads: Heads, part: int | None = None) -> tuple[Any, Any]:
        """What the heads make of the means; then mean, scale and KL; or one part of all these."""
        gaussian = _Gaussian(self.scale, heads[0]), _Gaussian(self.scale, heads[1])
        return self.encoder.both(state, goal, gaussian, part)


class _Gaussian(NamedTuple):
    """Codes to what the head makes of the mean, mean, scale and KL; equal to another one that does the
    same."""

    scale: str
    head: Head

    def __call__(self, code: Tensor) -> tuple[Tensor, ...]:
        loc, scale = code.chunk(2, -1)
        if self.scale == "softplus":
            scale = functional.softplus(scale)
        made = self.head(loc)
        kl = gaussian_kl(loc, scale).sum(-1, keepdim=True)
        return *(made if isinstance(made, tuple) else (made,)), loc, scale, kl

    def alone(self, part: int) -> Head | None:
        """The head of this part alone, where it is made of the means, which are the code's leading half."""
        if part >= num_parts(self.head):
            return None
        return lambda loc: self.head(loc)[part] if num_parts(self.head) > 1 else self.head(loc)


class LatentSampler(nn.Module):
    """z = mean + scale * eps while training; in evaluation mode the mean, or a sample if asked for.

    Deliberately a plain module and no distribution of TorchRL's: its losses switch every distribution to
    its mean.

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
        """Draws eps, standard normal of the mean's shape, from torch's global generator."""
        return torch.randn(loc.shape, dtype=loc.dtype, device=loc.device)

    def forward(self, loc: Tensor, scale: Tensor) -> Tensor:
        """z (\\*B, E) of means and scales (\\*B, E)."""
        if self.training or self.eval_latent == "sample":
            return loc + scale * self.noise(loc)
        return loc
