"""Target-driven visual navigation with universal successor features, as TorchRL components.

An agent stands in a room, is shown a picture of the place where it should be, and walks there by what it
sees.

- :mod:`vusfa.scenes`: rooms as graphs of photographed poses; four are bundled. ``SceneSet.bundled()``
- :mod:`vusfa.envs`: the batched environment ``TargetNavEnv``, and the same task in Gymnasium.
- :mod:`vusfa.modules`: the models, ``make_agent("vusfa", scenes=...)``, ``gvf``, ``usfa`` or ``sfdp``.
- :mod:`vusfa.objectives`: ``USFLoss``, ``USFEstimator``, ``HindsightLoss``.
- :mod:`vusfa.training`: the trainer, ``make_trainer(settings)``; :mod:`vusfa.algorithms`: ways to learn.
- :mod:`vusfa.evaluation`: success, SPL and more, sampled and exact.
- :mod:`vusfa.deploy`: a trained agent at a camera, ``Navigator``; ONNX. ``vusfa.load_pretrained("vusfa")``
- :mod:`vusfa.sources`: rooms of one's own: photographs, renderings, simulators, other features.

The command line is ``vusfa --help``.

>>> import vusfa
>>> agent, rooms, goals, card = vusfa.load_pretrained("gvf")
>>> rooms
SceneSet(bathroom: 176, bedroom: 404, kitchen: 680, living_room: 452)
"""

from typing import Any

from vusfa.deprecated import install

__all__ = ["load_pretrained"]
__version__ = "0.2.0"

install()


def __getattr__(name: str) -> Any:
    if name == "load_pretrained":  # imported when it is asked for: it needs torch
        from vusfa.deploy import load_pretrained as found

        return found
    raise AttributeError(f"module 'vusfa' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
