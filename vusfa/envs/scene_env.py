"""Base class of environments over scenes: signature, random generator, device, rendering."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase, is_tensor_collection
from torch import Tensor

from vusfa.envs.rendering import draw_panels
from vusfa.envs.world import RotatingWorld, World, env_specs, map_tensors
from vusfa.errors import ConfigError
from vusfa.limits import MAX_ENV_FRAMES, brief
from vusfa.scenes import SceneSet, check_home, check_scenes
from vusfa.torchrl_private import StatelessEnv

__all__ = ["SceneEnv", "check_counts", "check_seed", "usable_device"]


def check_counts(**arguments: tuple[Any, int]) -> None:
    """Refuse arguments, each with its smallest value, that are smaller, or no whole numbers.

    >>> check_counts(history=(0, 1))
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: history is 0; it must be at least 1
    """
    for name, (value, least) in arguments.items():
        if not _is_whole(value) or value >= 2**31:
            raise ConfigError(f"{name} is {brief(value)}; give a whole number below 2 ** 31")
        if value < least:
            raise ConfigError(f"{name} is {value}; it must be at least {least}")


def check_seed(seed: Any) -> None:
    """Refuse what is no seed of a random generator.

    >>> check_seed(-1)
    Traceback (most recent call last):
    ...
    vusfa.errors.ConfigError: seed is -1; give a whole number of 0 or more, below 2 ** 63
    """
    if not (_is_whole(seed) and 0 <= seed < 2**63):
        raise ConfigError(f"seed is {brief(seed)}; give a whole number of 0 or more, below 2 ** 63")


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def usable_device(device: torch.device | str) -> torch.device:
    """A device by name.

    Raises:
        ConfigError: there is none of that name, or not in this machine.

    >>> usable_device("cpu")
    device(type='cpu')
    """
    try:
        found = torch.device(device)
        torch.empty(1, device=found).cpu()  # a meta device holds no numbers
    except (RuntimeError, AssertionError, ImportError, TypeError) as error:
        first = str(error).splitlines()[0].split(". ")[0]
        first = first if len(first) < 100 else f"{first[:97]}..."
        raise ConfigError(
            f"device is {brief(str(device))}, which cannot be used here ({first}); give cpu or cuda"
        ) from error
    return found


class SceneEnv(StatelessEnv):
    """Base of batched environments over scenes. A subclass sets :attr:`_world` and takes the steps.

    Arguments are those of :class:`TargetNavEnv`.

    Raises:
        ConfigError: ``scenes`` is no SceneSet, ``batch_size`` no shape, or ``seed`` no whole number.
    """

    batch_locked: ClassVar[bool] = True
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 4}
    _world: World
    _rotating: RotatingWorld | None = None
    goals: Tensor

    def __init_subclass__(cls, **options: Any) -> None:
        """Let :func:`inspect.signature` find the arguments, which TorchRL's metaclass hides."""
        super().__init_subclass__(**options)
        signature = inspect.signature(cls.__init__)
        cls.__signature__ = signature.replace(parameters=list(signature.parameters.values())[1:])

    def __init__(self, scenes: SceneSet, batch_size: Sequence[int], history: int, seed: int | None) -> None:
        check_scenes(scenes)
        if isinstance(batch_size, str) or not isinstance(batch_size, Iterable):
            example = [batch_size] if _is_whole(batch_size) else [64]
            raise ConfigError(f"batch_size is {brief(batch_size)}; give a list, {brief(example)}")
        lengths = list(batch_size)
        if not all(_is_whole(length) and length > 0 for length in lengths):
            raise ConfigError(f"batch_size is {brief(lengths)}; give lengths of 1 or more, [64]")
        if (most := MAX_ENV_FRAMES // history) < math.prod(lengths):
            raise ConfigError(
                f"batch_size is {brief(lengths)}; with history={history} give at most {most:,} environments"
            )
        size = torch.Size(lengths)
        super().__init__(device=torch.device("cpu"), batch_size=size)
        self.scenes = scenes.to("cpu")
        self.history = history
        self._generator = torch.Generator()
        self._seed: int | None = None
        self._set_seed(seed)
        self._shown: tuple[Tensor, Tensor] | None = None

    def rollout(self, max_steps: int, policy: Any = None, *args: Any, **options: Any) -> TensorDictBase:
        """As :meth:`EnvBase.rollout`; an agent that was made for other scenes is a ``ConfigError``."""
        check_counts(max_steps=(max_steps, 1))
        check_home(policy, self.scenes)
        return super().rollout(max_steps, policy, *args, **options)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """As :meth:`EnvBase.step`; anything but a tensordict is a ``ConfigError``."""
        if not is_tensor_collection(tensordict):
            raise ConfigError(
                f"step() was given {brief(tensordict)}; give it the tensordict that reset() returned, with an"
                " action in it"
            )
        return super().step(tensordict)

    def _make_specs(self, shortest_path: bool) -> None:
        specs = env_specs(self.scenes, self.batch_size, self.history, shortest_path)
        self._keys = list(specs.state.keys())
        self.state_spec = specs.state
        self.observation_spec = specs.observation
        self.action_spec = specs.action
        self.reward_spec = specs.reward
        self.full_done_spec = specs.done

    def _set_seed(self, seed: int | None) -> None:
        """Start the generator anew; None starts it somewhere else each time."""
        if seed is not None:
            check_seed(seed)
        self._seed = None if seed is None else int(seed)
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(int(seed))

    @property
    def generator(self) -> torch.Generator:
        """The source of every draw."""
        return self._generator

    def get_rng_state(self) -> Tensor:
        """The generator's state, a byte tensor on the CPU."""
        return self._generator.get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Draw on from what :meth:`get_rng_state` gave, on a device of the same kind."""
        self._generator.set_state(state.cpu())

    def get_extra_state(self) -> Tensor:
        """The generator's state, the content of :meth:`state_dict`."""
        return self.get_rng_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator; called by :meth:`load_state_dict`."""
        self.set_rng_state(state)

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Restore what :meth:`state_dict` gave; an empty one, as TorchRL's collectors keep, is ignored."""
        return super().load_state_dict(state_dict, strict=strict and bool(state_dict), assign=assign)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> SceneEnv:
        """Apply a function to all tensors, the tables among them, as every move of a module does."""
        super()._apply(fn, recurse)
        self._world = map_tensors(fn, self._world)
        device = self._world.successor.device
        if device != self._generator.device:
            # a generator's state means nothing on another kind of device
            self._generator = torch.Generator(device)
            self._set_seed(self._seed)
        return self

    def _turned(self) -> World | None:
        """The world's tables where the rotation has changed them."""
        world = None if self._rotating is None else self._rotating.world()
        return None if world is None else map_tensors(lambda table: table.to(self.device), world)

    def _rotate(self) -> None:
        """Take the rotation on by one step."""
        if self._rotating is not None:
            self._rotating.frames += self._rotating.frames_per_step
            self._world = self._turned() or self._world

    def coming_goals(self, steps: int) -> Tensor:
        """Goals (G,) of the episodes that can begin within so many steps, global ids."""
        rotating = self._rotating
        if rotating is None:
            return self.goals
        return rotating.rotation.goals_between(
            rotating.frames, rotating.frames + steps * rotating.frames_per_step
        )

    def _show(self, state_id: Tensor, goal_id: Tensor, mask: Tensor | None = None) -> None:
        """Remember what :meth:`render` shows by default."""
        if mask is not None and self._shown is not None:
            mask = mask.reshape(self.batch_size)
            state_id = torch.where(mask.unsqueeze(-1), state_id, self._shown[0])
            goal_id = torch.where(mask, goal_id, self._shown[1])
        self._shown = (state_id, goal_id)

    def render(
        self,
        tensordict: TensorDictBase | None = None,
        row: int | tuple[int, ...] = 0,
        panels: Sequence[str] | None = None,
    ) -> np.ndarray:
        """Draw one agent.

        Args:
            tensordict: ``state_id`` and ``goal_id`` of the environment's batch size; by default what the
                environment returned last.
            row: index of the agent in the batch (a number: in row-major order).
            panels: from left to right, any of "view", what the agent sees; "goal", the goal's picture; "map",
                the scene from above. By default the view, or the map where a scene has no pictures.

        Returns:
            (h, w, 3) uint8.

        Raises:
            ConfigError: nothing to show yet, no such row, or no such panel.
            SceneError: the scene has no pictures.

        >>> from vusfa.envs import TargetNavEnv
        >>> env = TargetNavEnv(SceneSet.bundled(["bathroom"]), batch_size=[3])
        >>> data = env.reset()
        >>> env.render().shape, env.render(data, row=2, panels=("view", "map")).shape
        ((150, 200, 3), (150, 358, 3))
        """
        if tensordict is not None:
            state_id, goal_id = tensordict.get("state_id"), tensordict.get("goal_id")
        elif self._shown is not None:
            state_id, goal_id = self._shown
        else:
            raise ConfigError("there is nothing to render yet; call reset() first, or pass a tensordict")
        try:
            index = (
                row if isinstance(row, tuple) else np.unravel_index(row, self.batch_size or (1,))[: self.ndim]
            )
            trail, goal = state_id[index].tolist(), int(goal_id[index])
        except (IndexError, ValueError) as error:
            raise ConfigError(f"there is no row {row}; the batch is {tuple(self.batch_size)}") from error
        return draw_panels(self.scenes, trail, goal, panels)
