"""Conversion of a plan to a Mitsuba scene: shell, furniture, pictures, windows, lamps.

Mitsuba's frame is right-handed with y up: its x is the plan's -X, its z the plan's Z.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.meshes import Part, load_parts, place
from vusfa.sources.render.outline import Rect
from vusfa.sources.render.paintings import painting, view
from vusfa.sources.render.plan import Furniture, Plan, Window
from vusfa.sources.render.surfaces import Textures, draw_textures

__all__ = ["build_scene"]

# Distance from the wall: pictures hang in front of it, views behind a window's frame.
_PICTURE_OUT, _VIEW_OUT = 0.02, 0.01


class _Builder:
    def __init__(self, mi: Any) -> None:
        self.mi = mi
        self.shapes: dict[str, Any] = {
            "type": "scene",
            "integrator": {
                "type": "aov",
                "aovs": "nn:sh_normal,alb:albedo",
                "img": {"type": "path", "max_depth": 5, "rr_depth": 3},
            },
        }
        self._plain: dict[tuple[float, ...], Any] = {}

    def bitmap(self, linear: np.ndarray) -> dict[str, Any]:
        image = self.mi.Bitmap(np.ascontiguousarray(linear, np.float32))
        return {"type": "bitmap", "bitmap": image, "raw": True}

    def painted(self, srgb: np.ndarray, brightness: float = 1.0) -> dict[str, Any]:
        return self.bitmap(np.asarray(srgb, np.float32) ** 2.2 * brightness)

    @staticmethod
    def diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
        return {"type": "twosided", "b": {"type": "diffuse", "reflectance": reflectance}}

    def upright(
        self,
        name: str,
        at: tuple[float, float, float],
        normal: tuple[float, float],
        size: tuple[float, float],
        texture: np.ndarray,
        glow: float = 0.0,
    ) -> None:
        """A textured rectangle with its middle at the plan's (x, height, z); ``glow`` makes it a light."""
        x, y, z = at
        front = np.array([-normal[0], 0.0, normal[1]])
        to_world = np.eye(4)
        to_world[:3, 0] = np.cross([0, 1, 0], front) * size[0] / 2
        to_world[:3, 1] = [0, size[1] / 2, 0]
        to_world[:3, 2] = front
        to_world[:3, 3] = [-x, y, z]
        image = self.painted(texture[::-1], glow or 1.0)
        surface = self.diffuse({"type": "rgb", "value": 0.3} if glow else image)
        transform = self.mi.ScalarTransform4f(to_world)
        self.shapes[name] = {"type": "rectangle", "to_world": transform, "bsdf": surface}
        if glow:
            self.shapes[name]["emitter"] = {"type": "area", "radiance": image}

    def level(self, name: str, rect: Rect, height: float, up: bool, texture: np.ndarray) -> None:
        """A floor (its face up) or a ceiling."""
        x0, z0, x1, z1 = rect
        transform = self.mi.ScalarTransform4f().translate([-(x0 + x1) / 2, height, (z0 + z1) / 2])
        transform = transform.rotate([1, 0, 0], -90 if up else 90).scale([(x1 - x0) / 2, (z1 - z0) / 2, 1])
        surface = self.diffuse(self.painted(texture))
        self.shapes[name] = {"type": "rectangle", "to_world": transform, "bsdf": surface}

    def surface_of(self, part: Part) -> Any:
        if part.texture is None:
            key = tuple(float(value) for value in part.color)
            if key not in self._plain:  # thousands of parts share a few colors
                self._plain[key] = self.mi.load_dict(self.diffuse({"type": "rgb", "value": list(key)}))
            return self._plain[key]
        surface = self.diffuse(self.bitmap(part.texture))
        if part.opacity is not None:
            surface = {"type": "mask", "opacity": self.bitmap(part.opacity), "n": surface}
        return self.mi.load_dict(surface)

    def mesh(self, name: str, part: Part, vertices: np.ndarray) -> None:
        properties = self.mi.Properties()
        properties["bsdf"] = self.surface_of(part)
        mesh = self.mi.Mesh(
            name,
            len(vertices),
            len(part.faces),
            has_vertex_normals=False,
            has_vertex_texcoords=part.uv is not None,
            props=properties,
        )
        values = self.mi.traverse(mesh)
        values["vertex_positions"] = vertices.astype(np.float32).ravel()
        values["faces"] = part.faces.ravel()
        if part.uv is not None:
            flipped = np.stack([part.uv[:, 0], 1 - part.uv[:, 1]], axis=1)
            values["vertex_texcoords"] = flipped.astype(np.float32).ravel()
        values.update()
        self.shapes[name] = mesh


def _add_shell(builder: _Builder, plan: Plan, textures: Textures) -> None:
    height = plan.size[2]
    for k, (rect, texture) in enumerate(textures.floors):
        builder.level(f"floor{k}", rect, 0.001 * k, True, texture)
    builder.level("ceiling", (0.0, 0.0, plan.size[0], plan.size[1]), height, False, textures.ceiling)
    for k, (wall, texture) in enumerate(zip(plan.walls, textures.walls, strict=True)):
        x, z = wall.point(wall.length / 2)
        builder.upright(f"wall{k}", (x, height / 2, z), wall.normal, (wall.length, height), texture)
    lintels = [solid for solid in plan.solids if solid.bottom > 0]
    for k, (solid, texture) in enumerate(zip(lintels, textures.lintels, strict=True)):
        x0, z0, x1, z1 = solid.rect
        middle = [-(x0 + x1) / 2, (height + solid.bottom) / 2, (z0 + z1) / 2]
        half = [(x1 - x0) / 2, (height - solid.bottom) / 2, (z1 - z0) / 2]
        builder.shapes[f"lintel{k}"] = {
            "type": "cube",
            "to_world": builder.mi.ScalarTransform4f().translate(middle).scale(half),
            "bsdf": builder.diffuse(builder.painted(texture[::-1])),
        }


def _facing_normal(facing: float) -> tuple[float, float]:
    angle = np.radians(facing)
    return round(float(np.sin(angle)), 9), round(float(np.cos(angle)), 9)


def build_scene(mi: Any, plan: Plan, catalogue: Catalogue) -> Any:
    """Load a plan into Mitsuba.

    Args:
        mi: the module ``mitsuba`` with its variant set.
        plan: with all sizes (:meth:`Plan.completed`).
        catalogue: with the models' files.

    Returns:
        a scene without a camera, with an integrator that also gives normals and albedo, for the denoiser.

    Raises:
        SceneError: a model is missing or cannot be read.
    """
    builder = _Builder(mi)
    _add_shell(builder, plan, draw_textures(plan))
    loaded: dict[str, list[Part]] = {}
    things: list[Furniture | Window] = [*plan.furniture, *plan.windows]
    for k, item in enumerate(things):
        if item.model not in loaded:
            loaded[item.model] = load_parts(catalogue, catalogue[item.model])
        parts = loaded[item.model]
        assert item.size is not None
        assert item.elevation is not None
        placed = place(parts, item.size, item.at, item.elevation, item.facing)
        for j, (part, vertices) in enumerate(zip(parts, placed, strict=True)):
            if len(part.faces):
                builder.mesh(f"thing{k}_{j}", part, vertices)
    for k, picture in enumerate(plan.pictures):
        normal = _facing_normal(picture.facing)
        x, z = (at + out * _PICTURE_OUT for at, out in zip(picture.at, normal, strict=True))
        texture = painting(picture.seed, *picture.size)
        builder.upright(f"picture{k}", (x, picture.height, z), normal, picture.size, texture)
    for k, light in enumerate(plan.lights):
        transform = mi.ScalarTransform4f().translate([-light.at[0], plan.size[2] - 0.01, light.at[1]])
        builder.shapes[f"light{k}"] = {
            "type": "rectangle",
            "to_world": transform.rotate([1, 0, 0], 90).scale([light.side / 2, light.side / 2, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(light.radiance)}},
        }
    for k, window in enumerate(plan.windows):
        assert window.size is not None
        assert window.elevation is not None
        normal = _facing_normal(window.facing)
        x, z = (at + out * _VIEW_OUT for at, out in zip(window.at, normal, strict=True))
        width, height, _ = window.size
        builder.upright(
            f"view{k}",
            (x, window.elevation + height / 2, z),
            normal,
            (width * 0.92, height * 0.95),
            view(window.view, width, height),
            window.daylight,
        )
    # Optimisation would reorder shapes and lights on every run, which changes the noise.
    return mi.load_dict(builder.shapes, optimize=False)
