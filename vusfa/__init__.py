"""Target-driven visual navigation with universal successor features, as TorchRL components."""

from vusfa.deprecated import install

__version__ = "0.2.0"

install()
