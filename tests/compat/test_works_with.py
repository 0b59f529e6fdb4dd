"""Every piece of Python in docs/works_with.md runs as it stands, each after those before it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = (Path(__file__).parents[2] / "docs" / "works_with.md").read_text(encoding="utf-8")
PIECES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")  # of TorchRL's own Trainer
def test_every_piece_runs() -> None:
    torch.manual_seed(0)
    pieces = [piece for piece in PIECES if of_others(piece) is None]
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


def of_others(piece: str) -> str | None:
    """The library that a piece imports and that no extra installs."""
    return next(
        (name for name in ("minari", "ray") if re.search(rf"^(import|from) {name}\b", piece, re.M)), None
    )


@pytest.mark.filterwarnings("ignore:`.* is set to None:UserWarning")  # who made the data, says Minari
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it leaves a folder to Python
@pytest.mark.parametrize("library", ["minari", "ray"])
def test_pieces_with_other_libraries(library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (piece,) = (piece for piece in PIECES if of_others(piece) == library)
    pytest.importorskip({"ray": "ray.rllib.algorithms.ppo"}.get(library, library), exc_type=ImportError)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    names: dict[str, Any] = {}
    exec(compile(PIECES[0], "docs/works_with.md, first piece", "exec"), names)
    exec(compile(piece, f"docs/works_with.md, {library}", "exec"), names)
    if library == "minari":
        assert names["dataset"].total_episodes == 3
        (episode,) = names["dataset"].sample_episodes(1)
        assert episode.observations["observation"].shape == (len(episode.actions) + 1, 4, 1280)
        return
    import ray

    assert names["trained"]["env_runners"]["episode_len_mean"] <= 20
    ray.shutdown()
