from __future__ import annotations

import pytest
import torch

from vusfa.modules.pair_probe import PairProbe


def test_only_the_map_says_where_things_are() -> None:
    """Parts in another order are the same to a pooled probe, and not to a spatial one."""
    torch.manual_seed(0)
    one, other = torch.rand(2, 4, 6, 8)
    for kind, same in (("pooled", True), ("spatial", False)):
        probe = PairProbe(kind, 6, 8, {"turn": 4, "view": 2}, hidden_size=16)
        probe.normalize_by(torch.cat([one, other]))
        found, mixed = probe(one, other), probe(one.flip(1), other)
        assert [tuple(part.shape) for part in found.values()] == [(4, 4), (4, 2)]
        assert torch.allclose(found["turn"], mixed["turn"], atol=1e-5) == same
        assert not torch.allclose(found["turn"], probe(other, one)["turn"], atol=1e-3)


def test_features_are_normalized() -> None:
    maps = 5 + 3 * torch.randn(200, 6, 8)
    for kind, shape in (("pooled", (1, 8)), ("spatial", (6, 8))):
        probe = PairProbe(kind, 6, 8, {"turn": 4}, hidden_size=8)
        probe.normalize_by(maps)
        assert tuple(probe.mean.shape) == shape
        seen = maps if kind == "spatial" else maps.mean(1, keepdim=True)
        assert torch.allclose(((seen - probe.mean) / probe.std).std(0), torch.ones(shape), atol=1e-4)
    with pytest.raises(ValueError, match="kind is 'flat'; give one of pooled, spatial"):
        PairProbe("flat", 6, 8, {"turn": 4})
