"""The paper's algorithm: advantage actor-critic with successor features and an information bottleneck."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor

from vusfa.algorithms.base import Algorithm
from vusfa.algorithms.registry import make_loss_terms, register_algorithm, register_loss_term
from vusfa.algorithms.schedule import annealed
from vusfa.errors import CheckpointError, ConfigError
from vusfa.modules import Agent
from vusfa.objectives import DualAscent, RewardRegressionLoss, USFEstimator, USFLoss
from vusfa.scenes import SceneSet

__all__ = ["USF", "make_usf_loss"]

# arguments of USFEstimator and of DualAscent among the settings of objective; the others are USFLoss's
_OF_TARGETS = ("gamma", "lmbda", "normalize_advantage", "min_advantage_std", "bootstrap_at_timeout")
_OF_ASCENT = {"bottleneck_step_size": "step_size", "threads": "threads"}
# coefficients that the settings have for every model, whether or not its critic has the term
_OF_SOME_MODELS = ("successor_coeff", "bottleneck_coeff")
# buffers of the loss that training moves; the others are settings
_ADAPTED = ("bottleneck_coeff", "last_kl")


def _reward_regression(agent: Agent, coefficient: float) -> RewardRegressionLoss:
    loss = RewardRegressionLoss(agent.get_value_operator(), coefficient, functional=False)
    loss.check()
    return loss


register_loss_term("reward", _reward_regression)


def make_usf_loss(
    actor: ProbabilisticTensorDictSequential, critic: TensorDictModuleBase, **objective: Any
) -> tuple[USFLoss, DualAscent | None]:
    """The loss of one agent's actor and critic with its estimator, and the multiplier's ascent if there is a
    bottleneck.

    Args:
        objective: settings of the group ``objective``, ``entropy_coeff``, and ``threads`` of
            :class:`~vusfa.objectives.DualAscent`.

    Raises:
        ConfigError: a setting out of its range.
    """
    ascent = {argument: objective.pop(name) for name, argument in _OF_ASCENT.items() if name in objective}
    targets = {name: objective.pop(name) for name in _OF_TARGETS if name in objective}
    optional = {name: objective.pop(name) for name in _OF_SOME_MODELS if name in objective}
    try:
        loss = USFLoss(actor, critic, distinct=True, **objective)
        for name, value in optional.items():
            setattr(loss, name, value)
        loss.check()
        loss.make_value_estimator(USFEstimator(value_network=critic, **targets))
        return loss, DualAscent(loss, **ascent) if loss.has_bottleneck else None
    except ValueError as error:
        raise ConfigError(f"objective: {error}") from error


@register_algorithm("usf")
class USF(Algorithm):
    """:class:`~vusfa.objectives.USFLoss`, :class:`~vusfa.objectives.DualAscent` of the bottleneck's
    multiplier (None without a bottleneck), and the registered terms that ``objective.terms`` gives a
    coefficient."""

    def __init__(self, agent: Agent, scenes: SceneSet, settings: Mapping[str, Any]) -> None:
        super().__init__(agent, scenes, settings)
        if agent.config["pretrained"] and settings["algorithm"]["name"] == "usf":
            raise ConfigError(
                f"agent.pretrained is {agent.config['pretrained']!r}, which algorithm=usf does not pretrain;"
                f" give algorithm={agent.config['pretrained']}"
            )
        objective = dict(settings["objective"])
        coefficients = objective.pop("terms", {})
        self.loss, self.multiplier = make_usf_loss(
            agent.get_policy_operator(out_keys=["action"]),
            agent.get_value_operator(),
            entropy_coeff=settings["entropy"]["start"],
            threads=self.threads or 1,
            **objective,
        )
        self.terms = make_loss_terms(agent, coefficients)
        for module in (self.loss, *self.terms):
            module.to(next(agent.parameters()).device)

    def schedule(self, frames: int) -> None:
        """Anneal the entropy's coefficient."""
        self.loss.entropy_coeff = annealed(frames, **self.settings["entropy"])

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The loss's terms and the additional ones."""
        batch = _by_scene(batch)
        result = dict(self.loss(batch).items())
        for term in self.terms:
            result.update(term(batch).items())
        return result

    def _with_replay(self, terms: dict[str, Tensor]) -> dict[str, Tensor]:
        """Terms of a batch, and those of a sample of which the same optimizer step learns."""
        # converted weights are not shared between the two: their gradients would be added in bfloat16
        torch.clear_autocast_cache()
        return {**terms, **self.replay_losses()}

    def after_step(self) -> None:
        """A step of the multiplier."""
        if self.multiplier is not None:
            self.multiplier.step()

    def share_statistics(self, mean: Callable[[Tensor], Tensor]) -> None:
        """Normalize advantages over all ranks."""
        self.loss.value_estimator.mean = mean

    def take_means(self, terms: Mapping[str, Tensor]) -> None:
        """Take the KL of all ranks, which moves the multiplier."""
        if "kl" in terms:
            self.loss.last_kl.copy_(terms["kl"])

    def state_dict(self) -> dict[str, Any]:
        """The loss's buffers (coefficients, multiplier, last KL), without the networks."""
        networks = ("actor_network", "critic_network")
        buffers = self.loss.state_dict()
        return {"loss": {name: value for name, value in buffers.items() if not name.startswith(networks)}}

    @torch.no_grad()
    def warm_start(self, state: Mapping[str, Any]) -> None:
        """Take the multiplier; coefficients are those of the settings.

        Raises:
            CheckpointError: the state is of another algorithm.
        """
        if "loss" not in state:
            raise CheckpointError("of another algorithm; give the algorithm that it was trained with")
        adapted = {name: state["loss"][name] for name in _ADAPTED if name in state["loss"]}
        self.loss.load_state_dict(adapted, strict=False)


def _by_scene(batch: TensorDictBase) -> TensorDictBase:
    """The rows sorted by scene, where every row stays in one: no layer has to sort them again."""
    scene = batch.get("scene_id", None)
    if scene is None or scene.is_cuda or scene.dim() != 2:
        return batch
    first = scene[:, :1]
    if bool((scene != first).any()) or bool((first[1:] >= first[:-1]).all()):
        return batch
    return batch[first.squeeze(1).argsort(stable=True)]
