"""A training as one thing that can be saved, and taken up where it was."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.objectives import LossModule

from vusfa.envs import SceneObservation
from vusfa.errors import CheckpointError, ConfigError, VusfaError
from vusfa.modules import Agent, frozen, make_agent
from vusfa.scenes import SceneSet, bundled_names
from vusfa.training.checkpoint import (
    check_scenes,
    check_setting,
    load_checkpoint,
    random_state,
    restore_random_state,
    save_checkpoint,
)
from vusfa.training.collectors import close_collector, collector_state, load_collector_state
from vusfa.training.learning import loss_state
from vusfa.training.loggers import flat
from vusfa.training.memory import keep_memory
from vusfa.training.metrics import EpisodeMeter, MeanMeter
from vusfa.training.replay import HindsightReplay

__all__ = [
    "Session",
    "load_agent",
    "make_observation",
    "rebuild_agent",
    "scene_sources",
    "set_threads",
    "torch_device",
]

# entries of Agent.config that describe the scenes, not the agent
_OF_SCENES = ("scenes", "fingerprint", "num_actions")
# settings whose other wording changes nothing: scenes are told apart by their content
_REWORDED = ("resume", "scenes")
# buffers of the loss that the training moves; the others are settings
_ADAPTED = ("bottleneck_coeff", "last_kl")


@dataclass
class Session:
    """Everything that changes while an agent learns, and how far it has come.

    Args:
        scenes: the world.
        goals: (G,) global ids of the goals trained on.
        agent, loss, optimiser: what learns.
        settings: what the checkpoint shall say of how all this was made: plain data under ``config``,
            ``overrides`` and ``sources`` (what was given as scenes).

    Attributes:
        frames: frames trained on.
        updates: steps of the optimiser.
        seconds: time spent training, this run and those that it continues.
        episodes: how the episodes since the last line of the log ended.
        terms: means of the loss's terms since then.
        run_id: the same for all loggers and for all resumptions.
        replay: what the agent walked, where it learns from that, too.
    """

    scenes: SceneSet
    goals: Tensor
    agent: Agent
    loss: LossModule
    optimiser: torch.optim.Optimizer
    settings: Mapping[str, Any]
    frames: int = 0
    updates: int = 0
    seconds: float = 0.0
    run_id: str = field(default_factory=lambda: secrets.token_hex(4))
    replay: HindsightReplay | None = None

    def __post_init__(self) -> None:
        self.episodes = EpisodeMeter(self.scenes, self.goals)
        self.terms = MeanMeter()
        self._collector: BaseCollector | None = None
        self._waiting: dict[
            str, Any
        ] = {}  # of a checkpoint: what can be restored only once there is a collector

    @contextmanager
    def collecting(self, make: Callable[[], BaseCollector]) -> Iterator[Iterator[TensorDictBase]]:
        """Makes a collector and gives its batches, from where a resumed checkpoint stood; in the end its
        processes end, too.

        A collector with workers changes this process's number of threads; that is put right.
        """
        threads = torch.get_num_threads()
        collector = make()
        try:
            self._collector = collector
            if self._waiting:
                load_collector_state(collector, self._waiting["collector"])
                restore_random_state(self._waiting["rng"])  # last: what came before has drawn
                self._waiting = {}
            yield iter(collector)
        finally:
            self._collector = None
            close_collector(collector)
            torch.set_num_threads(threads)

    @contextmanager
    def encoded_once(self, precision: Callable[[], AbstractContextManager] = nullcontext) -> Iterator[None]:
        """For one update, within :meth:`collecting`: the whole world is encoded on the way in, and collecting
        and the loss look it up. The weights may change only after it.

        Where a batch has less than half as many frames as the world has states, the batch's states are
        encoded as they come, which is the shorter way then; so they are for a collector with workers.

        Args:
            precision: context to encode in, such as autocast.
        """
        collector = self._collector
        goals = self.goals if self.replay is None else None  # hindsight: any state may be a goal
        frames = collector.requested_frames_per_batch if isinstance(collector, Collector) else 0
        with ExitStack() as stack:
            if 2 * frames >= self.scenes.num_states:
                with precision():
                    stack.enter_context(frozen(self.agent, grad=True, goals=goals))
            yield

    def count(self, batch: TensorDictBase, terms: Mapping[str, Tensor], seconds: float) -> None:
        """One update has been made.

        Args:
            batch: the collector's.
            terms: numbers to log the means of, the same names each time.
            seconds: that it took.
        """
        self.frames += batch.numel()
        self.updates += 1
        self.seconds += seconds
        self.episodes.update(batch)
        self.terms.update(terms)

    def metrics(self) -> dict[str, float]:
        """A line of the log: what the meters hold, which begin anew, and how far the training has come.

        Raises:
            VusfaError: a weight that is not a number any more.
        """
        self._check_weights()
        head = {
            "updates": float(self.updates),
            "seconds": self.seconds,
            "lr": self.optimiser.param_groups[0]["lr"],
        }
        return head | self.episodes.flush() | self.terms.flush()

    def save(self, path: str | Path) -> Path:
        """Write a checkpoint, atomically, while collecting; see :mod:`vusfa.training.checkpoint`.

        Raises:
            VusfaError: a weight that is not a number any more; the checkpoint before stays as it is.
        """
        self._check_weights()
        if self._collector is None:
            raise RuntimeError(
                "a session is saved within collecting(): where the environments stand belongs to it"
            )
        return save_checkpoint(
            path,
            {
                "frames": self.frames,
                "updates": self.updates,
                "seconds": self.seconds,
                "run_id": self.run_id,
                "scenes": {
                    "sources": self.settings["sources"],
                    "names": list(self.scenes.names),
                    "fingerprint": self.scenes.fingerprint,
                },
                "goals": self.goals.cpu(),
                "config": self.settings["config"],
                "overrides": self.settings["overrides"],
                "agent_config": self.agent.config,
                "agent": self.agent.state_dict(),
                "loss": loss_state(self.loss),
                "optimiser": self.optimiser.state_dict(),
                "collector": collector_state(self._collector),
                "meter": {"episodes": self.episodes.state_dict(), "terms": self.terms.state_dict()},
                "replay": None if self.replay is None else self.replay.state_dict(),
                "rng": random_state(),
            },
        )

    @torch.no_grad()
    def _check_weights(self) -> None:
        # one number for all weights: a short batch is logged at every update
        if torch.nn.utils.get_total_norm(self.agent.parameters()).isfinite():
            return
        wrong = [name for name, param in self.agent.named_parameters() if not param.isfinite().all()]
        if wrong:
            raise VusfaError(
                f"after {self.frames:,} frames the weights {', '.join(wrong)} are not finite any more; choose"
                " a smaller optim.lr or optim.max_grad_norm, and resume an earlier checkpoint or begin anew"
            )

    def adopt(self, state: Mapping[str, Any], path: str | Path = "the checkpoint") -> None:
        """Take over a checkpoint's weights and the bottleneck's multiplier, and nothing else.

        Raises:
            CheckpointError: the weights are of another model.
        """
        _load_weights(self.agent, state, path)
        adapted = {key: state["loss"][key] for key in _ADAPTED if key in state["loss"]}
        self.loss.load_state_dict(adapted, strict=False)

    def resume(self, path: str | Path) -> list[str]:
        """Go on from a checkpoint; to be called before :meth:`collecting`.

        With a single collector what follows is what would have followed, number for number. Coefficients and
        the optimiser's numbers are those of the settings now; what the training itself has moved is restored.

        Returns:
            settings that differ from the checkpoint's, one line each.

        Raises:
            CheckpointError: the file is damaged, or of another model, other scenes, goals or optimiser.
        """
        state = load_checkpoint(path, next(self.agent.parameters()).device)
        check_scenes(path, state["scenes"], self.scenes)
        for key, value in self.agent.config.items():
            if key not in _OF_SCENES:
                check_setting(path, f"agent.{key}", state["agent_config"].get(key), value)
        check_setting(path, "env.goals", state["goals"].tolist(), self.goals.tolist())
        self.adopt(state, path)
        _load_optimiser(self.optimiser, state, path)
        self.episodes.load_state_dict(state["meter"]["episodes"])
        self.terms.load_state_dict(state["meter"]["terms"])
        if self.replay is not None:
            if not state.get("replay"):
                raise CheckpointError(f"{path}: of a training without hindsight; give hindsight=none")
            self.replay.load_state_dict(state["replay"])
        for name in ("frames", "updates", "seconds", "run_id"):
            setattr(self, name, state[name])
        self._waiting = {"collector": state["collector"], "rng": state["rng"]}
        return _changes(state["config"], self.settings["config"])


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    old, new = flat(before), flat(now)
    keys = [key for key in old.keys() | new.keys() if old.get(key) != new.get(key)]
    return [f"{key}={new.get(key)} instead of {old.get(key)}" for key in sorted(keys) if key not in _REWORDED]


def scene_sources(scenes: str | Sequence[str]) -> list[str]:
    """What was given as scenes, in a form that still works from another folder.

    >>> scene_sources("kitchen")
    ['kitchen']
    """
    given = [scenes] if isinstance(scenes, str) else list(scenes)
    return [name if name in bundled_names() else str(Path(name).resolve()) for name in given]


def make_observation(agent: Agent, scenes: SceneSet, crop: str = "first") -> SceneObservation | None:
    """What stands between the world and an agent that is handed features or pixels; None for one that reads
    ids.

    Args:
        agent: the agent.
        scenes: the world.
        crop: of :class:`~vusfa.envs.SceneObservation`, for features.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> make_observation(make_agent("gvf", scenes=scenes, observation="features"), scenes).kind
    'features'
    """
    kind = agent.config["observation"]
    if kind == "index":
        return None
    if kind == "features":
        return SceneObservation(scenes, "features", crop=crop)
    return SceneObservation(scenes, "pixels", size=tuple(agent.config["picture_size"]))


def set_threads(threads: int) -> None:
    """Sets how many processor threads torch computes with in this process, and has it keep its memory
    (:func:`~vusfa.training.memory.keep_memory`).

    Raises:
        ConfigError: fewer than one.

    >>> before = torch.get_num_threads()
    >>> set_threads(1)
    >>> torch.get_num_threads()
    1
    >>> set_threads(before)
    """
    if threads < 1:
        raise ConfigError(f"threads is {threads}; give 1 or more")
    torch.set_num_threads(threads)
    keep_memory()


def torch_device(name: str) -> torch.device:
    """A device by name.

    Raises:
        ConfigError: there is none of that name, or not in this machine.

    >>> torch_device("cpu")
    device(type='cpu')
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        first = str(error).splitlines()[0]
        raise ConfigError(
            f"device is {name!r}, which cannot be used here ({first}); give cpu or cuda"
        ) from error
    return device


def rebuild_agent(config: Mapping[str, Any], scenes: SceneSet) -> Agent:
    """An untrained agent of the shape that :attr:`vusfa.modules.Agent.config` describes.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("gvf", scenes=scenes, hidden_size=8, embedding_size=8)
    >>> rebuild_agent(agent.config, scenes).config == agent.config
    True
    """
    return make_agent(scenes=scenes, **{k: v for k, v in config.items() if k not in _OF_SCENES})


def load_agent(
    path: str | Path, scenes: SceneSet | None = None, device: torch.device | str = "cpu"
) -> tuple[Agent, SceneSet, dict[str, Any]]:
    """The agent of a checkpoint, in evaluation mode, with its scenes.

    Args:
        path: the checkpoint.
        scenes: the scenes that it was trained in; opened as they were then, when not given.
        device: where the agent and the scenes' tables go.

    Returns:
        agent, scenes and the checkpoint's content.

    Raises:
        CheckpointError: the file is damaged, or of other scenes.
        SceneError: its scenes are not where they were.
    """
    device = torch_device(str(device))
    state = load_checkpoint(path, device)
    scenes = (SceneSet.open(state["scenes"]["sources"]) if scenes is None else scenes).to(device)
    check_scenes(path, state["scenes"], scenes)
    agent = rebuild_agent(state["agent_config"], scenes).to(device)
    _load_weights(agent, state, path)
    return agent.eval(), scenes, state


def _load_weights(agent: Agent, state: Mapping[str, Any], path: str | Path) -> None:
    try:
        agent.load_state_dict(state["agent"])
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"{path}: its weights do not fit a {agent.config['model']} agent ({first})"
        ) from error


def _load_optimiser(optimiser: torch.optim.Optimizer, state: Mapping[str, Any], path: str | Path) -> None:
    """The optimiser's memory of gradients; its numbers stay as they are."""
    saved, settings = state["optimiser"], [dict(group) for group in optimiser.param_groups]
    if saved["param_groups"][0].keys() != settings[0].keys():
        raise CheckpointError(
            f"{path}: its optimiser is not a {type(optimiser).__name__}; leave the setting out,"
            " or start a new run"
        )
    optimiser.load_state_dict(saved)
    for group, numbers in zip(optimiser.param_groups, settings, strict=True):
        group.update({key: value for key, value in numbers.items() if key != "params"})
