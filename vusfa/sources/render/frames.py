"""Frames of a room, saved one by one, so that rendering can be stopped and resumed at any time.

The exposure is measured from a few frames of the unvaried room, which are rendered first and kept: a resumed
run gives the same pictures.
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
from vusfa.sources.render.variation import PLAIN, Variation, vary_picture, vary_poses
from vusfa.sources.row_log import RowLog

__all__ = ["Frames"]

_PROBES = 24

#: ``frame(x, z, heading, seed)`` gives a linear picture (H, W, 3).
FrameOf = Callable[[float, float, float, int], np.ndarray]


class Frames:
    """All frames of a room, in two hidden logs beside the scene file.

    Args:
        plan: the room.
        room: its poses.
        path: the scene file.
        work: what else the frames depend on, such as versions; logs of other work are discarded.
        variation: the change of the pictures; the exposure is that of the room without it.
    """

    def __init__(
        self,
        plan: Plan,
        room: Poses,
        path: Path,
        work: Mapping[str, Any],
        variation: Variation = PLAIN,
    ) -> None:
        self._room = room
        self._variation = variation
        width, height = plan.camera.resolution
        shape = (height, width, 3)
        order = random_stream(plan.surfaces.seed).permutation(room.num_states)
        self._probed = [int(state) for state in order[:_PROBES]] if plan.camera.exposure is None else []
        # Frames for the exposure that are also frames of the scene.
        self._shared = set() if variation.changes() else set(self._probed)
        self._given = plan.camera.exposure
        described = {"plan": to_yaml(plan), **work, **variation.changes()}
        probes, frames = (path.with_name(f".{path.name}.{kind}") for kind in ("probes", "frames"))
        self._probes = RowLog(probes, described, np.dtype((np.float32, shape)))
        self._frames = RowLog(frames, described, np.dtype((np.uint8, shape)))
        #: frames rendered by this object
        self.rendered = 0

    @property
    def done(self) -> int:
        """Frames that need no more rendering."""
        probed = self._probed[: len(self._probes)]
        return len(self._frames) + sum(
            state not in self._shared or state >= len(self._frames) for state in probed
        )

    @property
    def total(self) -> int:
        """Frames to render in all: one per state, and those that only measure the exposure."""
        return self._room.num_states + len(self._probed) - len(self._shared)

    @property
    def measured(self) -> bool:
        """Whether the exposure is known."""
        return len(self._probes) == len(self._probed)

    @property
    def complete(self) -> bool:
        """Whether all frames are rendered."""
        return self.measured and len(self._frames) == self._room.num_states

    @property
    def exposure(self) -> float:
        """The plan's exposure, or the measured one; requires :attr:`measured`.

        Raises:
            SceneError: the room is dark.
        """
        return exposure_of(self._probes.read()) if self._given is None else self._given

    def measure(self, frame: FrameOf, report: Callable[[], None]) -> None:
        """Render the missing frames that measure the exposure.

        Args:
            frame: renders a frame of the room without the variation.
            report: called after each.

        Raises:
            SceneError: the disk is full.
        """
        for state in self._probed[len(self._probes) :]:
            x, z = (float(value) for value in self._room.location[state])
            self._probes.append(frame(x, z, float(self._room.rotation[state]), state)[None])
            self.rendered += 1
            report()

    def render(self, frame: FrameOf, report: Callable[[], None]) -> None:
        """Render the other missing frames, after :meth:`measure`.

        Args:
            frame: renders a frame of the varied room.
            report: called after each.

        Raises:
            SceneError: the room is dark, or the disk is full.
        """
        exposure = self.exposure
        probes = dict(zip(self._probed, self._probes.read(), strict=True)) if self._shared else {}
        places, headings = vary_poses(self._room, self._variation)
        for state in range(len(self._frames), self._room.num_states):
            if state in probes:
                picture = probes[state]
            else:
                x, z = (float(value) for value in places[state])
                picture = frame(x, z, float(headings[state]), self._variation.seed(state))
                self.rendered += 1
            self._frames.append(vary_picture(tone_map(picture, exposure), self._variation)[None])
            if state not in probes:
                report()

    def read(self, first: int, last: int) -> np.ndarray:
        """Pictures (last - first, H, W, 3) uint8."""
        return self._frames.read(first, last)

    def remove(self) -> None:
        """Delete the logs."""
        self._probes.remove()
        self._frames.remove()
