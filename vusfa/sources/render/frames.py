"""Frames of a room, saved one by one, so that rendering can be stopped at any moment.

The exposure is measured from some frames of all over the room, which are rendered first and kept as they are:
resumed or not, the pictures come out the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vusfa.sources.render.grid import Poses
from vusfa.sources.render.plan import Plan
from vusfa.sources.render.plan_file import to_yaml
from vusfa.sources.render.renderer import exposure_of, tone_map
from vusfa.sources.render.textures import random_stream
from vusfa.sources.row_log import RowLog

__all__ = ["Frames"]

_PROBES = 24

#: ``frame(x, z, heading, seed)`` gives a linear picture (H, W, 3).
FrameOf = Callable[[float, float, float, int], np.ndarray]


class Frames:
    """All frames of a room, in two hidden logs beside the product.

    Args:
        plan: the room.
        room: its poses.
        path: the product.
        work: what else the frames depend on, such as versions; other frames that lie there are thrown away.
    """

    def __init__(self, plan: Plan, room: Poses, path: Path, work: Mapping[str, Any]) -> None:
        self._room = room
        width, height = plan.camera.resolution
        shape = (height, width, 3)
        order = random_stream(plan.surfaces.seed).permutation(room.num_states)
        self._probed = [int(state) for state in order[:_PROBES]] if plan.camera.exposure is None else []
        self._given = plan.camera.exposure
        described = {"plan": to_yaml(plan), **work}
        probes, frames = (path.with_name(f".{path.name}.{kind}") for kind in ("probes", "frames"))
        self._probes = RowLog(probes, described, np.dtype((np.float32, shape)))
        self._frames = RowLog(frames, described, np.dtype((np.uint8, shape)))
        #: frames rendered by this object
        self.rendered = 0

    @property
    def done(self) -> int:
        """Frames that need no more rendering."""
        waiting = sum(state >= len(self._frames) for state in self._probed[: len(self._probes)])
        return len(self._frames) + waiting

    @property
    def complete(self) -> bool:
        """Whether all frames are rendered."""
        return len(self._probes) == len(self._probed) and len(self._frames) == self._room.num_states

    @property
    def exposure(self) -> float:
        """The plan's, or else what the first frames say; these must be there.

        Raises:
            SceneError: the room is dark.
        """
        return exposure_of(self._probes.read()) if self._given is None else self._given

    def render(self, frame: FrameOf, report: Callable[[], None]) -> None:
        """Render the missing frames.

        Args:
            frame: renders one.
            report: called after each.

        Raises:
            SceneError: the room is dark, or the disk is full.
        """

        def linear(state: int) -> np.ndarray:
            x, z = (float(value) for value in self._room.location[state])
            self.rendered += 1
            return frame(x, z, float(self._room.rotation[state]), state)

        for state in self._probed[len(self._probes) :]:
            self._probes.append(linear(state)[None])
            report()
        exposure = self.exposure
        probes = dict(zip(self._probed, self._probes.read(), strict=True))
        for state in range(len(self._frames), self._room.num_states):
            picture = probes[state] if state in probes else linear(state)
            self._frames.append(tone_map(picture, exposure)[None])
            if state not in probes:
                report()

    def read(self, first: int, last: int) -> np.ndarray:
        """Pictures (last - first, H, W, 3) uint8."""
        return self._frames.read(first, last)

    def remove(self) -> None:
        """Delete the logs."""
        self._probes.remove()
        self._frames.remove()
