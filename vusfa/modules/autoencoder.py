"""phi of a pretrained autoencoder, which depends on no reward."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from vusfa.errors import ConfigError
from vusfa.limits import RESIDENT_BYTES
from vusfa.modules.agents import Agent

__all__ = ["explained_features", "pretrain_autoencoder"]


def explained_features(made: Tensor, features: Tensor) -> float:
    """Share of the variance of features (S, F) over states that a reconstruction (S, F) explains, at most 1.

    >>> explained_features(torch.tensor([[0.0], [2.0], [4.0]]), torch.tensor([[0.0], [2.0], [6.0]]))
    0.7857142686843872
    """
    left = (made - features).square().sum()
    return (1 - left / (features - features.mean(0)).square().sum()).item()


def pretrain_autoencoder(
    agent: Agent, *, steps: int = 2000, batch_size: int = 256, lr: float = 1e-3, seed: int = 0
) -> float:
    r"""Train an agent's encoder to reconstruct features, with a linear decoder that is then thrown away.

    .. math:: \min_{\phi, W} \; E_s \lVert W \phi(s) - x(s) \rVert^2

    over all states of the agent's scenes, x(s) the features of the frame (normalized, where the agent
    normalizes them) and phi(s) the ``state_embedding`` of a history of that frame alone. Afterwards the
    encoder's weights are constants.

    Args:
        agent: made with ``pretrained="autoencoder"``; its encoder is changed.
        steps: of Adam, with a learning rate that falls linearly to 0.
        batch_size: states per step.
        lr: learning rate at the start.
        seed: of batches and decoder.

    Returns:
        the share of the features' variance that the reconstruction explains, see :func:`explained_features`.

    Raises:
        ConfigError: the agent was not made with ``pretrained="autoencoder"``, or in lazily opened scenes of
            more features than these keep.

    >>> from vusfa.modules import make_agent
    >>> from vusfa.scenes import SceneSet
    >>> rooms = SceneSet.bundled(["bathroom"])
    >>> agent = make_agent("usfa", scenes=rooms, history=1, hidden_size=32, pretrained="autoencoder")
    >>> before = pretrain_autoencoder(agent, steps=0)
    >>> before < 0.1 < pretrain_autoencoder(agent, steps=50)
    True
    """
    if agent.config["pretrained"] != "autoencoder":
        raise ConfigError("only an agent made with pretrained='autoencoder' has its encoder pretrained")
    encoder = agent.encoder
    needed = 4 * encoder.frames.num_states * encoder.frames.size
    if encoder.frames.is_lazy and needed > RESIDENT_BYTES:
        raise ConfigError(
            f"algorithm=autoencoder learns from the features of all states at once, {needed >> 20} MiB, of"
            f" which lazily opened scenes keep {RESIDENT_BYTES >> 20}; give fewer scenes or another algorithm"
        )
    features: Tensor = encoder.frames.lookup(None)
    generator = torch.Generator().manual_seed(seed)
    decoder = nn.Linear(agent.config["embedding_size"], features.shape[-1]).to(features.device)
    with torch.no_grad():
        decoder.weight.copy_(torch.randn(decoder.weight.shape, generator=generator) * 0.01)
        decoder.bias.zero_()

    def made(states: Tensor) -> Tensor:
        return decoder(encoder(states.unsqueeze(-1).expand(-1, agent.config["history"]), states)[0])

    encoder.requires_grad_(True)
    try:
        optimizer = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=lr)
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = lr * (1 - step / steps)
            states = torch.randint(len(features), (batch_size,), generator=generator).to(features.device)
            optimizer.zero_grad()
            functional.mse_loss(made(states), features[states]).backward()
            optimizer.step()
    finally:
        encoder.requires_grad_(False)
    with torch.no_grad():
        return explained_features(made(torch.arange(len(features), device=features.device)), features)
