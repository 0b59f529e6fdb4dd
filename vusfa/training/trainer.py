"""Trainer: the state of a training, and its loop.

Each update is: collect, losses, optimizer step, further steps from replay, what follows a step. Which losses
these are is the business of an :class:`~vusfa.algorithms.Algorithm`; none is named here.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector

from vusfa.algorithms import Algorithm, annealed
from vusfa.envs import SceneObservation
from vusfa.modules import Agent, InferencePolicy
from vusfa.scenes import SceneSet, check_home
from vusfa.training.active_heads import ActiveHeads
from vusfa.training.checkpoint import (
    check_fits,
    differences,
    load_checkpoint,
    load_optimizer,
    load_weights,
    save_checkpoint,
)
from vusfa.training.collectors import collector_state, coming_goals, load_collector_state, opened
from vusfa.training.content import NO_VALIDATION, check_like, restore
from vusfa.training.metrics import EpisodeMeter, MeanMeter
from vusfa.training.optimization import check_finite, descend, total_loss
from vusfa.training.precision import resolve_autocast
from vusfa.training.random_state import check_random_state, random_state, restore_random_state
from vusfa.training.ranks import Ranks
from vusfa.training.scene_files import scene_sources, settings_seen_from, without_places
from vusfa.training.workers import supervised

__all__ = ["Trainer"]


class Trainer:
    """State of a training, and its updates.

    :func:`~vusfa.training.make_trainer` makes one from settings.

    Args:
        scenes: the world.
        goals: (G,) global ids of the goals trained on.
        agent: what learns.
        algorithm: its losses.
        optimizer: of ``algorithm.parameters()``.
        make_collector: called with the policy that collects.
        settings: all settings, as plain data.
        overrides: the command line that made them; kept in checkpoints.
        observation: transform between world and agent in evaluations, or None.
        note: message of the algorithm's preparation, or None.
        heads: of active scenes, where only these are computed; for a single collector.
        ranks: of a data-parallel training, each with a trainer; by default this process alone.

    Attributes:
        actor: the policy; writes ``action``.
        frames: frames trained on.
        updates: updates made.
        seconds: time spent in updates, in this run and those that it continues.
        episodes: how the episodes since the last line of the log ended.
        terms: means of the loss's terms since then.
        run_id: the same for all loggers and for all resumptions.
        validation: of the evaluations during the training: best score, frames at the last one, seconds spent
            in all and in the last, and the same of their media.
    """

    def __init__(
        self,
        scenes: SceneSet,
        goals: Tensor,
        agent: Agent,
        algorithm: Algorithm,
        optimizer: torch.optim.Optimizer,
        make_collector: Callable[[TensorDictModuleBase], BaseCollector],
        settings: Mapping[str, Any],
        overrides: Sequence[str] = (),
        observation: SceneObservation | None = None,
        note: str | None = None,
        heads: ActiveHeads | None = None,
        ranks: Ranks | None = None,
    ) -> None:
        check_home(agent, scenes)
        self.scenes, self.goals, self.agent = scenes, goals, agent
        self.algorithm, self.optimizer = algorithm, optimizer
        self.settings, self.overrides = settings, overrides
        self.observation, self.note, self.heads, self.ranks = observation, note, heads, ranks or Ranks()
        self.actor = agent.get_policy_operator(out_keys=["action"])
        self.acting = InferencePolicy(agent)
        self._make_collector = partial(make_collector, self.acting)
        self.frames, self.updates, self.seconds = 0, 0, 0.0
        self.run_id, self.validation = secrets.token_hex(4), dict(NO_VALIDATION)
        self.episodes, self.terms = EpisodeMeter(scenes, goals), MeanMeter()
        self._collector: BaseCollector | None = None
        self._waiting: tuple[str | Path, Mapping[str, Any]] | None = None  # a checkpoint, for the collector

    @contextmanager
    def collecting(self) -> Iterator[Iterator[TensorDictBase]]:
        """Context manager of a new collector's batches, which continue where a resumed checkpoint stopped;
        its processes end with the context."""
        with opened(self._make_collector) as collector:
            self._collector = collector
            try:
                if self._waiting is not None:
                    path, state = self._waiting
                    load_collector_state(collector, state["collector"], path)
                    restore_random_state(state["rng"])  # last: what came before has drawn
                    self._waiting = None
                yield iter(collector)
            finally:
                self._collector = None
                if self.heads is not None:
                    self.heads.gather()

    def whole(self) -> AbstractContextManager[None]:
        """Context in which the agent has the heads of all scenes, for an evaluation in mid-training."""
        return nullcontext() if self.heads is None else self.heads.whole()

    def collect(self, batches: Iterator[TensorDictBase]) -> TensorDictBase:
        """The collector's next batch, without an update.

        With a single collector the policy's answers are of the weights on entry, and what they share is
        computed once.
        """
        collector = self._collector
        with self._precision(), ExitStack() as stack:
            if isinstance(collector, Collector):
                frames, goals = collector.requested_frames_per_batch, coming_goals(collector)
                if self.heads is not None:
                    self._entered = self.scenes.scene_id.cpu()[goals].unique()
                    self.heads.load(self._entered)
                stack.enter_context(self.acting.cached(goals, self.scenes, frames))
            if collector is not None:
                stack.enter_context(supervised(collector))
            return next(batches)

    def update(self, batches: Iterator[TensorDictBase]) -> tuple[TensorDictBase, dict[str, Tensor]]:
        """Collect a batch and learn from it.

        Args:
            batches: those of :meth:`collecting`.

        Returns: the batch, and the numbers to log: the losses' terms and the gradient's norm.
        """
        began = time.monotonic()
        self.algorithm.show_crops()
        self.algorithm.schedule(self.frames)
        batch = self.collect(batches)
        if self.heads is not None:
            scenes = torch.cat([self._entered, self.algorithm.scenes_on_record()]).unique()
            self.heads.load(scenes, exactly=True)
        first, *others = self.algorithm.minibatches(batch)
        with self._precision():  # another one: autocast keeps weights that it converted without gradients
            terms = dict(self.algorithm.losses(first))
        norm = self._descend(terms)
        for part in others:
            self.algorithm.after_step()
            with self._precision():
                terms = dict(self.algorithm.losses(part))
            norm = self._descend(terms)
        for _ in range(self.algorithm.replay_steps):
            self.algorithm.show_crops()
            with self._precision():
                more = dict(self.algorithm.replay_losses())
            self._descend(more)
            terms.update(more)
        self.algorithm.after_step()
        terms = {name: value.detach() for name, value in terms.items()} | {"grad_norm": norm}
        self.frames, self.updates = self.frames + batch.numel() * self.ranks.size, self.updates + 1
        self.episodes.update(batch)
        self.terms.update(terms)
        self.seconds += time.monotonic() - began
        return batch, terms

    def _descend(self, terms: dict[str, Tensor]) -> Tensor:
        """One optimizer step; gradients and terms become their means over all ranks."""
        optim = self.settings["optim"]
        lr = annealed(self.frames, optim["lr"], optim["horizon"])
        average = partial(self.ranks.average, terms=terms)
        norm = descend(self.optimizer, total_loss(terms), lr, optim["max_grad_norm"], average)
        if self.ranks.size > 1:
            self.algorithm.take_means(terms)
        return norm

    def metrics(self) -> dict[str, float]:
        """Metrics since the last call, for a line of the log; the meters start over.

        Raises:
            VusfaError: a weight is not finite.
        """
        self._check_weights()
        for state in self.ranks.gather(self.episodes.state_dict())[1:]:
            self.episodes.add(state)
        lr = self.optimizer.param_groups[0]["lr"]
        head = {"updates": float(self.updates), "seconds": self.seconds, "lr": lr}
        return head | self.episodes.flush() | self.terms.flush()

    def save(self, path: str | Path) -> Path:
        """Write a checkpoint atomically, within :meth:`collecting`; see :mod:`vusfa.training.checkpoint`.
        With ranks all call this, and rank 0 writes what belongs to all.

        Raises:
            VusfaError: a weight is not finite; an earlier checkpoint stays as it is.
        """
        self._check_weights()
        if self._collector is None:
            raise RuntimeError("a trainer is saved within collecting(): environments belong to its state")
        with self.whole():
            own = {
                "algorithm": self.algorithm.state_dict(),
                "collector": collector_state(self._collector),
                "meter": {"episodes": self.episodes.state_dict(), "terms": self.terms.state_dict()},
                "rng": random_state(),
            }
            merged = self.ranks.merge(own, self.algorithm.merge_states)
            if self.ranks.is_first:
                save_checkpoint(path, self._content(Path(path).parent, merged))
            return Path(path)

    def _content(self, folder: Path, merged: Mapping[str, Any]) -> dict[str, Any]:
        return dict(merged) | {
            "frames": self.frames,
            "updates": self.updates,
            "seconds": self.seconds,
            "run_id": self.run_id,
            "validation": dict(self.validation),
            "scenes": {
                "sources": scene_sources(self.settings["scenes"], folder),
                "names": list(self.scenes.names),
                "fingerprint": self.scenes.fingerprint,
            },
            "goals": self.goals.cpu(),
            "config": settings_seen_from(folder, self.settings),
            "overrides": without_places(list(self.overrides)),
            "agent_config": self.agent.config,
            "agent": self.agent.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def load_weights(self, state: Mapping[str, Any], path: str | Path = "the checkpoint") -> None:
        """Load a checkpoint's weights and what belongs to them, such as the multiplier; nothing else.

        Args:
            state: content of the checkpoint.
            path: for messages.

        Raises:
            CheckpointError: the weights are of another model.
        """
        load_weights(self.agent, state, path)
        self.algorithm.warm_start(state["algorithm"])

    def resume(self, path: str | Path) -> list[str]:
        """Continue from a checkpoint; call it before :meth:`collecting`.

        With a single collector what follows is what would have followed, number for number. Coefficients and
        the optimizer's numbers are those of the settings now; what the training itself has moved is restored.

        Returns:
            settings that differ from the checkpoint's, one line each.

        Raises:
            CheckpointError: the file is damaged, or of another model, other scenes, goals or optimizer.
        """
        state = load_checkpoint(path, next(self.agent.parameters()).device)
        check_fits(path, state, self.scenes, self.goals, self.agent)
        load_weights(self.agent, state, path)
        load_optimizer(self.optimizer, state, path)
        restore(path, "rng", check_random_state, state["rng"])
        state = self.ranks.share_of_state(path, state, self.algorithm.share_of_state)
        restore(path, "algorithm", self.algorithm.load_state_dict, state["algorithm"])
        check_like(path, "meter.episodes", state["meter"]["episodes"], self.episodes.state_dict())
        self.episodes.load_state_dict(state["meter"]["episodes"])
        restore(path, "meter.terms", self.terms.load_state_dict, state["meter"]["terms"])
        for name in ("frames", "updates", "seconds", "run_id"):
            setattr(self, name, state[name])
        self.validation = dict(state["validation"])
        self._waiting = path, state
        return differences(state["config"], self.settings)

    def _precision(self) -> AbstractContextManager:
        device = next(self.agent.parameters()).device
        enabled = resolve_autocast(self.settings["autocast"], device)
        return torch.autocast(device.type, torch.bfloat16, enabled=enabled)

    def _check_weights(self) -> None:
        if self.ranks.is_first:  # they are the same on all
            check_finite(self.algorithm.parameters(), self.agent, self.frames)
