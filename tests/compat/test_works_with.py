"""Every piece of Python in docs/works_with.md runs as it stands, each after those before it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = (Path(__file__).parents[2] / "docs" / "works_with.md").read_text(encoding="utf-8")


@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")  # of TorchRL's own Trainer
def test_every_piece_runs() -> None:
    torch.manual_seed(0)
    pieces = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(pieces) > 12
    names: dict[str, Any] = {}
    for number, piece in enumerate(pieces):
        exec(compile(piece, f"docs/works_with.md, piece {number}", "exec"), names)
    assert all(bool(value.isfinite().all()) for value in names["terms"].values())
    assert names["advantage"].isfinite().all()
    assert names["data"]["next", "done"].any()
    assert len(names["buffer"]) == 192
    assert names["wrapped"].shape == (4, 10)
    assert names["learner"].num_timesteps >= 36


def test_what_is_not_installed_is_not_promised() -> None:
    (line,) = (line for line in PAGE.splitlines() if "RLlib" in line)
    assert "not tested" in line
