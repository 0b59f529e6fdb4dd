"""Packed numbers come back within half a level."""

from __future__ import annotations

import numpy as np
import pytest

from vusfa.report.packing import pack, pack_ids, unpack


@pytest.mark.parametrize(("kind", "levels"), [("u8", 254), ("u16", 65534)])
def test_within_half_a_level(kind: str, levels: int):
    values = np.random.default_rng(0).normal(size=(7, 11)) * 30
    packed = pack(values, kind)
    found = unpack(packed)
    assert found.shape == (7, 11)
    half = (values.max() - values.min()) / levels / 2
    assert np.abs(found - values).max() <= half * 1.0001
    assert np.abs(found - values).max() > half / 10  # it is rounded
    assert found.min() == values.min()
    assert found.max() == pytest.approx(values.max())


@pytest.mark.parametrize("kind", ["u8", "u16"])
def test_no_number_stays_none_and_ends_hold(kind: str):
    found = unpack(pack([np.nan, -5.0, 0.5, 5.0, np.inf], kind, 0.0, 1.0))
    assert np.isnan(found[[0, 4]]).all()
    assert found[1] == 0.0
    assert found[2] == pytest.approx(0.5)
    assert found[3] == 1.0


def test_all_alike_and_none_at_all():
    assert unpack(pack([3.0, 3.0])).tolist() == [3.0, 3.0]
    assert np.isnan(unpack(pack([np.nan]))).all()
    assert unpack(pack(np.zeros((0, 3)))).shape == (0, 3)


def test_ids():
    assert unpack(pack_ids([[0, 65535]])).tolist() == [[0, 65535]]
    for wrong in ([-1], [65536]):
        with pytest.raises(ValueError, match="ids must lie in"):
            pack_ids(wrong)
