"""An episode as a GIF: the agent's view, its goal, and the map."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict.nn import TensorDictModuleBase

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.envs.rendering import draw_panels
from vusfa.errors import SceneError
from vusfa.evaluation import Episodes, trails
from vusfa.evaluation.navigation import Observe
from vusfa.files import replacing
from vusfa.scenes import SceneSet

__all__ = ["draw_film", "encode_gif", "farthest_pair", "longest_success", "record_walk", "write_gif"]

_TITLE_HEIGHT = 22
_INK, _PAPER = (60, 64, 72), (255, 255, 255)


def longest_success(episodes: Episodes, scenes: SceneSet) -> tuple[int, int] | None:
    """Start and goal, global ids, of the success with the longest shortest path; None if all episodes failed.

    Trained goals come first, then shorter episodes.
    """
    found = [row for row in episodes.rows() if row["success"]]
    if not found:
        return None
    best = max(found, key=lambda row: (row["trained"], row["shortest"], -row["length"]))
    return int(scenes.global_id(best["scene"], best["start"])), int(
        scenes.global_id(best["scene"], best["goal"])
    )


def farthest_pair(
    scenes: SceneSet,
    scene: str | int,
    start: int | None = None,
    goal: int | None = None,
    goals: torch.Tensor | None = None,
) -> tuple[int, int]:
    """Start and goal, global ids, with the longest shortest path in a scene.

    Args:
        scenes: the world.
        scene: name or index.
        start, goal: local ids; one that is given is kept.
        goals: (G,) global ids from which the goal is chosen, such as the trained ones; those of other scenes
            are passed over. Where none is left, the goal is state 0.

    Raises:
        SceneError: there is no such scene or state, or no path from the start to the goal.

    >>> farthest_pair(SceneSet.bundled(["bathroom"]), "bathroom", goal=9)
    (173, 9)
    """
    index = scenes.scene_index(scene)
    candidates = [] if goals is None else goals[scenes.scene_id[goals] == index].tolist()
    candidates = candidates or [int(scenes.global_id(index, 0))]
    if goal is not None:
        candidates = [int(scenes.global_id(index, goal))]
    states = torch.arange(int(scenes.offsets[index]), int(scenes.offsets[index + 1]))
    if start is not None:
        states = scenes.global_id(index, [start])
    found = []
    for candidate in candidates:
        distance = scenes.distance(states, candidate)
        best = int(distance.argmax())
        found.append((int(distance[best]), int(states[best]), candidate))
    longest, first, last = max(found)
    if longest < 0:
        raise SceneError(f"scene {scenes.names[index]!r}: no path leads from state {start} to state {goal}")
    return first, last


def record_walk(
    policy: TensorDictModuleBase,
    scenes: SceneSet,
    start: int,
    goal: int,
    *,
    max_steps: int = MAX_STEPS,
    history: int = 4,
    attempts: int = 10,
    seed: int = 0,
    observe: Observe | None = None,
) -> list[int]:
    """Trajectory of a policy with sampled actions.

    Args:
        policy: reads ``state_id``, ``goal_id`` and ``scene_id``, writes ``action``.
        scenes: the world, on the policy's device.
        start, goal: global state ids.
        max_steps: limit of actions.
        history: frames in ``state_id``.
        attempts: episodes, of which the shortest successful one is taken.
        seed: seed of the actions; the caller's random state is unchanged.
        observe: see :func:`vusfa.evaluation.evaluate`.

    Returns:
        global ids of the visited states, start and end included.
    """
    starts, goals = torch.full((attempts,), start), torch.full((attempts,), goal)
    ways = trails(
        policy, scenes, starts, goals, max_steps=max_steps, history=history, seed=seed, observe=observe
    )
    return min(ways, key=lambda way: len(way) if way[-1] == goal else max_steps + 2)


def draw_film(scenes: SceneSet, trail: Sequence[int], goal: int, scale: int = 2) -> list[Image.Image]:
    """One picture per visited state; a scene without pictures shows the map only.

    Args:
        scenes: the world.
        trail: global ids of the visited states.
        goal: global id.
        scale: enlargement of the scene's pictures.

    >>> scenes = SceneSet.bundled(["bathroom"])
    >>> [picture.size for picture in draw_film(scenes, [72, 73], goal=73)]
    [(1132, 322), (1132, 322)]
    """
    scene = scenes.scenes[int(scenes.scene_id[goal])]
    panels = {"map": ""}
    if scene.has_pictures:
        panels = {"view": "view", "goal": "goal", **panels}
    shortest = int(scenes.distance(trail[0], goal))
    film = []
    for step in range(len(trail)):
        drawn = Image.fromarray(draw_panels(scenes, trail[: step + 1], goal, list(panels)))
        drawn = drawn.resize((scale * drawn.width, scale * drawn.height), Image.Resampling.LANCZOS)
        picture = Image.new("RGB", (drawn.width, drawn.height + _TITLE_HEIGHT), _PAPER)
        picture.paste(drawn, (0, _TITLE_HEIGHT))
        draw = ImageDraw.Draw(picture)
        words = dict(panels, map=f"step {step}, shortest {shortest}")
        left = 0
        for panel, title in words.items():
            draw.text((left + 2, 3), title, fill=_INK, font=ImageFont.load_default(14))
            width = scene.picture_shape[1] if scene.picture_shape is not None and panel != "map" else 0
            left += scale * (width + 8)
        film.append(picture)
    return film


def write_gif(path: str | Path, film: Sequence[Image.Image], frames_per_second: float = 4.0) -> Path:
    """Write a GIF that loops, with a pause on its last picture, atomically.

    Raises:
        ValueError: no pictures.
    """
    data = encode_gif(film, frames_per_second)
    with replacing(path) as unfinished:
        unfinished.write_bytes(data)
    return Path(path)


def encode_gif(film: Sequence[Image.Image], frames_per_second: float = 4.0) -> bytes:
    """Encode a GIF, as :func:`write_gif` writes it.

    >>> encode_gif([Image.new("RGB", (4, 4))])[:6]
    b'GIF89a'
    """
    if not film:
        raise ValueError("a film needs at least one picture")
    pause = round(1000 / frames_per_second)
    durations = [pause] * (len(film) - 1) + [8 * pause]
    # One palette for all pictures, so that the colors do not flicker.
    strip = Image.new("RGB", (film[0].width, film[0].height * min(len(film), 8)))
    for place, picture in enumerate(film[:: max(1, len(film) // 8)][:8]):
        strip.paste(picture, (0, place * picture.height))
    palette = strip.quantize(256, method=Image.Quantize.MEDIANCUT)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for picture in film]
    encoded = io.BytesIO()
    pictures[0].save(
        encoded, format="GIF", save_all=True, append_images=pictures[1:], duration=durations, loop=0
    )
    return encoded.getvalue()
