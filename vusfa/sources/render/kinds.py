"""Kinds of rooms: their size, outline and furniture.

Models have short names: a letter for the collection and a number (``S5`` is ``Scopia#5``). From a list of
several, one is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

from vusfa.errors import SceneError

__all__ = [
    "CEILING",
    "DOORS",
    "KINDS",
    "LAMPS",
    "WINDOWS",
    "Programme",
    "TableSet",
    "model_name",
    "models_of_all_kinds",
    "programme",
]

_COLLECTIONS = {"C": "BlendSwap-CC-0", "B": "BlendSwap-CC-BY", "K": "KatorLegaz", "S": "Scopia"}

#: Height of the ceilings, metres.
CEILING = 2.6

_Pool = tuple[str, ...]


def model_name(short: str) -> str:
    """Expand a short name to the catalogue's.

    >>> model_name("S5")
    'Scopia#5'
    """
    return f"{_COLLECTIONS[short[0]]}#{short[1:]}"


def _pool(shorts: str) -> _Pool:
    return tuple(model_name(short) for short in shorts.split())


@dataclass(frozen=True)
class TableSet:
    """Tables with chairs around them: ``chairs`` are tried at as many sides of each of ``count`` tables."""

    tables: _Pool
    seats: _Pool
    chairs: int
    count: int


@dataclass(frozen=True)
class Programme:
    """A kind of room.

    Args:
        cells: free places that it is drawn for.
        grid: places along X and Z before furniture.
        notch: places that a cut-off corner takes; (0, 0) for none.
        partition: length in metres of a wall that reaches into the room; 0 for none.
        floor: pattern.
        wall: what stands along the walls, and how many of each pool.
        middle: what stands free.
        sets: tables with chairs.
        rugs: lie anywhere.
        hung: what hangs on walls.
        tops: what stands on low furniture.
    """

    cells: int
    grid: tuple[int, int]
    notch: tuple[int, int]
    partition: float
    floor: str
    wall: tuple[tuple[_Pool, int], ...]
    middle: tuple[tuple[_Pool, int], ...]
    sets: tuple[TableSet, ...]
    rugs: _Pool
    hung: _Pool
    tops: _Pool


def _pools(*pools: tuple[str, int]) -> tuple[tuple[_Pool, int], ...]:
    return tuple((_pool(shorts), count) for shorts, count in pools)


DOORS = _pool("S52 K8 K9 K10 K11 K12")
WINDOWS = _pool("K5 K6 K7")
LAMPS = _pool("B29 K40")

KINDS: dict[str, Programme] = {
    "bathroom": Programme(
        cells=45,
        grid=(10, 9),
        notch=(4, 3),
        partition=0.0,
        floor="tile",
        wall=_pools(
            ("B3 C131", 2),
            ("C57 B60 B132", 1),
            ("C104", 1),
            ("C62 B64 C122", 2),
            ("S73 S80", 1),
            ("B65 S131 S132", 1),
            ("S194", 1),
            ("C61 K55", 1),
        ),
        middle=_pools(("S374 S337", 1), ("S36 C113 K26", 1)),
        sets=(),
        rugs=_pool("K77 K77"),
        hung=_pool("B4 B117 C59 S51 K3 C136 S134 C137 C58"),
        tops=_pool("S103 C124 S337 B102 C77"),
    ),
    "bedroom": Programme(
        cells=100,
        grid=(15, 13),
        notch=(5, 4),
        partition=0.0,
        floor="wood",
        wall=_pools(
            ("C2 C3 C5 C88 S3 B77", 1),
            ("S4 B10 S77 S344 B31 S367", 1),
            ("C4 B5", 2),
            ("S5 C68 B135", 1),
            ("B63 C74 S83", 2),
            ("B75 B130 S193", 2),
            ("S290 C75", 1),
            ("S335 K80 C6", 1),
            ("C61 S79", 1),
        ),
        middle=_pools(("C86 S24 B95 K47", 1), ("S288", 1), ("S196 C8 B103 K68", 1), ("C113 C126 B81", 1)),
        sets=(TableSet(_pool("S360 B14"), _pool("S359 B18"), 2, 1),),
        rugs=_pool("K85"),
        hung=_pool("C96 C34 B114 S141 C137 B56 S154 K81"),
        tops=_pool("B98 S56 S57 C15 C124 B125 B20 S55"),
    ),
    "kitchen": Programme(
        cells=170,
        grid=(18, 16),
        notch=(4, 5),
        partition=0.0,
        floor="check",
        wall=_pools(
            ("C128 C151 K29", 1),
            ("C146 C16", 2),
            ("B44", 1),
            ("B37 C165", 2),
            ("B36 C144 C153 B33 B38", 4),
            ("B65 S131", 1),
            ("S175 K26", 1),
        ),
        middle=_pools(("B34", 1), ("C148", 1), ("S126 C113 B81", 1)),
        sets=(
            TableSet(_pool("B58 S39 C134 K52"), _pool("C79 S30 B24 K51 C26"), 3, 1),
            TableSet(_pool("C27 S338"), _pool("B123 C101 B127"), 2, 1),
        ),
        rugs=_pool("S343"),
        hung=_pool("C145 C172 B41 B70 C174 C166 B39 C96 S137 C34 C137"),
        tops=_pool("S355 S70 C19 S395 S123 B32 S102 B48 C124 S356 B73 S380"),
    ),
    "living_room": Programme(
        cells=117,
        grid=(15, 14),
        notch=(0, 0),
        partition=3.4,
        floor="wood",
        wall=_pools(
            ("K57 C95 C140 B129 S32", 1),
            ("S37 B80 C132", 1),
            ("C6 K80 B121 S27", 2),
            ("C52", 1),
            ("B50", 1),
            ("B130 S28 C39", 2),
            ("C61 B82", 1),
            ("B85 C126 B78", 2),
            ("C75", 1),
        ),
        middle=_pools(
            ("C30 C33", 1), ("B22 S33 S34", 1), ("C86 C99 C139 B87 K47 S24", 2), ("C113 B81 S36", 1)
        ),
        sets=(TableSet(_pool("C27 S338 C48 B12"), _pool("C31 C93 C108 C114 C171 S30"), 3, 1),),
        rugs=_pool("K85"),
        hung=_pool("C96 C34 S155 C137 S141 S154 B114"),
        tops=_pool("C22 C124 B109 B98 S57 S41 B125 B92"),
    ),
    "hall": Programme(
        cells=54,
        grid=(13, 7),
        notch=(4, 2),
        partition=0.0,
        floor="check",
        wall=_pools(
            ("C6 K80 S335", 1),
            ("B130 S28 B75", 2),
            ("B63 C74 S83", 1),
            ("B121 S27 C39", 1),
            ("C61 K55 S79", 1),
            ("B85 C126 B78", 1),
            ("C86 S24 K47", 1),
            ("S194 K26 S36", 1),
        ),
        middle=_pools(
            ("C113 B81 S36", 1),
        ),
        sets=(),
        rugs=_pool("K85 S343"),
        hung=_pool("C96 C34 S155 C137 S141 S154 B114 B56 K81"),
        tops=_pool("C22 C124 B109 B98 S57 B125 B92 S56"),
    ),
}


def programme(kind: str) -> Programme:
    """The programme of a kind of room.

    Raises:
        SceneError: there is no such kind.

    >>> programme("attic")
    Traceback (most recent call last):
    ...
    vusfa.errors.SceneError: no kind of room is called 'attic'; there are bathroom, bedroom, kitchen, ...
    """
    if kind not in KINDS:
        raise SceneError(f"no kind of room is called {kind!r}; there are {', '.join(KINDS)}")
    return KINDS[kind]


def models_of_all_kinds() -> list[str]:
    """Every model that a layout may draw, sorted."""
    names = {*DOORS, *WINDOWS, *LAMPS}
    for kind in KINDS.values():
        for pool, _ in (*kind.wall, *kind.middle):
            names.update(pool)
        for table_set in kind.sets:
            names.update(table_set.tables, table_set.seats)
        names.update(kind.rugs, kind.hung, kind.tops)
    return sorted(names)
