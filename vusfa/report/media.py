"""Media of evaluations during a training: a walk as a film, success by place."""

from __future__ import annotations

import io

import torch
from PIL import Image
from torch import Tensor

from vusfa.envs.rendering import draw_values
from vusfa.evaluation import trails
from vusfa.modules import InferencePolicy
from vusfa.report.film import draw_film, encode_gif, farthest_pair
from vusfa.training import Trainer

__all__ = ["draw_media"]

#: Actions of the walk that the film shows, and scenes whose floors are drawn.
STEPS, SCENES = 40, 8


def draw_media(trainer: Trainer, success: Tensor, goals: Tensor) -> dict[str, bytes]:
    """Draw media of an agent in training.

    Args:
        trainer: the agent's trainer; weights and random state are unchanged.
        success: (S,) probability of success from each state; NaN: unknown.
        goals: (G,) global ids of the validation goals.

    Returns:
        ``eval/walk``, a GIF of the first 40 actions of a walk in the first scene, from the state that is
        farthest from a goal to that goal; ``eval/floor/SCENE``, a PNG of success by place, of at most eight
        scenes.

    >>> from vusfa.experiments.training import compose_settings
    >>> from vusfa.training import make_trainer
    >>> trainer = make_trainer(compose_settings(["scenes=[bathroom]", "agent.hidden_size=8"]))
    >>> media = draw_media(trainer, torch.rand(176), torch.tensor([73]))
    >>> {name: data[:4] for name, data in media.items()}
    {'eval/walk': b'GIF8', 'eval/floor/bathroom': b'\\x89PNG'}
    """
    scenes = trainer.scenes.to(next(trainer.agent.parameters()).device)
    start, goal = farthest_pair(scenes, int(scenes.scene_id[int(goals[0])]), goals=goals.to(scenes.device))
    (trail,) = trails(
        InferencePolicy(trainer.agent),
        scenes,
        torch.tensor([start]),
        torch.tensor([goal]),
        max_steps=STEPS,
        history=trainer.agent.config["history"],
        observe=trainer.observation,
    )
    media = {"eval/walk": encode_gif(draw_film(scenes, trail, goal, scale=1))}
    for index, scene in enumerate(scenes.scenes[:SCENES]):
        first = int(scenes.offsets[index])
        last = first + scene.num_states
        here = goals[(goals >= first) & (goals < last)] - first
        drawn, encoded = draw_values(scene, success[first:last], here.tolist()), io.BytesIO()
        Image.fromarray(drawn).save(encoded, format="PNG")
        media[f"eval/floor/{scene.name}"] = encoded.getvalue()
    return media
