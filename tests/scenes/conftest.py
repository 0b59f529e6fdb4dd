from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from vusfa.scenes.graph import shortest_path_distances


@pytest.fixture
def make_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scene file by h5py alone, as another program would; any dataset replaced or left out."""

    def make(name: str = "room.h5", attributes: dict[str, Any] | None = None, **changes: Any) -> Path:
        # A ring of five states: action 0 onwards, action 1 back, action 2 always blocked.
        states = np.arange(5)
        graph = np.stack([(states + 1) % 5, (states - 1) % 5, np.full(5, -1)], axis=1)
        datasets = {
            "graph": graph,
            "resnet_feature": np.random.default_rng(0).standard_normal((5, 2, 7)).astype(np.float32),
            "location": np.stack([states * 0.5, states * 0.25], axis=1),
            "rotation": states * 90 % 360,
            "shortest_path_distance": shortest_path_distances(graph).numpy().astype(np.int64),
        }
        datasets.update(changes)
        path = tmp_path / name
        with h5py.File(path, "w") as file:
            for key, value in datasets.items():
                if value is not None:
                    file[key] = value
            file.attrs.update(attributes or {})
        return path

    return make


@pytest.fixture
def pictures() -> np.ndarray:
    """Five different pictures, (5, 6, 8, 3)."""
    return np.random.default_rng(1).integers(0, 256, (5, 6, 8, 3), dtype=np.uint8)
