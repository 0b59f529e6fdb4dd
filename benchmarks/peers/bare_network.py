"""The four models as plain functions of a dictionary of tensors.

The weights are copied from one of our agents, so that both compute the same numbers; what differs is that no
module, no tensordict and no dispatch stands around the products. The arithmetic is the best that is known to
us: each state's and each goal's part once, rows grouped by scene once a batch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from vusfa.modules import Agent
from vusfa.modules.config import MODELS

__all__ = ["BareNetwork", "Goals", "Outputs", "Rows", "group"]

Weights = dict[str, Tensor]


class Rows(NamedTuple):
    """Rows of a batch in the order of their scenes.

    Attributes:
        state: (R, H) int64.
        goal: (R,) int64, positions in the list of goals.
        counts: rows of each scene.
        order: (R,) int64, which row of the batch each is.
    """

    state: Tensor
    goal: Tensor
    counts: list[int]
    order: Tensor


class Goals(NamedTuple):
    """What depends on the goal alone, one row a goal: the fusion's part, mean and scale, or the embedding."""

    fused: Tensor
    loc: Tensor
    scale: Tensor | None
    embedding: Tensor


class Outputs(NamedTuple):
    """What the network says of rows; what a model lacks is None."""

    logits: Tensor
    embedding: Tensor
    loc: Tensor
    scale: Tensor | None
    successor: Tensor | None
    value: Tensor | None


def group(state: Tensor, goal: Tensor, scene: Tensor, num_scenes: int) -> Rows:
    """Sort rows by scene."""
    if num_scenes == 1:
        return Rows(state, goal, [len(goal)], torch.arange(len(goal)))
    order = scene.argsort(stable=True)
    return Rows(state[order], goal[order], torch.bincount(scene, minlength=num_scenes).tolist(), order)


class BareNetwork:
    """One of the four models.

    Args:
        agent: whose weights to copy; it reads ids, with an encoder of two layers that state and goal share.
        half: compute products in bfloat16.
        few: the batches have so few rows that several frames are computed row by row, not for all states.

    Attributes:
        params: name to leaf tensor.
    """

    def __init__(self, agent: Agent, half: bool = False, few: bool = False) -> None:
        config: dict[str, Any] = agent.config
        encoder = config["embedding_layer"] and config["shared_encoder"] and not config["state_layer"]
        if config["architecture"] == "reference" or config["observation"] != "index" or not encoder:
            raise ValueError(
                "BareNetwork: give an agent that reads ids, of architecture 'controlled' or 'paper', with an"
                " encoder of two layers"
            )
        self.few = few and config["history"] > 1
        self.ideas, self.config, self.half = MODELS[config["model"]], config, half
        self.params: Weights = {}
        self.num_scenes = agent.scene_layer.linear.num_scenes
        for name, value in agent.named_parameters():
            short = "encoder." + name.rpartition("branch.")[2] if name.startswith("encoder.") else name
            self.params[short] = value.detach().clone().requires_grad_()
        frames = next(m for m in agent.modules() if type(m).__name__ == "FeatureFrames")
        self.table: Tensor = frames.lookup(None).to(torch.bfloat16 if half else torch.float32)  # type: ignore[operator]

    def weights(self) -> Weights:
        """The parameters as the products want them; differentiable."""
        return {k: v.bfloat16() for k, v in self.params.items()} if self.half else self.params

    def states(self, w: Weights) -> Tensor:
        """What of the encoder depends on single states: (S, code) with one frame, else (S * H, hidden);
        nothing with few rows."""
        first = w["encoder.first.weight"]
        if self.few:
            return self.table[:0]
        if len(first) == 1:
            return self._finish(w, functional.linear(self.table, first[0], w["encoder.first.bias"]))
        return functional.linear(self.table, first.flatten(0, 1)).view(-1, first.shape[1])

    def goals(self, w: Weights, ids: Tensor) -> Goals:
        """Encode the goals ``ids`` (G,)."""
        first = functional.linear(self.table[ids], w["encoder.first.weight"].sum(0), w["encoder.first.bias"])
        loc, scale = self._gaussian(self._finish(w, first).float())
        embedding = self._phi(loc)
        fusion = w["fusion.linear.weight"][:, loc.shape[-1] :]
        fused = functional.linear(embedding.to(fusion.dtype), fusion, w["fusion.linear.bias"])
        return Goals(fused, loc, scale, embedding)

    def rows(self, w: Weights, states: Tensor, goals: Goals, rows: Rows, *, acting: bool = False) -> Outputs:
        """Everything that does not hang on the noise of a latent, in the order of ``rows``; without the
        scales where they are for ``acting`` alone, which reads none."""
        if self.config["history"] == 1:
            code = functional.embedding(rows.state.squeeze(-1), states)
        else:
            history = rows.state.shape[-1]
            if self.few:
                frames = zip(rows.state.unbind(1), w["encoder.first.weight"].unbind(0), strict=True)
                sums = torch.stack([functional.linear(self.table[ids], one) for ids, one in frames]).sum(0)
            else:
                places = rows.state * history + torch.arange(history)
                sums = functional.embedding_bag(places, states, mode="sum")
            code = self._finish(w, sums + w["encoder.first.bias"], half=acting and self.ideas.bottleneck)
        if acting:
            loc, scale = code.float()[:, : self.config["embedding_size"]], None
        else:
            loc, scale = self._gaussian(code.float())
        embedding = self._phi(loc)
        half = w["fusion.linear.weight"].dtype
        fused = functional.linear(
            embedding.to(half), w["fusion.linear.weight"][:, : loc.shape[-1]]
        ) + functional.embedding(rows.goal, goals.fused)
        hidden = self._scene(w, "scene_layer.linear", fused.relu(), rows).relu()
        successor = value = None
        if self.ideas.successor_value:
            psi = self._scene(w, "successor.linear", hidden, rows).float()
            successor = self.config["successor_scale"] * psi
        else:
            value = self._scene(w, "value.linear", hidden, rows).float().squeeze(-1)
        if successor is not None and self.ideas.successor_policy:
            constant = successor.detach()
            if self.config["successor_norm"] is not None:
                constant = functional.layer_norm(constant, successor.shape[-1:], eps=1e-6)
            both = torch.cat([hidden, constant.to(half)], -1)
            logits = self._scene(w, "policy.last", self._scene(w, "policy.first", both, rows).relu(), rows)
        else:
            logits = self._scene(w, "policy.linear", hidden, rows)
        return Outputs(logits.float(), embedding, loc, scale, successor, value)

    def value(self, w: Weights, goals: Goals, rows: Rows, out: Outputs, noise: Tensor | None) -> Tensor:
        """V (R,): psi . omega, omega of a sample of the goal's latent where there is a bottleneck.

        Args:
            noise: (R, E) standard normal, of a model with a bottleneck.
        """
        if out.successor is None:
            assert out.value is not None
            return out.value
        if goals.scale is None:
            omega = self._omega(w, goals.embedding)  # one a goal
            return (out.successor * functional.embedding(rows.goal, omega)).sum(-1)
        latent = functional.embedding(rows.goal, goals.loc)
        if noise is not None:
            latent = latent + functional.embedding(rows.goal, goals.scale) * noise
        return (out.successor * self._omega(w, latent)).sum(-1)

    def _omega(self, w: Weights, goal: Tensor) -> Tensor:
        first = functional.linear(
            goal.to(w["reward.first.weight"].dtype), w["reward.first.weight"], w["reward.first.bias"]
        )
        last = functional.linear(first.relu(), w["reward.last.weight"], w["reward.last.bias"])
        return self.config["reward_scale"] * last.float()

    def _finish(self, w: Weights, first: Tensor, half: bool = False) -> Tensor:
        outputs = len(w["encoder.last.bias"]) // (2 if half else 1)
        last = w["encoder.last.weight"][:outputs], w["encoder.last.bias"][:outputs]
        return functional.linear(first.relu(), *last)

    def _phi(self, loc: Tensor) -> Tensor:
        return functional.layer_norm(loc, loc.shape[-1:]) if self.config["normalize_embedding"] else loc

    def _gaussian(self, code: Tensor) -> tuple[Tensor, Tensor | None]:
        if not self.ideas.bottleneck:
            return code, None
        loc, scale = code.chunk(2, -1)
        return loc, functional.softplus(scale)

    def _scene(self, w: Weights, name: str, x: Tensor, rows: Rows) -> Tensor:
        """Each scene's layer on its own rows."""
        weights, biases = w[f"{name}.weight"].unbind(0), w[f"{name}.bias"].unbind(0)
        if len(weights) == 1:
            return functional.linear(x, weights[0], biases[0])
        parts = zip(x.split(rows.counts), weights, biases, strict=True)
        return torch.cat([functional.linear(part, weight, bias) for part, weight, bias in parts])
