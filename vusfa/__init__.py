"""Target-driven visual navigation with universal successor features, as TorchRL components."""

__version__ = "0.1.0"
