"""Old names of modules and objects: they work for one release and warn with the new name.

One table for modules, one for objects of modules that still exist; what is gone for good says what to use
instead. They are data: to move something, move it and add a line here.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

__all__ = ["MOVED_MODULES", "REMOVED_MODULES", "REMOVED_NAMES", "install", "moved_names"]

#: Modules of version 0.1 and what they are called now.
MOVED_MODULES: dict[str, str] = {
    "vusfa.evaluation.curve": "vusfa.report.curve",
    "vusfa.evaluation.experiment": "vusfa.report.experiment",
    "vusfa.evaluation.files": "vusfa.files",
    "vusfa.evaluation.film": "vusfa.report.film",
    "vusfa.evaluation.floors": "vusfa.evaluation.baselines",
    "vusfa.evaluation.report": "vusfa.evaluation.summary",
    "vusfa.evaluation.results": "vusfa.experiments.runs",
    "vusfa.evaluation.tables": "vusfa.report.result_tables",
    "vusfa.evaluation.transfer_figure": "vusfa.report.transfer_figure",
    "vusfa.evaluation.unseen": "vusfa.report.unseen",
    "vusfa.evaluation.tabulated": "vusfa.modules.inference",
    "vusfa.modules.acting": "vusfa.modules.inference",
    "vusfa.modules.pairs": "vusfa.modules.inference",
    "vusfa.modules.presets": "vusfa.modules.config",
    "vusfa.objectives.single_pass": "vusfa.objectives.networks",
    "vusfa.scenes.faults": "vusfa.scenes.validation",
    "vusfa.training.cells": "vusfa.experiments.measure",
    "vusfa.training.checks": "vusfa.conf.schema",
    "vusfa.training.launch": "vusfa.cli.launch",
    "vusfa.training.learning": "vusfa.training.optimization",
    "vusfa.training.replay": "vusfa.algorithms.replay",
    "vusfa.training.session": "vusfa.training.trainer",
    "vusfa.training.transfer": "vusfa.experiments.fine_tune",
    **{
        f"vusfa.evaluation.{name}": f"vusfa.experiments.{name}"
        for name in ("transfer", "manifest")
    },
    **{
        f"vusfa.scenes.{name}": f"vusfa.sources.{name}"
        for name in (
            "backbones", "crops", "download", "encode", "fetch", "grid", "photo_tables", "photos", "row_log",
            "thor", "sheet", "compare", "summary", "render",
        )
    },
}  # fmt: skip
#: What version 0.1 had and nothing equals now, and what to use instead.
REMOVED_MODULES: dict[str, str] = {
    "vusfa.modules.freezing": "vusfa.modules.InferencePolicy.cached keeps answers while weights stand still",
    "vusfa.modules.normalised": "vusfa.modules.FeatureFrames normalizes features",
    "vusfa.objectives.distinct": "vusfa.modules.unique computes equal rows once",
}
REMOVED_NAMES: dict[str, str] = {
    "ActionTable": "vusfa.modules.TabularPolicy tabulates a policy's actions",
    "GaussianEncoder": "vusfa.modules.SiameseEncoder takes a vusfa.modules.GaussianBottleneck",
    "NormalisedEncoder": REMOVED_MODULES["vusfa.modules.normalised"],
    "StateGoalPairs": "vusfa.modules.TabularPolicy computes pairs of state and goal once",
    "action_logits": "agent.get_policy_operator().get_dist(tensordict).logits gives them",
    "frozen": REMOVED_MODULES["vusfa.modules.freezing"],
    "n_step_return": "vusfa.objectives.lambda_return bootstraps at a rollout's end, or earlier with lmbda",
    "sees_one_frame": "vusfa.modules.Agent.is_tabular says it",
}


class _Moved(MetaPathFinder, Loader):
    """Finds a module under its old name, and warns."""

    def __init__(self) -> None:
        self._specs: dict[str, ModuleSpec | None] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname in REMOVED_MODULES:
            raise ModuleNotFoundError(_gone(fullname, REMOVED_MODULES[fullname]), name=fullname)
        return ModuleSpec(fullname, self) if _new_name(fullname) else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        new = _new_name(spec.name)
        assert new is not None
        warnings.warn(
            f"{spec.name} is called {new} since version 0.2; the old name goes with version 0.3",
            DeprecationWarning,
            stacklevel=2,
        )
        module = importlib.import_module(new)
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Put back the module's own specification; it has been run already, under its new name."""
        assert module.__spec__ is not None
        module.__spec__ = self._specs.pop(module.__spec__.name)


def _new_name(old: str) -> str | None:
    for before, now in MOVED_MODULES.items():
        if old == before or old.startswith(before + "."):
            return now + old.removeprefix(before)
    return None


def _gone(name: str, instead: str) -> str:
    return f"{name} is not in version 0.2 any more: {instead}"


def install() -> None:
    """Let old names of modules be imported; :mod:`vusfa` does this once."""
    if not any(isinstance(finder, _Moved) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Moved())  # before a moved package finds its modules under both names


def moved_names(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """A module's ``__getattr__`` that finds objects under their old names, and warns.

    Args:
        module: name of the module that calls, ``__name__``.
        names: old name of an object to the full new name of it, ``"package.module.Name"``.

    >>> getattr_ = moved_names("vusfa.old", {"frobnicate": "math.sqrt"})
    >>> with warnings.catch_warnings(record=True):
    ...     warnings.simplefilter("always")
    ...     getattr_("frobnicate")(9.0)
    3.0
    """

    def find(name: str) -> Any:
        if name in REMOVED_NAMES and name not in names:
            raise ImportError(_gone(f"{module}.{name}", REMOVED_NAMES[name]))  # a from-import tells no other
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        place, _, attribute = names[name].rpartition(".")
        warnings.warn(
            f"{module}.{name} is called {names[name]} since version 0.2; the old name goes with version 0.3",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(importlib.import_module(place), attribute)

    return find
