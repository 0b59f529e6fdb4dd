"""From the two embeddings to the hidden state that every head reads."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.modules.linear import SceneLinear
from vusfa.modules.precision import autocast_copy
from vusfa.modules.rows import RowScenes
from vusfa.modules.siamese import SiameseEncoder, joined
from vusfa.modules.unique import gather

__all__ = ["CachedTrunk", "Fusion", "SceneLayer", "SiameseTrunk"]


class Fusion(nn.Module):
    """Lays the embeddings of state and goal end to end; a dense layer with ReLU, shared by all scenes.

    Args:
        embedding_size: E.
        hidden_size: outputs.

    >>> import torch
    >>> Fusion(16, 32)(torch.randn(5, 16), torch.randn(5, 16)).shape
    torch.Size([5, 32])
    """

    def __init__(self, embedding_size: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * embedding_size, hidden_size)

    def forward(self, state_embedding: Tensor, goal_embedding: Tensor) -> Tensor:
        """(\\*B, E) twice to (\\*B, hidden_size)."""
        return functional.relu(self.state_part(state_embedding) + self.goal_part(goal_embedding))

    def state_part(self, embedding: Tensor) -> Tensor:
        """The state's summand (\\*B, hidden_size), from its embedding (\\*B, E), without the bias."""
        return functional.linear(embedding, self.linear.weight[:, : embedding.shape[-1]])

    def goal_part(self, embedding: Tensor) -> Tensor:
        """The goal's summand (\\*B, hidden_size), from its embedding (\\*B, E), with the bias."""
        weight = self.linear.weight[:, -embedding.shape[-1] :]
        return functional.linear(embedding, weight, self.linear.bias)


class SiameseTrunk(nn.Module):
    """Encoder and fusion as one module.

    The fusion's sum has one part of the state alone and one of the goal alone. These are computed per
    distinct state and goal, and only their sum row by row.

    Args:
        encoder: phi.
        fusion: reads both embeddings.

    >>> import torch
    >>> from vusfa.modules.frames import FeatureFrames
    >>> trunk = SiameseTrunk(SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 4, 16, 6), Fusion(6, 32))
    >>> state, goal, fused = trunk(torch.zeros(3, 4, dtype=torch.int64), torch.arange(3))
    >>> torch.allclose(fused, trunk.fusion(state, goal), atol=1e-6)
    True
    """

    def __init__(self, encoder: SiameseEncoder, fusion: Fusion) -> None:
        super().__init__()
        self.encoder = encoder
        self.fusion = fusion

    def forward(self, state: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """What :meth:`SiameseEncoder.forward` returns, and last the fused (\\*B, hidden)."""
        encoder, fusion, batch = self.encoder, self.fusion, self.encoder.batch_shape(state)
        states, goals = encoder.first_layer(state, goal)
        of_state, of_goal = encoder.encode_state(states.values), encoder.encode_goal(goals.values)
        state_part = gather(fusion.state_part(of_state.embedding), states.inverse)
        goal_part = gather(fusion.goal_part(of_goal.embedding), goals.inverse)
        fused = functional.relu(state_part + goal_part).view(*batch, -1)
        return *joined(of_state.gather(states.inverse, batch), of_goal.gather(goals.inverse, batch)), fused

    def fused(self, state: Tensor, goal: Tensor) -> Tensor:
        """The fused (\\*B, hidden) alone: no scale is computed and no embedding looked up."""
        states, goals = self.encoder.first_layer(state, goal)
        state_part = gather(self.fusion.state_part(self.encoder.embed_state(states.values)), states.inverse)
        goal_part = gather(self.fusion.goal_part(self.encoder.embed_goal(goals.values)), goals.inverse)
        return functional.relu(state_part + goal_part).view(*self.encoder.batch_shape(state), -1)


class CachedTrunk:
    """A trunk's ``fused`` while its weights stand still: whatever depends on one frame is computed once.

    Args:
        trunk: reads ids. Its weights are read now; later changes do not arrive here.
        goals: (G,) ids of the only states that will be goals; None for all of the world.

    >>> from vusfa.modules.frames import FeatureFrames
    >>> trunk = SiameseTrunk(SiameseEncoder(FeatureFrames(torch.rand(12, 1, 8)), 4, 16, 6), Fusion(6, 32))
    >>> state, goal = torch.randint(12, (3, 4)), torch.tensor([1, 7, 7])
    >>> cached = CachedTrunk(trunk, torch.tensor([7, 1]))
    >>> torch.allclose(cached.fused(state, goal), trunk.fused(state, goal), atol=1e-6)
    True
    """

    @torch.no_grad()
    def __init__(self, trunk: SiameseTrunk, goals: Tensor | None = None) -> None:
        encoder, fusion = trunk.encoder, trunk.fusion
        features, first = encoder.frames.lookup(None), encoder.branch.first
        (self.trunk,) = autocast_copy([trunk])
        if encoder.history == 1:  # (S, hidden), per state
            self.frames = fusion.state_part(encoder.embed_state(first(features.unsqueeze(-2))))
        else:  # (S, H, hidden), per frame and place
            self.frames = first.project(features)
        self.row: Tensor | None = None
        if goals is not None:
            # -1 where a state is no goal: looking it up fails, and does not mistake it for another one
            self.row = torch.full((len(features),), -1, dtype=torch.int64, device=features.device)
            self.row[goals] = torch.arange(len(goals), device=features.device)
            features = features[goals]
        goal_first = (encoder.goal_branch or encoder.branch).first.repeated(features)
        self.goals = fusion.goal_part(encoder.embed_goal(goal_first))  # (G, hidden)

    @torch.no_grad()
    def fused(self, state: Tensor, goal: Tensor) -> Tensor:
        """(R, hidden) of ids (R, H) and (R,)."""
        encoder, fusion = self.trunk.encoder, self.trunk.fusion
        goal_part = gather(self.goals, goal if self.row is None else self.row[goal])
        if encoder.history == 1:
            state_part = gather(self.frames, state[:, -1])
        else:
            sums = encoder.branch.first.gather(self.frames, state[:, -encoder.history :])
            state_part = fusion.state_part(encoder.embed_state(sums))
        return functional.relu(state_part + goal_part)


class SceneLayer(nn.Module):
    """A dense layer with ReLU, one per scene.

    Args:
        num_scenes: scenes with weights of their own.
        in_features: size of a row.
        hidden_size: outputs.

    >>> import torch
    >>> SceneLayer(2, 32, 32)(torch.randn(5, 32), torch.tensor([0, 1, 1, 0, 1])).shape
    torch.Size([5, 32])
    """

    def __init__(self, num_scenes: int, in_features: int, hidden_size: int) -> None:
        super().__init__()
        self.linear = SceneLinear(num_scenes, in_features, hidden_size)

    def forward(self, fused: Tensor, scene_id: RowScenes) -> Tensor:
        """(\\*B, in) with scene indices (\\*B,) to (\\*B, hidden_size)."""
        return functional.relu(self.linear(fused, scene_id))
