"""Scenes: rooms as graphs of photographed poses.

>>> from vusfa.scenes import SceneSet
>>> SceneSet.bundled()
SceneSet(bathroom: 176, bedroom: 404, kitchen: 680, living_room: 452)
"""

from vusfa.scenes.home import Home, check_home, check_scenes
from vusfa.scenes.scene import Scene
from vusfa.scenes.scene_set import SceneSet
from vusfa.scenes.store import bundled_names, validate

__all__ = ["Home", "Scene", "SceneSet", "bundled_names", "check_home", "check_scenes", "validate"]
