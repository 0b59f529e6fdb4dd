"""Networks of critics that score every action at every state for every goal."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchrl.modules import MLP

__all__ = ["BilinearCritic", "ForwardBackwardCritic", "make_tower"]


def make_tower(in_features: int, hidden_size: int, out_features: int) -> nn.Module:
    """A critic's network: two layers with LayerNorm and ReLU, and a linear one.

    >>> make_tower(8, 16, 3)(torch.rand(5, 8)).shape
    torch.Size([5, 3])
    """
    norm = {"normalized_shape": hidden_size}
    return MLP(
        in_features,
        out_features,
        num_cells=[hidden_size, hidden_size],
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm,
        norm_kwargs=[norm, norm],
    )


class BilinearCritic(nn.Module):
    """Scores psi(s, a) . omega(g) / sqrt(E) of all actions, from features of states and of goals.

    >>> BilinearCritic(8, 4, hidden_size=16, size=6)(torch.rand(3, 8), torch.rand(5, 8)).shape
    torch.Size([3, 4, 5])
    """

    def __init__(self, feature_size: int, num_actions: int, hidden_size: int, size: int) -> None:
        super().__init__()
        self.num_actions, self.size = num_actions, size
        self.action = make_tower(feature_size, hidden_size, num_actions * size)
        self.goal = make_tower(feature_size, hidden_size, size)

    def forward(self, state: Tensor, goal: Tensor) -> Tensor:
        """Features (S, F) and (G, F) to scores (S, A, G), float32 or more."""
        psi, omega = self.action(state), self.goal(goal)
        with torch.autocast(state.device.type, enabled=False):  # their differences are small
            dtype = torch.promote_types(psi.dtype, torch.float32)
            scores = psi.to(dtype).view(-1, self.size) @ omega.to(dtype).mT
        return scores.view(len(state), self.num_actions, -1) / self.size**0.5


class ForwardBackwardCritic(nn.Module):
    """Forward representation F(s, a, z) and backward representation B(s), both of d numbers.

    >>> critic = ForwardBackwardCritic(8, 4, hidden_size=16, size=6)
    >>> z = critic.backward_of(torch.rand(3, 8))
    >>> critic(torch.rand(3, 8), z).shape, z.square().sum(-1)
    (torch.Size([3, 4, 6]), tensor([6.0000, 6.0000, 6.0000], grad_fn=<SumBackward1>))
    """

    def __init__(self, feature_size: int, num_actions: int, hidden_size: int, size: int) -> None:
        super().__init__()
        self.num_actions, self.size = num_actions, size
        self.state = nn.Linear(feature_size, hidden_size)
        self.task = nn.Linear(size, hidden_size, bias=False)
        self.last = nn.Sequential(
            nn.LayerNorm(hidden_size),
            nn.ReLU(),
            nn.Linear(hidden_size, hidden_size),
            nn.ReLU(),
            nn.Linear(hidden_size, num_actions * size),
        )
        self.back = make_tower(feature_size, hidden_size, size)

    def backward_of(self, state: Tensor) -> Tensor:
        """B (S, d) of features (S, F), of length sqrt(d); float32 or more."""
        code = self.back(state)
        return self.unit(code.to(torch.promote_types(code.dtype, torch.float32)))

    def unit(self, task: Tensor) -> Tensor:
        """The same direction with length sqrt(d)."""
        return self.size**0.5 * functional.normalize(task, dim=-1)

    def forward(self, state: Tensor, task: Tensor, place: Tensor | None = None) -> Tensor:
        """F (n, A, d), float32 or more.

        Args:
            state: features (n, F), or (S, F) of distinct states.
            task: z, (n, d).
            place: (n,) int64, of each row's state among the distinct ones.
        """
        known = self.state(state)
        code = self.last((known if place is None else known[place]) + self.task(task))
        return code.to(torch.promote_types(code.dtype, torch.float32)).view(len(task), self.num_actions, -1)
