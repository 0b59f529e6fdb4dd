"""Observations for networks that read features or pixels instead of state ids.

The agents of this package look features up by id, so that none travels through collectors, buffers and pipes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn.functional import interpolate
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import ObservationTransform, TransformedEnv

from vusfa.envs.navigation import TargetNavEnv
from vusfa.errors import ConfigError, SceneError
from vusfa.limits import brief
from vusfa.scenes import Scene, SceneSet, check_scenes
from vusfa.scenes.features import SceneRows

__all__ = ["SceneObservation", "crop_index", "observation_table"]


def observation_table(scenes: SceneSet, kind: str, size: tuple[int, int] | None = None) -> Tensor:
    """Observations in every state: (S, C, F) float32 features of C crops, or (S, 1, 3, h, w) uint8 pixels.

    Args:
        scenes: the world.
        kind: "features" or "pixels".
        size: height and width that pictures are scaled to; None leaves them as they are.

    Raises:
        ConfigError: another kind.
        SceneError: a scene has no pictures, or they differ in size between scenes and no size is given.

    >>> bathroom = SceneSet.bundled(["bathroom"])
    >>> observation_table(bathroom, "features").shape, observation_table(bathroom, "pixels", (24, 32)).shape
    (torch.Size([176, 1, 1280]), torch.Size([176, 1, 3, 24, 32]))
    """
    if kind == "features":
        return scenes.features[:] if scenes.is_lazy else scenes.features
    if kind != "pixels":
        raise ConfigError(f"kind is {kind!r}; it is 'features' or 'pixels'")
    _check_sizes(scenes, size)
    return torch.cat([_pixels(scene, size) for scene in scenes.scenes]).unsqueeze(1)


def _check_sizes(scenes: SceneSet, size: tuple[int, int] | None) -> None:
    shapes = {scene.picture_shape for scene in scenes.scenes}
    if size is None and None not in shapes and len(shapes) > 1:
        raise SceneError(f"the scenes' pictures differ in size ({shapes}); pass size=(height, width)")


def _pixels(scene: Scene, size: tuple[int, int] | None) -> Tensor:
    """Pictures (N, 3, h, w) of a scene."""
    pixels = scene.pictures(torch.arange(scene.num_states)).permute(0, 3, 1, 2)
    if size is not None and tuple(pixels.shape[-2:]) != tuple(size):
        pixels = interpolate(pixels, size=tuple(size), mode="bilinear", antialias=True)
    return pixels.contiguous()


def crop_index(crop: str | int, crops: int, kind: str = "features") -> int | None:
    """The crop that "first" or an index names; None for "random", which draws one each time.

    Args:
        crop: "first", "random", or an index.
        crops: C, how many there are.
        kind: of what, for the message.

    Raises:
        ConfigError: there is no such crop.

    >>> crop_index("first", 10), crop_index("random", 10), crop_index(3, 10)
    (0, None, 3)
    """
    index = {"first": 0, "random": None}.get(crop, -1) if isinstance(crop, str) else crop
    if index is not None and (
        isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < crops
    ):
        raise ConfigError(
            f"crop is {brief(crop)}; give 'first', 'random', or an index below {crops} for {kind}"
        )
    return index


class SceneObservation(ObservationTransform):
    """Writes ``observation`` (from ``state_id``) and ``goal_observation`` (from ``goal_id``).

    ===================  ============================  ==============================
    key                  kind "features", float32      kind "pixels", uint8
    ===================  ============================  ==============================
    observation          (*B, H, F), oldest first      (*B, H, 3, h, w)
    goal_observation     (*B, F)                       (*B, 3, h, w)
    ===================  ============================  ==============================

    Args:
        scenes: the environment's world.
        kind: "features" or "pixels". Each process reads pictures when the first is needed.
        crop: which of the C augmented views of a state is taken: "first", an index, or "random", which draws
            one per frame that is written, from the environment's own generator in a :class:`TargetNavEnv`,
            from torch's global one elsewhere (in a replay buffer, say).
        size: height and width that pictures are scaled to.
        in_keys: keys of ids.
        out_keys: keys to write, one for each.

    Raises:
        ConfigError: another kind, or a crop that does not exist.
        SceneError: pixels are asked for and a scene has no pictures.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> env = TransformedEnv(TargetNavEnv(scenes, batch_size=[2], seed=0), SceneObservation(scenes))
    >>> data = env.reset()
    >>> data["observation"].shape, data["goal_observation"].shape
    (torch.Size([2, 4, 1280]), torch.Size([2, 1280]))
    >>> bool((data["observation"] == scenes.features[data["state_id"], 0]).all())
    True
    """

    def __init__(
        self,
        scenes: SceneSet,
        kind: str = "features",
        crop: str | int = "first",
        size: tuple[int, int] | None = None,
        in_keys: Sequence[NestedKey] = ("state_id", "goal_id"),
        out_keys: Sequence[NestedKey] = ("observation", "goal_observation"),
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        check_scenes(scenes)
        if kind not in ("features", "pixels"):
            raise ConfigError(f"kind is {kind!r}; it is 'features' or 'pixels'")
        crops = scenes.num_crops if kind == "features" else 1
        index = crop_index(crop, crops, kind)
        if kind == "pixels" and not all(scene.has_pictures for scene in scenes.scenes):
            without = next(scene.name for scene in scenes.scenes if not scene.has_pictures)
            raise SceneError(
                f"scene {without!r} has no pictures; use kind='features', or a file with pictures"
            )
        self.scenes = scenes.to("cpu")
        self.kind = kind
        self.size = size
        self.crop = index
        self.crops = crops
        # Not a buffer: it is built when it is needed, and neither saved nor pickled.
        self._table: Tensor | None = None
        self._rows = SceneRows(scenes.offsets) if scenes.is_lazy else None
        if kind == "pixels" and scenes.is_lazy:
            _check_sizes(scenes, size)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        if self._rows is not None:
            found = self._rows(obs.reshape(-1), self._read)  # (n, C, ...)
            crop: Tensor | int = 0 if self.crop is not None else self._drawn(obs)
            found = found[torch.arange(len(found), device=found.device), crop]
            return found.reshape(*obs.shape, *found.shape[1:])
        table = self._table
        if table is None or table.device != obs.device:
            self._check_env()
            table = observation_table(self.scenes, self.kind, self.size).to(obs.device)
            if self.crop is not None:
                table = table[:, self.crop : self.crop + 1].contiguous()
            self._table = table
        entry = obs.reshape(-1)
        if self.crop is None:
            entry = entry * self.crops + self._drawn(obs)
        found = table.flatten(0, 1).index_select(0, entry)
        return found.reshape(*obs.shape, *found.shape[1:])

    def _read(self, scene: int) -> Tensor:
        """Observations (N, C, ...) of a scene; C is 1 where the crop is given."""
        if self.kind == "pixels":
            return _pixels(self.scenes.scenes[scene], self.size).unsqueeze(1)
        crops = slice(None) if self.crop is None else slice(self.crop, self.crop + 1)
        return self.scenes.features.of_scene(scene)[:, crops]

    def _drawn(self, obs: Tensor) -> Tensor:
        """A crop (n,) for each entry."""
        shape = (obs.numel(),)
        return torch.randint(self.crops, shape, generator=self._generator(), device=obs.device)

    def _env(self) -> TargetNavEnv | None:
        env: Any = self.container
        while isinstance(env, TransformedEnv):
            env = env.base_env
        return env if isinstance(env, TargetNavEnv) else None

    def _check_env(self) -> None:
        """Raise a ConfigError where the ids of the environment are those of other scenes."""
        env = self._env()
        own, other = self.scenes, self.scenes if env is None else env.scenes
        if own.scenes is not other.scenes and own.fingerprint != other.fingerprint:
            raise ConfigError(
                f"SceneObservation has scenes {brief(list(own.names))}, the environment"
                f" {brief(list(other.names))}; give it those of the environment"
            )

    def _generator(self) -> torch.Generator | None:
        env = self._env()
        return None if env is None else env.generator

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the keys that are written."""
        assert isinstance(observation_spec, Composite)
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            ids = observation_spec[in_key]
            observation_spec[out_key] = self._spec(ids.shape, ids.device)
        return observation_spec

    def _spec(self, shape: torch.Size, device: torch.device | None) -> TensorSpec:
        if self.kind == "features":
            return Unbounded((*shape, self.scenes.feature_size), dtype=torch.float32, device=device)
        height, width = self.size or self.scenes.scenes[0].picture_shape[:2]  # type: ignore[index]
        return Bounded(0, 255, (*shape, 3, height, width), dtype=torch.uint8, device=device)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_table": None}
