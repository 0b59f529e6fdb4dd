"""Scenes from ProcTHOR: procedurally generated houses in AI2-THOR.

    pip install 'vusfa[thor]' prior
    python examples/sources/procthor.py houses/ 0 7 12

The houses come from the package ``prior`` (https://github.com/allenai/prior), which downloads them. A house
that lies on disk as JSON needs no program: ``vusfa scenes export-thor house.json house.h5``. The test of this
file has a small house and a stand-in for the simulator's controller.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vusfa.scenes import Scene
from vusfa.sources.thor import export

SETTINGS = {"gridSize": 0.5, "width": 400, "height": 300, "fieldOfView": 90, "rotateStepDegrees": 90}


def rooms(house: Mapping[str, Any]) -> str:
    """The rooms of a house in words.

    >>> rooms({"rooms": [{"roomType": "Kitchen"}, {"roomType": "Bedroom"}, {"roomType": "Bedroom"}]})
    '2 Bedroom, 1 Kitchen'
    """
    found = Counter(room["roomType"] for room in house["rooms"])
    return ", ".join(f"{number} {name}" for name, number in sorted(found.items()))


def export_house(
    house: Mapping[str, Any], target: Path, controller: Callable[..., Any], **options: Any
) -> Scene:
    """Write the scene of a house; ``options`` are those of ``export``, such as a backbone."""
    simulator = controller(scene=dict(house), snapToGrid=True, **SETTINGS)
    try:
        return export(simulator, target, name=target.stem, attributes={"rooms": rooms(house)}, **options)
    finally:
        simulator.stop()


if __name__ == "__main__":
    import prior
    from ai2thor.controller import Controller

    folder, numbers = Path(sys.argv[1]), [int(word) for word in sys.argv[2:]]
    folder.mkdir(parents=True, exist_ok=True)
    houses = prior.load_dataset("procthor-10k")["train"]
    for number in numbers:
        scene = export_house(houses[number], folder / f"procthor-{number}.h5", Controller)
        print(f"{scene.path}: {scene.num_states} states, {scene.attributes['rooms']}")
