"""Settings of a training, as Hydra's configuration files."""

from pathlib import Path

__all__ = ["FOLDER"]

#: Folder of the configuration files.
FOLDER = Path(__file__).parent
