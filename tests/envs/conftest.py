from __future__ import annotations

from collections.abc import Callable

import pytest

from vusfa.scenes import Scene, SceneSet


@pytest.fixture
def scenes(make_scene: Callable[..., Scene]) -> SceneSet:
    """Two rooms, 16 and 12 states."""
    return SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])
