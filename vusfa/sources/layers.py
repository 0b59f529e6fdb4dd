"""Parts of networks: what answers with a layer's output instead of a class."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from vusfa.errors import ConfigError

__all__ = ["Features", "Patches", "UpTo"]


class UpTo(nn.Module):
    """A network that answers with the output of one of its layers."""

    def __init__(self, network: nn.Module, layer: str) -> None:
        super().__init__()
        self.network = network
        self.found: Any = None
        try:
            network.get_submodule(layer).register_forward_hook(self._keep)
        except AttributeError as error:
            names = ", ".join(name for name, _ in network.named_children())
            raise ConfigError(f"the network has no layer {layer!r}; at the top it has {names}") from error

    def _keep(self, module: nn.Module, inputs: Any, output: Any) -> None:
        self.found = output

    def forward(self, images: Tensor) -> Any:
        """The layer's output for images (n, 3, H, W)."""
        self.network(images)
        found, self.found = self.found, None
        return found


class Features(nn.Module):
    """EfficientNet-lite without its classifier."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Maps (n, F, h, w) of images (n, 3, H, W)."""
        return self.network.extract_features(images)  # type: ignore[operator]


class Patches(nn.Module):
    """The patch tokens of a network of timm, as a map."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Tokens as a map (n, F, T, 1), or the map that the network gives."""
        network: Any = self.network
        found = network.forward_features(images)
        if found.ndim == 3:  # tokens, the class and the registers first
            first = getattr(network, "num_prefix_tokens", int(hasattr(network, "cls_token")))
            return found[:, first:].transpose(1, 2).unsqueeze(3)
        if getattr(network, "output_fmt", "NCHW") == "NHWC":  # as Swin gives its map
            return found.permute(0, 3, 1, 2)
        return found
