"""Target-driven visual navigation with universal successor features, as TorchRL components."""

from typing import Any

from vusfa.deprecated import install

__version__ = "0.2.0"

install()


def __getattr__(name: str) -> Any:
    if name == "load_pretrained":  # imported when it is asked for: it needs torch
        from vusfa.deploy import load_pretrained as found

        return found
    raise AttributeError(f"module 'vusfa' has no attribute {name!r}")
