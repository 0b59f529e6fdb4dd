"""The camera: a denoised frame per pose, and its tone mapping to a picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vusfa.errors import SceneError
from vusfa.sources.render.plan import Camera

__all__ = ["Renderer", "exposure_of", "look_at", "tone_map"]

#: Median brightness of a room's frames after exposure.
_MEDIAN = 0.21


def look_at(x: float, z: float, heading: float, camera: Camera) -> tuple[list[float], list[float]]:
    """Position of the camera and a point in view, in the renderer's frame (x to the left, y up).

    >>> look_at(2.0, 1.0, 90.0, Camera(pitch=0.0))
    ([-2.0, 1.4, 1.0], [-3.0, 1.4, 1.0])
    """
    turn = math.radians(heading)
    drop = math.tan(math.radians(camera.pitch))
    target = [-x - math.sin(turn), camera.height - drop, z + round(math.cos(turn), 12)]
    return [-x, camera.height, z], target


def exposure_of(frames: np.ndarray) -> float:
    """Factor that brings the median brightness of linear frames (n, H, W, 3) to 0.21.

    Raises:
        SceneError: the frames are black.

    >>> exposure_of(np.full((2, 4, 4, 3), 0.42))
    0.5
    """
    median = float(np.median(frames.mean(axis=-1)))
    if not median > 0:
        raise SceneError("the room is dark: give the plan a light or a window")
    return _MEDIAN / median


def tone_map(frame: np.ndarray, exposure: float) -> np.ndarray:
    """Convert a linear frame (..., 3) to sRGB uint8; bright values are compressed by v / (1 + v / 5).

    >>> tone_map(np.array([0.0, 0.1, 1e9]), 1.0).tolist()
    [0, 88, 255]
    """
    value = np.clip(np.nan_to_num(frame) * exposure, 0, None)
    value = np.clip(value / (1 + 0.2 * value), 0, 1)
    value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return (value * 255 + 0.5).astype(np.uint8)


class Renderer:
    """Renders frames of one scene.

    Args:
        mi: the module ``mitsuba`` with its variant set.
        scene: from :func:`vusfa.sources.render.geometry.build_scene`.
        camera: the camera.
    """

    def __init__(self, mi: Any, scene: Any, camera: Camera) -> None:
        self._mi, self._scene, self._camera = mi, scene, camera
        self._sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": camera.fov,
                "fov_axis": "x",
                "near_clip": 0.02,
                "to_world": self._pose(0.0, 0.0, 0.0),
                # A wider filter would correlate the noise of pixels; the denoiser would keep it as detail.
                "film": {
                    "type": "hdrfilm",
                    "width": camera.resolution[0],
                    "height": camera.resolution[1],
                    "rfilter": {"type": "box"},
                },
            }
        )
        self._values = mi.traverse(self._sensor)
        integrator = scene.integrator()

        def layers(scene: Any, sensor: Any, seed: Any) -> Any:
            # mi.render would turn Ctrl-C into a RuntimeError.
            return integrator.render(scene, sensor, seed=seed, spp=camera.samples, evaluate=False)

        self._layers: Callable[[Any, Any, Any], Any] = layers
        self._recorded = mi.variant() == "scalar_rgb"  # which compiles nothing

    def _pose(self, x: float, z: float, heading: float) -> Any:
        origin, target = look_at(x, z, heading, self._camera)
        return self._mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])

    def _opaque(self, seed: int) -> Any:
        """The seed as a variable: a literal would be part of the program."""
        if self._mi.variant() == "scalar_rgb":
            return seed
        import drjit

        return drjit.opaque(self._mi.UInt32, seed)

    def frame(self, x: float, z: float, heading: float, seed: int) -> np.ndarray:
        """Render the view from a pose, (H, W, 3) linear float32; the same seed gives the same noise."""
        import mitsuba_oidn

        self._values["to_world"] = self._pose(x, z, heading)
        self._values.update()
        try:
            layers = np.array(self._layers(self._scene, self._sensor, self._opaque(seed)))
        except RuntimeError as error:
            if isinstance(error.__cause__, KeyboardInterrupt | SystemExit):  # a signal within Dr.Jit
                raise error.__cause__ from None
            raise
        if not self._recorded:
            import drjit

            # All frames are one program, traced once and replayed with the pose and the seed of each. The
            # first frame builds what a recording must find in the scene.
            self._layers, self._recorded = drjit.freeze(self._layers), True
        color, normal, albedo = (
            np.ascontiguousarray(layer, np.float32)
            for layer in (layers[..., :3], layers[..., -6:-3], np.clip(layers[..., -3:], 0, 1))
        )
        return np.array(mitsuba_oidn.denoise(color, albedo=albedo, normal=normal, hdr=True))
