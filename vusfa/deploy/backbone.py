"""The backbone that made the features of a room, found by the attributes of the room's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vusfa.errors import ConfigError
from vusfa.limits import brief
from vusfa.scenes import SceneSet
from vusfa.scenes.feature_grid import parse_grid
from vusfa.sources.backbones import DEFAULT, POOLED_FEATURES, Backbone, load_backbone
from vusfa.sources.crops import CROPS

__all__ = ["find_backbone"]

#: Attributes of a scene that must agree with the backbone's own.
_RECORDED = (
    "feature_backbone",
    "feature_layer",
    "feature_grid",
    "feature_weights_sha256",
    "feature_preprocessing",
)
#: The bundled rooms were written before these attributes existed.
_OLD = "EfficientNet-lite0 extract_features mean over space; 224x224 bicubic resize"


def find_backbone(scenes: SceneSet, backbone: str | Backbone | None = None) -> Backbone:
    """Load the backbone that made the features of these scenes, ready for single pictures.

    Args:
        scenes: scenes whose attributes name the backbone.
        backbone: the network itself, or its name, where the attributes name none or one whose weights are a
            file of the user's.

    Raises:
        ConfigError: the scenes name no backbone, several, one that must be given, or another than is given.

    >>> find_backbone(SceneSet.bundled(["bathroom"])).name
    'efficientnet-lite0'
    """
    recorded = {
        name: _recorded(scene.attributes) for name, scene in zip(scenes.names, scenes.scenes, strict=True)
    }
    first, facts = next(iter(recorded.items()))
    for name, other in recorded.items():
        if other != facts:
            raise ConfigError(
                f"scenes {first!r} and {name!r} have features of different networks; encode them alike"
            )
    known = str(facts.get("feature_backbone", "")) or None
    if backbone is None:
        if known is None:
            raise ConfigError(
                f"scene {first!r} does not say which backbone made its features; pass it as"
                " backbone=load_backbone(...) (backbone=NAME of vusfa run and export), or recompute them with"
                " vusfa scenes encode"
            )
        if known != DEFAULT:
            raise ConfigError(
                f"the features of scene {first!r} are those of {brief(known)}, whose weights are a file of"
                f" yours; pass backbone=load_backbone({brief(known)}, weights=...) (backbone=NAME"
                " weights=FILE of vusfa run and export)"
            )
        crops, layer, grid = (facts.get(f"feature_{key}") for key in ("crops", "layer", "grid"))
        backbone = load_backbone(
            DEFAULT,
            layer=None if layer in (None, POOLED_FEATURES) else str(layer),
            grid=None if grid is None else parse_grid(str(grid)),
            crops=crops if crops in CROPS else None,
        )
    found = load_backbone(backbone) if isinstance(backbone, str) else backbone
    own = found.attributes()
    for key in _RECORDED:
        if key in facts and facts[key] != own.get(key):
            raise ConfigError(
                f"scene {first!r} has features of {key.removeprefix('feature_')} {brief(facts[key])}, not"
                f" {brief(own.get(key))}; pass the backbone that made them"
            )
    if found.preprocessing.crops == "ten":  # agents read the first of the ten, the central one
        found = replace(found, preprocessing=replace(found.preprocessing, crops="centre"))
    return found


def _recorded(attributes: Mapping[str, Any]) -> dict[str, Any]:
    facts = {key: attributes[key] for key in (*_RECORDED, "feature_crops") if key in attributes}
    if not facts and str(attributes.get("feature", "")).startswith(_OLD):
        facts["feature_backbone"] = DEFAULT
    return facts
