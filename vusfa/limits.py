"""Limits of what a file may declare or hold, in one table.

Readers check them before anything of that size is allocated or computed, so that none takes more than 1 GB
beyond the size of its input. They are far above every file that is known.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from itertools import islice
from typing import Any

__all__ = ["brief", "listing", "one_line"]

# ---- scenes (HDF5)

#: States of a scene. The largest known scene has 12,100.
MAX_STATES = 100_000
#: States up to which a scene's file has a table of all shortest paths; in a larger scene they are searched
#: goal by goal when wanted. On request a table of at most so many states is made.
TABLE_STATES, MAX_DISTANCE_STATES = 4096, 16_384
#: Size of the shortest paths that a scene without a table keeps.
MAX_PATH_BYTES = 1 << 26
#: Scene files from which on a set is opened lazily; size of the features or pictures that are then kept.
LAZY_SCENES, RESIDENT_BYTES = 100, 1 << 28
#: Size of a dataset over its size in the file. Tables of distances have about 10.
MAX_COMPRESSION = 200
#: The same for raw pictures, which are read some at a time: what gzip reaches with a single color.
MAX_PICTURE_COMPRESSION = 1100
#: Size of features as float32 beyond what is stored of them.
MAX_EXTRA_BYTES = 3 << 28
#: Size of an attribute, were all of its texts as long as the file's longest.
MAX_ATTRIBUTE_BYTES = 1 << 28
#: Characters of a scene's name.
MAX_NAME = 200
#: Size of a chunk, which is read as a whole.
MAX_CHUNK_BYTES = 1 << 28
#: Texts and JPEG files of a scene.
MAX_HEAP_OBJECTS = 1 << 17
#: Datasets of at most this size need not keep to a compression.
UNCOMPRESSED_BYTES = 1 << 26

# ---- pictures

#: Formats that pictures are decoded from; Pillow would try some forty, and start other programs for some.
PICTURE_FORMATS = ("JPEG", "PNG")
#: Pixels of a picture's side in a scene; pixels of a photograph that a scene is made from, as it is decoded.
MAX_PICTURE_SIDE, MAX_PHOTO_PIXELS = 4096, 90_000_000
#: Scans of a JPEG file, each of which is decoded over the whole picture. Progressive files have about 10.
MAX_PICTURE_SCANS = 64
#: Pixels of a scene's pictures that are decoded when it is checked, of pictures evenly spaced: about 5 s.
#: ``vusfa scenes check --all`` decodes all.
MAX_DECODED_PIXELS = 1 << 28
#: Size of the decoded pictures that are looked at together.
MAX_PICTURE_BYTES = 1 << 26

# ---- text

#: Size of a YAML file: goals, archives, plans, presets.
MAX_TEXT_BYTES = 1 << 20
#: Levels of nesting, entries of all levels, and characters of one entry in YAML.
MAX_YAML_DEPTH, MAX_YAML_NODES, MAX_YAML_SCALAR = 20, 100_000, 10_000
#: Size of a JSON file; Python's objects take up to 30 times that.
MAX_JSON_BYTES = 1 << 24
#: Size of a CSV file, read at some 3 MB per second; different words in it.
MAX_CSV_BYTES, MAX_CSV_WORDS = 1 << 25, 100_000
#: Size of a training's own log when it is resumed, which is read row by row.
MAX_LOG_BYTES = 1 << 28
#: Size of a CSV file of poses or moves, which become Python's objects.
MAX_TABLE_BYTES = 1 << 24
#: Size of one file of a library of furniture.
MAX_MODEL_BYTES = 1 << 28
#: Pieces of furniture, and entries of any other kind, of a plan.
MAX_FURNITURE = 1000

# ---- arrays (NPZ)

#: Size and number of elements of all arrays of a file together; readers widen elements to 8 bytes.
MAX_NPZ_BYTES, MAX_NPZ_ELEMENTS = 1 << 28, 1 << 26
#: Size of the names and attributes of all rooms in an index, JSON.
MAX_INDEX_TEXT_BYTES = 1 << 25

# ---- archives (zip)

#: Size of an archive that is fetched, and of a scene in it per state (THOR's dumps have half a megabyte).
MAX_ARCHIVE_BYTES, MAX_STATE_BYTES = 1 << 35, 1 << 23
#: Space on the disk that fetching leaves free.
FREE_BYTES = 1 << 28
#: Size of one read of a zip file: of its list of contents, which is read at once.
MAX_ZIP_READ = 1 << 22

# ---- checkpoints

#: Values and levels of nesting of a checkpoint's content.
MAX_CHECKPOINT_VALUES, MAX_CHECKPOINT_DEPTH = 200_000, 32
#: Size of a layer that a file may ask for beyond the sizes of its own weights.
MAX_LAYER = 4096

# ---- agents, environments, evaluations

#: Units of a layer, and frames of an agent's history.
MAX_UNITS = 1 << 16
#: Side of the pictures that convolutions see, pixels.
MAX_CONV_SIDE = 1024
#: Environments that step together, times the frames of their history.
MAX_ENV_FRAMES = 1 << 26
#: Actions of an episode whose chances a report computes, action by action.
MAX_EPISODE_STEPS = 100_000
#: Frames of a collector's batch, and episodes of an evaluation.
MAX_BATCH_FRAMES, MAX_EPISODES = 1 << 28, 1 << 26

# ---- cameras

#: Size of one picture of a stream.
MAX_STREAM_PICTURE_BYTES = 1 << 25

# ---- command line

#: Least and largest values of options, by their name in all commands.
RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, (1 << 63) - 1),
    "seeds": (0, (1 << 32) - 1),
    "max_steps": (1, MAX_EPISODE_STEPS),
    "walk_steps": (0, MAX_EPISODE_STEPS),
    "episodes": (1, 1_000_000),
    **dict.fromkeys(("attempts", "pictures", "sets", "tested", "trained"), (1, 10_000)),
    "walks": (0, 10_000),
    **dict.fromkeys(("goals_per_scene", "cells"), (0, MAX_STATES)),
    **dict.fromkeys(("width", "height", "size", "resize", "samples"), (1, MAX_PICTURE_SIDE)),
    "batch": (1, 1 << 16),
    "resamples": (1, 100_000),
    "megabytes": (0, 4096),
    "threads": (1, 1024),
}

# ---- messages

#: Faults that one message lists.
MAX_FAULTS = 100

_BRIEF = reprlib.Repr()
_BRIEF.maxlevel, _BRIEF.maxlist, _BRIEF.maxdict, _BRIEF.maxstring, _BRIEF.maxother = 2, 10, 10, 200, 200


def brief(value: Any) -> str:
    """A value of a file as messages show it: a bounded part, however much a file says.

    >>> brief(list(range(1000)))
    '[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...]'
    """
    return _BRIEF.repr(value)


def listing(names: Iterable[str], most: int = 20) -> str:
    """Names, as messages list them: the first so many.

    >>> listing(["bathroom", "kitchen"]), listing(map(str, range(10_000)), most=3)
    ('bathroom, kitchen', '0, 1, 2, ...')
    """
    first = list(islice(names, most + 1))
    return ", ".join([*first[:most], *(["..."] if len(first) > most else [])])


def one_line(fault: object) -> str:
    """What another library says of a fault, as messages quote it: on one line, and bounded.

    >>> one_line("while parsing a list\\n  in line 3"), len(one_line("x" * 10_000))
    ('while parsing a list in line 3', 300)
    """
    text = " ".join(str(fault).split())
    return text if len(text) <= 300 else f"{text[:297]}..."
