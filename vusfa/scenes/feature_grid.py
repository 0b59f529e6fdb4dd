"""Features that keep where things are in the picture: averages over the parts of a grid."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from vusfa.errors import ConfigError
from vusfa.limits import brief

if TYPE_CHECKING:
    from vusfa.scenes.scene_set import SceneSet

__all__ = ["feature_grid", "parse_grid"]


def parse_grid(text: str) -> tuple[int, int]:
    """Rows and columns of a grid, 1 to 99 each.

    >>> parse_grid("3x4")
    (3, 4)
    """
    if not (found := re.fullmatch(r"([1-9]\d?)x([1-9]\d?)", text)):
        raise ConfigError(f"grid is {brief(text)}; give rows and columns, such as 3x4")
    return int(found[1]), int(found[2])


def feature_grid(scenes: SceneSet) -> tuple[int, int]:
    """Rows and columns of the parts that the features are of, by the scenes' attribute ``feature_grid``;
    1 and 1 for features of whole pictures.

    Raises:
        ConfigError: it is not the same in all scenes, or does not divide the features.

    >>> from vusfa.scenes import SceneSet
    >>> feature_grid(SceneSet.bundled(["bathroom"]))
    (1, 1)
    """
    grids = sorted({str(scene.attributes.get("feature_grid", "1x1")) for scene in scenes.scenes})
    mend = "give rooms with one feature_grid, as vusfa scenes encode grid=3x4 writes it"
    said = f"the rooms have {scenes.feature_size} features on grids of {brief(grids)}"
    try:
        rows, columns = parse_grid(grids[0])
    except ConfigError as error:
        raise ConfigError(f"{said}; {mend}") from error
    if len(grids) > 1 or scenes.feature_size % (rows * columns):
        raise ConfigError(f"{said}; {mend}")
    return rows, columns
