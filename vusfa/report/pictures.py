"""Small first-person pictures for a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import torch
from PIL import Image

from vusfa.scenes import Scene

__all__ = ["small_jpeg", "thumbnails"]


def small_jpeg(picture: Any, width: int = 200, quality: int = 60) -> bytes:
    """A picture (H, W, 3) uint8 as JPEG, scaled down to at most a width.

    >>> import numpy as np
    >>> small_jpeg(np.zeros((150, 200, 3), np.uint8))[:2] == bytes([0xFF, 0xD8])
    True
    """
    image = Image.fromarray(picture)
    if image.width > width:
        height = round(image.height * width / image.width)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=quality, optimize=True)
    return buffer.getvalue()


def thumbnails(scene: Scene, wanted: Sequence[int], budget: int) -> dict[str, Any]:
    """Small pictures of a scene's states, as many as a budget allows.

    Args:
        scene: the scene, with or without pictures.
        wanted: state ids, the most important first; the other states follow.
        budget: bytes of all JPEG files together.

    Returns:
        plain data: ``ids`` (n) of the states with a picture, ``ends`` (n) of each file in ``data``, the
        concatenated files in base 64.

    >>> found = thumbnails(Scene.bundled("bathroom"), [7, 3], budget=8000)
    >>> found["ids"][:2], len(found["ids"]) < 10
    ([7, 3], True)
    """
    ids, ends, files, total = [], [], [], 0
    if scene.has_pictures:
        order = list(dict.fromkeys([*wanted, *range(scene.num_states)]))
        for block in torch.tensor(order).split(64):
            pictures = scene.pictures(block).numpy() if total < budget else ()
            for state, picture in zip(block.tolist(), pictures, strict=False):
                file = small_jpeg(picture)
                if total + len(file) > budget:
                    total = budget
                    break
                total += len(file)
                ids.append(state)
                ends.append(total)
                files.append(file)
    return {"ids": ids, "ends": ends, "data": base64.b64encode(b"".join(files)).decode("ascii")}
