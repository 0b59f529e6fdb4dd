"""A trained agent at a camera: pictures in, actions out."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import Tensor

from vusfa.deploy.agents import open_agent
from vusfa.deploy.backbone import find_backbone
from vusfa.deploy.pictures import as_picture, in_shape
from vusfa.deploy.places import Places
from vusfa.envs.scene_env import check_seed
from vusfa.errors import ConfigError, GoalError
from vusfa.limits import brief, listing
from vusfa.modules import Agent
from vusfa.scenes import SceneSet
from vusfa.sources.backbones import Backbone
from vusfa.sources.crops import cut, prepare
from vusfa.training.checkpoint import rebuild_agent

__all__ = ["Action", "Navigator", "reading_pictures"]


class Action(NamedTuple):
    """The next action.

    Attributes:
        name: name of the action, such as ``MoveForward``.
        index: index of the action, 0 to A - 1.
        confidence: the policy's probability of the action, 0 to 1.
        arrived: whether the similarity with the goal's picture has reached the threshold.
    """

    name: str
    index: int  # type: ignore[assignment]  # tuple has a method of this name
    confidence: float
    arrived: bool


class Navigator:
    """A trained agent with backbone, preprocessing, normalization and history, for use at a camera.

    Args:
        agent: trained, in evaluation mode.
        scenes: the rooms that it was trained in.
        backbone: what made the rooms' features, see :func:`~vusfa.deploy.backbone.find_backbone`; an agent
            with convolutions of its own needs none.
        scene: name of the room that the camera is in; recognized from the goal's picture when not given.
        sample: draw actions from the policy; False takes the most probable one.
        seed: seed of the sampled actions.
        threshold: similarity from which on the goal counts as reached; calibrated on the rooms' own states
            when not given, see :mod:`vusfa.deploy.places`.
        crop: cut the centre out of pictures of another aspect ratio than the rooms' pictures.

    Attributes:
        scene: name of the room; None before the first goal.
        probabilities: (A,) float32, of the actions at the last picture; None before the first.
        similarity: similarity of the last picture with the goal's; None before the first.
        threshold: see Args.

    Raises:
        ConfigError: the backbone is unknown or another one, or the threshold is not a similarity.
        SceneError: there is no such room.

    >>> from vusfa.modules import make_agent
    >>> rooms = SceneSet.bundled(["bathroom", "bedroom"])
    >>> navigator = Navigator(make_agent("gvf", scenes=rooms, hidden_size=8, embedding_size=8).eval(), rooms)
    >>> navigator.goal(rooms.pictures(200))
    'bedroom'
    >>> navigator.act(rooms.pictures(190)).arrived, navigator.act(rooms.pictures(200)).arrived
    (False, True)
    """

    def __init__(
        self,
        agent: Agent,
        scenes: SceneSet,
        backbone: str | Backbone | None = None,
        *,
        scene: str | None = None,
        sample: bool = True,
        seed: int = 0,
        threshold: float | None = None,
        crop: bool = False,
    ) -> None:
        self.scenes = scenes.to("cpu")
        self.agent = reading_pictures(agent, self.scenes)
        self.backbone = None if agent.config["encoder"] == "conv" else find_backbone(scenes, backbone)
        frames = agent.encoder.frames
        with torch.no_grad():
            table = self.scenes.features[:, 0] if self.backbone else frames.lookup(None).cpu()
        self.places = Places(table, self.scenes.offsets.diff().tolist())
        check_seed(seed)
        if threshold is not None and not (isinstance(threshold, int | float) and -1 <= threshold <= 1):
            raise ConfigError(
                f"threshold is {brief(threshold)}; a similarity is between -1 and 1, such as 0.8"
            )
        self.threshold = self.places.arrived if threshold is None else threshold
        self.scene = None if scene is None else self.scenes.names[self.scenes.scene_index(scene)]
        self.probabilities: Tensor | None = None
        self.similarity: float | None = None
        self._named = scene is not None
        self._sample, self._crop = sample, crop
        self._generator = torch.Generator().manual_seed(seed)
        self._policy = TensorDictSequential(*self.agent.actor_steps())
        self._goal: tuple[Tensor, Tensor] | None = None
        self.reset()

    @classmethod
    def load(
        cls,
        checkpoint: str | os.PathLike[str],
        *,
        scenes: SceneSet | None = None,
        backbone: str | Backbone | None = None,
        **options: Any,
    ) -> Navigator:
        """Load the navigator of a checkpoint, or of a pretrained agent.

        Args:
            checkpoint: one of ``vusfa train``; a .safetensors file; or a name of ``vusfa pretrained list``.
            scenes: those that it was trained in; opened as they were then, when not given.
            backbone, options: as for the class.

        Raises:
            CheckpointError: the file is missing, damaged, or of other scenes.
            SceneError: its scenes are not where they were.
            ConfigError: the backbone is unknown.
        """
        found = open_agent(checkpoint, scenes)
        return cls(found.agent, found.scenes, backbone, **options)

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the A actions."""
        return self.scenes.actions

    def reset(self) -> None:
        """Begin a new walk towards the same goal: forget the pictures seen."""
        self._history: list[Tensor] = []
        self._memory: dict[Any, Tensor] = {}
        self._before = 0
        self.probabilities, self.similarity = None, None

    def goal(self, picture: Any) -> str:
        """Set the goal by a picture taken there, and begin a new walk.

        Args:
            picture: path, PIL image, or uint8 (H, W, 3).

        Returns:
            the room's name: the one given, or the one that has the state most similar to the picture.

        Raises:
            GoalError: the picture was not taken in the room: no state of it is similar enough. An agent that
                has one set of heads for all rooms takes any picture.
            SceneError: it is no picture, or of another aspect ratio.
        """
        array, name = self._picture(picture)
        observation, features = self._observe(array)
        similar = self.places.by_room(features[None])[0]
        if not self._named:
            self.scene = self.scenes.names[int(similar.argmax())]
        assert self.scene is not None
        found = float(similar[self.scenes.scene_index(self.scene)])
        if found < self.places.known and not self.agent.config["shared_heads"]:
            where = f"room {self.scene!r}" if self._named else f"the rooms {listing(self.scenes.names)}"
            raise GoalError(
                f"{name}: was not taken in {where} (similarity {found:.2f} to the nearest state, at least"
                f" {self.places.known:.2f} is needed); take the goal's picture in a room of the agent"
            )
        self._goal = observation, features
        self.reset()
        return self.scene

    @torch.inference_mode()
    def act(self, picture: Any) -> Action:
        """The next action for the camera's current picture.

        Args:
            picture: path, PIL image, or uint8 (H, W, 3).

        Raises:
            GoalError: there is no goal yet.
            SceneError: it is no picture, or of another aspect ratio.
        """
        if self._goal is None or self.scene is None:
            raise GoalError("there is no goal yet; call goal(picture) first")
        observation, features = self._observe(self._picture(picture)[0])
        kept = self.agent.config["history"]
        started = bool(self._history)
        before = self._before if started else len(self.actions)
        self._history = [*(self._history or [observation] * (kept - 1)), observation][-kept:]
        rows = TensorDict(
            {
                "observation": torch.stack(self._history)[None],
                "goal_observation": self._goal[0][None],
                "scene_id": torch.tensor([self.scenes.scene_index(self.scene)]),
                "is_init": torch.tensor([[not started]]),
                "previous_action": torch.tensor([before]),
            },
            [1],
        )
        for key, value in self._memory.items():
            rows.set(key, value)
        rows = self._policy(rows)
        keys = [key for key in self._policy.out_keys if isinstance(key, tuple) and key[0] == "next"]
        self._memory = {key[1:]: rows.get(key) for key in keys}
        self.probabilities = probabilities = rows["logits"].softmax(-1)[0]
        if self._sample:
            index = int(torch.multinomial(probabilities, 1, generator=self._generator))
        else:
            index = int(probabilities.argmax())
        self._before = index
        self.similarity = self.places.similarity(features, self._goal[1]).item()
        arrived = self.similarity >= self.threshold
        return Action(self.actions[index], index, probabilities[index].item(), arrived)

    def resized(self, picture: Any) -> np.ndarray:
        """A picture as the network reads it before normalization, (h, w, 3) uint8.

        Args:
            picture: as for :meth:`act`, with its errors.
        """
        return self._resized(self._picture(picture)[0])

    def _resized(self, picture: np.ndarray) -> np.ndarray:
        if self.backbone is not None:
            return cut(picture, self.backbone.preprocessing)[0]
        height, width, _ = self.scenes.scenes[0].picture_shape  # type: ignore[misc]
        return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BICUBIC))

    def _picture(self, picture: Any) -> tuple[np.ndarray, str]:
        array, name = as_picture(picture)
        rooms = (
            [self.scenes.scenes[self.scenes.scene_index(self.scene)]] if self._named and self.scene else []
        )
        shapes = [room.picture_shape[:2] for room in rooms or self.scenes.scenes if room.picture_shape]
        return (in_shape(array, name, shapes, crop=self._crop) if shapes else array), name

    @torch.inference_mode()
    def _observe(self, picture: np.ndarray) -> tuple[Tensor, Tensor]:
        """The agent's input from a picture, and the features (F,) that locate it."""
        if self.backbone is not None:
            features = self.backbone(prepare(picture[None], self.backbone.preprocessing))[0]
            if len(features) != self.scenes.feature_size:
                raise ConfigError(
                    f"backbone {self.backbone.name} gives {len(features)} features, the rooms have"
                    f" {self.scenes.feature_size}; pass the backbone that made them"
                )
            return features, features
        pixels = torch.from_numpy(np.array(self._resized(picture))).permute(2, 0, 1)
        return pixels, self.agent.encoder.frames.encode(pixels[None])[0]


def reading_pictures(agent: Agent, scenes: SceneSet) -> Agent:
    """Copy an agent to the CPU, with pictures of a camera as input instead of state ids.

    Args:
        agent: the trained agent.
        scenes: those that it was trained in; for an agent whose heads are the same for all rooms also others
            with as many actions and features.

    Raises:
        ConfigError: the agent was made for other scenes.
    """
    agent.home._replace(reads_ids=False).check(scenes)
    kind = "pixels" if agent.config["encoder"] == "conv" else "features"
    config = {**agent.config, "observation": kind, "pretrained": None}
    reading = rebuild_agent(config, scenes)
    reading.load_state_dict({key: value.cpu() for key, value in agent.state_dict().items()})
    return reading.eval().requires_grad_(False)
