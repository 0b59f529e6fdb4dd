"""Walls and furniture of rendered rooms, for floor maps.

A dump that ``vusfa scenes render`` wrote carries the plan of its room, and the package has the plans of its
bundled rooms. A plan is drawn only if the graph and the poses that follow from it are the scene's own.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np

from vusfa.errors import SceneError
from vusfa.scenes import Scene, bundled_names
from vusfa.scenes.store import bundled_path
from vusfa.sources.render import Plan, from_yaml, poses

__all__ = ["plan_of", "plan_shapes"]

_DRAWN = {"floor": "furniture", "hung": "furniture", "rug": "rug", "door": "door"}


def plan_of(scene: Scene) -> Plan | None:
    """The plan that a scene was rendered from; None if unknown.

    Args:
        scene: the scene.

    >>> plan_of(Scene.bundled("bathroom")).size
    (5.1, 4.6, 2.6)
    """
    text = scene.attributes.get("plan")
    if text is None and scene.path is not None and scene.path.stem in bundled_names():
        bundled = scene.path == bundled_path(scene.path.stem).resolve()
        text = _bundled_plan(scene.path.stem) if bundled else None
    if not isinstance(text, str):
        return None
    try:
        plan = from_yaml(text)
        found = poses(plan)
    except SceneError:  # the attribute may also name a file, or be another tool's
        return None
    if found.graph.shape != tuple(scene.graph.shape) or not (found.graph == scene.graph.numpy()).all():
        return None
    alike = np.allclose(found.location, scene.location.numpy(), atol=1e-3)
    return plan if alike and np.allclose(found.rotation, scene.rotation.numpy(), atol=1e-2) else None


def plan_shapes(plan: Plan, scene: Scene) -> dict[str, Any]:
    """Shapes of a plan seen from above, in metres.

    Args:
        plan: of :func:`plan_of`.
        scene: the scene, whose attribute ``models`` names the furniture.

    Returns:
        plain data: ``room``, the rectangle x0, z0, x1, z1; ``solids``, blocks of wall; ``things``, each with
        rect, kind (furniture, rug, door or window) and name.

    >>> room = Scene.bundled("bathroom")
    >>> [thing["name"] for thing in plan_shapes(plan_of(room), room)["things"][:3]]
    ['Bath', 'Shower stall', 'Toilets unit']
    """
    models = scene.attributes.get("models", [])
    names = dict(str(line).partition(" ")[::2] for line in ([models] if isinstance(models, str) else models))
    things = [
        {"rect": list(item.rect), "kind": _DRAWN[item.role], "name": names.get(item.model, item.model)}
        for item in plan.furniture
        if item.role in _DRAWN
    ]
    for window in plan.windows:
        half = (window.size[0] if window.size else 1.0) / 2
        across = (0.0, half) if window.facing % 180 else (half, 0.0)
        (x, z), (dx, dz) = window.at, across
        things.append(
            {
                "rect": [x - dx, z - dz, x + dx, z + dz],
                "kind": "window",
                "name": names.get(window.model, window.model),
            }
        )
    return {
        "room": [0.0, 0.0, plan.size[0], plan.size[1]],
        "solids": [list(solid.rect) for solid in plan.solids],
        "things": things,
    }


@lru_cache
def _bundled_plan(name: str) -> str | None:
    file = files("vusfa.sources.render") / "plans" / f"{name}.yaml"
    return file.read_text(encoding="utf-8") if file.is_file() else None
