"""Scenes with several pictures per state: other renderings of a room, and randomly changed pictures.

An agent that has seen one picture per state knows that picture. Of the crops that a state has in the new
scene, training draws one at each step (``env.crop=random``).
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from PIL import Image

from vusfa.errors import ConfigError, SceneError
from vusfa.files import file_sha256
from vusfa.scenes import store
from vusfa.scenes.pictures import decode, read_pictures, to_jpeg
from vusfa.scenes.scene import Scene
from vusfa.scenes.validation import check_same_graph
from vusfa.sources.backbones import DEFAULT, Backbone, load_backbone
from vusfa.sources.blur import motion_blur
from vusfa.sources.encode import Progress, encode_in_steps

__all__ = ["Augmentation", "augment_picture", "augment_scene"]

#: Changed pictures per state: as many crops more are in the file, and in memory.
MAX_PICTURES = 1000
#: JPEG files have qualities of 1 to 95.
_BEST_QUALITY = 95
_RANGES = {"jpeg": (1, _BEST_QUALITY), "turn": (0, 180), "noise": (0, 255)}


@dataclass(frozen=True)
class Augmentation:
    """Largest random changes of a picture; each is drawn uniformly, for every picture anew.

    Args:
        zoom: of the picture's scale, up or down; beyond its edges it is mirrored.
        shift: of its place, horizontally and vertically, as a share of its width and height.
        turn: about its middle, degrees.
        brightness: of the natural logarithm of all values' factor.
        contrast: the same, about the mean value.
        warmth: of the factors of red (1 + w) and blue (1 - w).
        noise: standard deviation of the pixels' normal noise, of values 0..255.
        blur: length of a horizontal motion blur, as a share of the width.
        jpeg: lowest quality of a JPEG file that the picture passes through.
        erase: side of a grey rectangle over some part, as a share of width and height.

    Raises:
        ConfigError: a value out of its range.
    """

    zoom: float = 0.12
    shift: float = 0.08
    turn: float = 3.0
    brightness: float = 0.4
    contrast: float = 0.2
    warmth: float = 0.25
    noise: float = 8.0
    blur: float = 0.05
    jpeg: int = 40
    erase: float = 0.3

    def __post_init__(self) -> None:
        for field in fields(self):
            value, (low, high) = getattr(self, field.name), _RANGES.get(field.name, (0, 0.9))
            if not low <= value <= high:
                raise ConfigError(f"{field.name} is {value}; give a number between {low} and {high}")

    def scaled(self, strength: float) -> Augmentation:
        """The same changes, all of them larger or smaller by a factor.

        >>> half = Augmentation().scaled(0.5)
        >>> half.zoom, half.jpeg
        (0.06, 68)
        """
        if not 0 <= strength < math.inf:
            raise ConfigError(f"strength is {strength}; give a number of 0 or more")
        values = {field.name: strength * getattr(self, field.name) for field in fields(self)}
        values["jpeg"] = round(_BEST_QUALITY - strength * (_BEST_QUALITY - self.jpeg))
        try:
            return Augmentation(**values)
        except ConfigError as error:
            raise ConfigError(f"strength is {strength}, too much: {error}") from error


def augment_picture(
    picture: np.ndarray, augmentation: Augmentation, generator: np.random.Generator
) -> np.ndarray:
    """A picture (H, W, 3) uint8, changed at random.

    >>> picture = np.full((30, 40, 3), 128, np.uint8)
    >>> changed = augment_picture(picture, Augmentation(), np.random.default_rng(0))
    >>> changed.shape, changed.dtype, bool((changed != picture).any())
    ((30, 40, 3), dtype('uint8'), True)
    """
    limits, draw = augmentation, generator.uniform
    moved = _moved(
        picture,
        np.exp(draw(-limits.zoom, limits.zoom)),
        np.radians(draw(-limits.turn, limits.turn)),
        draw(-limits.shift, limits.shift, 2),
    ).astype(np.float32)
    warmth = draw(-limits.warmth, limits.warmth)
    moved *= np.exp(draw(-limits.brightness, limits.brightness)) * np.array([1 + warmth, 1, 1 - warmth])
    mean = moved.mean()
    moved = mean + (moved - mean) * np.exp(draw(-limits.contrast, limits.contrast))
    length = round(draw(0, limits.blur) * picture.shape[1])
    if length > 1:
        moved = motion_blur(moved, length, length // 2).astype(np.float32)
    _erase(moved, draw(0, limits.erase, 2), draw(0, 1, 2))
    moved += generator.normal(0, draw(0, limits.noise), moved.shape)
    quality = round(draw(limits.jpeg, _BEST_QUALITY))
    return decode(to_jpeg(moved.clip(0, 255).round().astype(np.uint8), quality))


def _moved(picture: np.ndarray, scale: float, angle: float, shift: np.ndarray) -> np.ndarray:
    """A picture scaled and turned about its middle and shifted; beyond its edges it is mirrored."""
    height, width = picture.shape[:2]
    top, left = height // 3, width // 3
    wide = Image.fromarray(np.pad(picture, ((top, top), (left, left), (0, 0)), "reflect"))
    cos, sin = np.cos(angle) / scale, np.sin(angle) / scale
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    x, y = middle + shift * (width, height) + (left, top) - np.array([[cos, sin], [-sin, cos]]) @ middle
    found = wide.transform(
        (width, height), Image.Transform.AFFINE, (cos, sin, x, -sin, cos, y), Image.Resampling.BILINEAR
    )
    return np.asarray(found)


def _erase(values: np.ndarray, size: np.ndarray, place: np.ndarray) -> None:
    """Fill a rectangle with its mean colour, in place."""
    full = np.array(values.shape[:2])
    height, width = (size * full).astype(int)
    top, left = (place * (full - (height, width))).astype(int)
    part = values[top : top + height, left : left + width]
    if part.size:
        part[...] = part.mean((0, 1))


def augment_scene(
    sources: Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    backbone: str | Backbone = DEFAULT,
    *,
    pictures: int = 8,
    augmentation: Augmentation | None = None,
    seed: int = 0,
    batch: int = 32,
    progress: Progress | None = None,
) -> Scene:
    """Write a scene with several crops per state: the features of the sources as they are, the first one's
    first, then those of pictures that are changed at random. Everything else is the first source's.

    Stopped, it goes on where it was when it is called again.

    Args:
        sources: scene files of one graph, such as renderings of a room with different noise; with pictures.
        target: file to write; may be the first source.
        backbone: the network that made the sources' features.
        pictures: pictures per state that are changed, of the sources in turn.
        augmentation: how far; :class:`Augmentation` by default.
        seed: of the changes.
        batch: pictures at a time.
        progress: called with pictures done and their number.

    Raises:
        SceneError: a source has faults, no pictures, several crops, other features, or another graph; the
            target cannot be written.
        ConfigError: there is no such network, it makes several crops, or ``pictures`` or ``seed`` is out of
            range.
    """
    if not 1 <= pictures <= MAX_PICTURES:
        raise ConfigError(f"pictures is {pictures}; give 1 to {MAX_PICTURES:,}")
    if seed < 0:
        raise ConfigError(f"seed is {seed}; give 0 or more")
    augmentation = augmentation or Augmentation()
    network = load_backbone(backbone) if isinstance(backbone, str) else backbone
    if network.preprocessing.num_crops != 1:
        raise ConfigError(f"{network.name} makes {network.preprocessing.num_crops} crops; give crops=whole")
    paths, target = [Path(source) for source in sources], Path(target)
    scenes = [Scene.load(path) for path in paths]
    _check_sources(scenes, network)
    number = scenes[0].num_states

    def read(first: int, last: int) -> np.ndarray:
        rows, states = range(first, last), np.arange(first // pictures, (last - 1) // pictures + 1)
        found = {
            source: read_pictures(paths[source], states)
            for source in {row % pictures % len(paths) for row in rows}
        }
        return np.stack(
            [
                augment_picture(
                    found[row % pictures % len(paths)][row // pictures - states[0]],
                    augmentation,
                    np.random.default_rng([seed, row // pictures, row % pictures]),
                )
                for row in rows
            ]
        )

    work = {
        "pictures": pictures,
        "seed": seed,
        **{f.name: getattr(augmentation, f.name) for f in fields(augmentation)},
    }
    features, attributes, log = encode_in_steps(
        read,
        number * pictures,
        network,
        target.with_name(f".{target.name}.augment"),
        {"sources": [file_sha256(path) for path in paths], **work},
        batch=batch,
        progress=progress,
    )
    changed = features.reshape(number, pictures, -1).astype(np.float16)
    first = store.read(paths[0])
    store.write(
        target,
        {
            **first.arrays,
            "resnet_feature": np.concatenate([*(s.features.numpy() for s in scenes), changed], 1),
        },
        name=scenes[0].name,
        actions=scenes[0].actions,
        attributes={**first.attributes, **attributes, "augmented": f"{len(scenes)} renderings, {work}"},
        source=paths[0],
        stale=["resnet_feature"],
    )
    log.remove()
    return Scene.load(target)


def _check_sources(scenes: Sequence[Scene], network: Backbone) -> None:
    first = scenes[0]
    for scene in scenes:
        check_same_graph(first, scene)
        if not scene.has_pictures:
            raise SceneError(
                f"{scene.path}: has no pictures to change; give a file with dataset 'observation'"
            )
        if scene.num_crops != 1:
            raise SceneError(
                f"{scene.path}: has {scene.num_crops} crops already; give the file it was made from"
            )
        weights = scene.attributes.get("feature_weights_sha256", network.weights_sha256)
        if scene.feature_size != first.feature_size or weights != network.weights_sha256:
            raise SceneError(
                f"{scene.path}: its {scene.feature_size} features are of another network than"
                f" {network.name}; name theirs, or encode it again with vusfa scenes encode"
            )
