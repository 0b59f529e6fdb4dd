"""What is asked about pairs, and probes of rooms whose features say where the agent is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.evaluation.long_table import DISTANCE_BINS
from vusfa.experiments.recognition import Pairs, feature_maps, recognition, scores
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.views import places_in_view


def test_what_is_asked_of_every_pair_in_plain_python(make_scene: Callable[..., Scene]) -> None:
    """States are 4 * place + heading, places in rows of three, half a metre apart."""
    room = make_scene("hall", 3, 2)
    size = room.num_states
    first, second = (part.reshape(-1) for part in torch.meshgrid(*[torch.arange(size)] * 2, indexing="ij"))
    asked = Pairs(room).asked(first, second)
    view = places_in_view(room)
    forward = [(0, 1), (1, 0), (0, -1), (-1, 0)]
    for row, (one, other) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        away = int(room.distance[one, other])
        heading = one % 4
        x, z = (other // 4 % 3 - one // 4 % 3) / 2, (other // 4 // 3 - one // 4 // 3) / 2
        ahead = x * forward[heading][0] + z * forward[heading][1]
        right = x * forward[(heading + 1) % 4][0] + z * forward[(heading + 1) % 4][1]
        assert asked["place"][row].tolist() == pytest.approx([right, ahead], abs=1e-6)
        assert asked["turn"][row] == (other % 4 - heading) % 4
        assert asked["view"][row] == view[one, other]
        assert DISTANCE_BINS[asked["distance"][row]] <= away
        assert (
            asked["distance"][row] == len(DISTANCE_BINS) - 1
            or away < DISTANCE_BINS[asked["distance"][row] + 1]
        )
        best = [to >= 0 and int(room.distance[to, other]) == away - 1 for to in room.graph[one].tolist()]
        assert asked["action"][row].tolist() == best


def test_scores_by_hand() -> None:
    asked = {
        "turn": torch.tensor([1, 0, 2]),
        "action": torch.tensor([[True, True, False], [False, False, True], [False] * 3]),
        "place": torch.tensor([[0.0, 0.0], [1.0, 1.0], [0.0, 2.0]]),
    }
    answers = {
        "turn": torch.tensor([[0.0, 9, 0], [0, 9, 0], [0, 0, 9]]),
        "action": torch.tensor([[0.0, 9, 0], [0, 9, 0], [0, 9, 0]]),
        "place": torch.tensor([[3.0, 4.0], [1.0, 1.0], [0.0, 0.0]]),
    }
    found = scores(answers, asked)
    assert found["turn"].tolist() == [1, 0, 1]
    assert found["action"].tolist() == pytest.approx([1, 0, float("nan")], nan_ok=True)
    assert found["place"].tolist() == [5, 0, 2]


def test_maps_are_channels_times_rows_times_columns(make_scene: Callable[..., Scene]) -> None:
    room = make_scene("hall", 2, 2, features=12)
    room.attributes["feature_grid"] = "2x3"
    maps = feature_maps(SceneSet([room]))
    assert maps.shape == (room.num_states, 6, 2)
    assert torch.equal(maps[:, 4, 1], room.features[:, 0, 1 * 6 + 4])
    for grid in ("5x1", "x", "2x3x4"):
        room.attributes["feature_grid"] = grid
        with pytest.raises(ConfigError, match="12 features on grids of"):
            feature_maps(SceneSet([room]))


@pytest.fixture
def rooms(make_scene: Callable[..., Scene], tmp_path: Path) -> Path:
    """Six rooms whose features are the pose: two channels are the place, the third has one part per heading,
    of which the mean says nothing."""
    for number, (width, height) in enumerate([(2, 2), (3, 2), (2, 3), (3, 3), (2, 3), (3, 2)], 1):
        room = make_scene("hall", width, height)
        pose = torch.zeros(room.num_states, 3, 4)
        pose[:, 0] = room.location[:, :1]
        pose[:, 1] = room.location[:, 1:]
        pose[torch.arange(room.num_states), 2, torch.arange(room.num_states) % 4] = 1
        Scene(
            f"hall-{number}",
            room.graph,
            pose.flatten(1)[:, None],
            room.location,
            room.rotation,
            attributes={"feature_grid": "2x2"},
        ).save(tmp_path / f"hall-{number}.h5")
    return tmp_path


def test_probes_find_the_way_in_rooms_never_seen(
    rooms: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.experiments.recognition.TESTED", 200)
    asked: dict[str, Any] = {"trained": 4, "tested": 2, "batch": 64, "hidden_size": 16, "lr": 1e-2}
    recognition(rooms, **asked, steps=80)
    printed = capsys.readouterr().out
    lines = [line.split("|")[1:-1] for line in printed.splitlines() if line.startswith("|")]
    head = [word.strip() for word in lines[0]]
    assert head == ["probe", "pairs", "distance", "turn", "in view", "action", "place, m"]
    table = {tuple(word.strip() for word in line[:2]): line[2:] for line in lines[2:]}
    assert list(table) == [(k, p) for k in ("constant", "pooled", "spatial") for p in ("all", "in view")]
    turn, view, action = (
        {kind: float(table[kind, "all"][column].split()[0]) for kind in ("constant", "pooled", "spatial")}
        for column in (1, 2, 3)
    )
    assert turn["spatial"] > 45 > 35 > turn["pooled"], printed
    assert view["spatial"] > 90 > 80 > view["pooled"], printed
    assert action["spatial"] > 80 > 60 > action["constant"], printed


def test_what_cannot_be_probed(rooms: Path, make_scene: Callable[..., Scene], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"kinds is \['flat'\]"):
        recognition(rooms, kinds=["flat"])
    pooled = tmp_path / "pooled"
    pooled.mkdir()
    for name in ("hall-1", "hall-2"):
        make_scene(name, 2, 2).save(pooled / f"{name}.h5")
    with pytest.raises(ConfigError, match=r"pooled features, no maps; give kinds=\[pooled\]"):
        recognition(pooled, trained=1, tested=1)
