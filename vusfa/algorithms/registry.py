"""Algorithms and additional loss terms by name.

Importing modules fills both tables: nothing is imported because a setting or a checkpoint names it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from torchrl.objectives import LossModule

from vusfa.algorithms.base import Algorithm
from vusfa.conf import settings
from vusfa.errors import ConfigError, near
from vusfa.modules import Agent
from vusfa.scenes import SceneSet

__all__ = [
    "ALGORITHMS",
    "LOSS_TERMS",
    "make_algorithm",
    "make_loss_terms",
    "register_algorithm",
    "register_loss_term",
]

AlgorithmClass = TypeVar("AlgorithmClass", bound=type[Algorithm])

ALGORITHMS: dict[str, type[Algorithm]] = {}
LOSS_TERMS: dict[str, Callable[[Agent, float], LossModule]] = {}


def register_algorithm(name: str) -> Callable[[AlgorithmClass], AlgorithmClass]:
    """Class decorator: ``algorithm=NAME`` trains with the class. A name registered again is replaced."""

    def register(algorithm: AlgorithmClass) -> AlgorithmClass:
        ALGORITHMS[name] = algorithm
        settings.ALGORITHMS[name] = algorithm.Settings(name)
        return algorithm

    return register


def make_algorithm(name: str, agent: Agent, scenes: SceneSet, all_settings: Mapping[str, Any]) -> Algorithm:
    """An algorithm by name; the other arguments are those of :class:`~vusfa.algorithms.Algorithm`.

    Raises:
        ConfigError: an unknown name, or settings that the algorithm does not fit.

    >>> make_algorithm("uzf", None, None, {})
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: algorithm 'uzf' is registered by no module imported so far; did you mean 'usf'?
    """
    if name not in ALGORITHMS:
        raise ConfigError(
            f"algorithm {name!r} is registered by no module imported so far; {near(name, ALGORITHMS)}"
        )
    return ALGORITHMS[name](agent, scenes, all_settings)


def register_loss_term(name: str, make: Callable[[Agent, float], LossModule]) -> None:
    """Add a term to those that ``objective.terms`` may give a coefficient.

    Args:
        name: of the term.
        make: a function of the agent and the coefficient; the ``loss_*`` entries of the module that it
            returns hold the coefficient. A :class:`~torchrl.objectives.LossModule` class with these arguments
            will do.
    """
    LOSS_TERMS[name] = make
    settings.LOSS_TERMS[name] = 0.0


def make_loss_terms(agent: Agent, coefficients: Mapping[str, float]) -> list[LossModule]:
    """Registered terms of an agent, those with a coefficient other than 0.

    Raises:
        ConfigError: an unknown name, or an agent that the term does not fit.
    """
    terms = []
    for name, coefficient in coefficients.items():
        if name not in LOSS_TERMS:
            raise ConfigError(
                f"objective.terms.{name} is registered by no module imported so far; {near(name, LOSS_TERMS)}"
            )
        if not coefficient:
            continue
        try:
            terms.append(LOSS_TERMS[name](agent, coefficient))
        except ValueError as error:
            raise ConfigError(f"objective.terms.{name} is {coefficient}: {error}; or give 0") from error
    return terms
