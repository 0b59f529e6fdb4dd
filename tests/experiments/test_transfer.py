from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from vusfa.envs import resolve_goals
from vusfa.errors import GoalError
from vusfa.experiments.runs import Run
from vusfa.experiments.transfer import KINDS, area_under, frames_to, new_goals, walked_lengths
from vusfa.report.transfer_figure import difference_table, draw_transfer, mean_over, transfer_table
from vusfa.scenes import Scene, SceneSet


@pytest.mark.parametrize("kind", KINDS)
def test_new_goals_are_as_far_as_their_kind_says(kind: str) -> None:
    rooms = SceneSet.bundled()
    trained = resolve_goals(rooms, "paper")
    sets = [new_goals(rooms, trained, kind, index) for index in range(5)]
    for goals in sets:
        assert rooms.scene_id[goals].bincount().tolist() == [5, 5, 5, 5]
        for goal in goals:
            here = trained[rooms.scene_id[trained] == rooms.scene_id[goal]]
            nearest = min(int(rooms.distance(goal, other)) for other in here)
            assert nearest == KINDS[kind] if KINDS[kind] else nearest > 0
    assert len({tuple(goals.tolist()) for goals in sets}) == 5
    assert torch.equal(new_goals(rooms, trained, kind, 3), sets[3])
    assert not torch.equal(new_goals(rooms, trained, kind, 3, seed=1), sets[3])


def test_scenes_without_trained_goals_get_none(make_scene: Callable[..., Scene]) -> None:
    rooms = SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])
    goals = new_goals(rooms, torch.tensor([17]), "random", 0, per_scene=4)
    assert len(goals) == 4
    assert bool((goals >= 16).all())
    assert 17 not in goals


def test_what_cannot_be_drawn(make_scene: Callable[..., Scene]) -> None:
    rooms = SceneSet([make_scene("hall")])
    with pytest.raises(GoalError, match="'3-steps'; give one of 1-step"):
        new_goals(rooms, torch.tensor([0]), "3-steps", 0)
    with pytest.raises(GoalError, match="scene 'hall' has 15 states of the kind 'random'; 16 are wanted"):
        new_goals(rooms, torch.tensor([0]), "random", 0, per_scene=16)


def test_area_by_hand() -> None:
    assert area_under([0, 100, 400], [500, 100, 20]) == pytest.approx((100 * 300 + 300 * 60) / 400)
    with pytest.raises(ValueError, match="two points"):
        area_under([0], [3.0])


def test_frames_to_by_hand() -> None:
    frames, values = [0, 100, 200, 300], [500.0, 100.0, 40.0, 60.0]
    assert frames_to(frames, values, 50) == pytest.approx(100 + 100 * 50 / 60)
    assert frames_to(frames, values, 500) == 0
    assert math.isnan(frames_to(frames, values, 39))


def test_mean_over_leaves_out_what_never_came_there() -> None:
    estimate = mean_over([[1.0, math.nan], [3.0, 5.0]])
    assert estimate.value == pytest.approx(3.0)
    assert 1.0 <= estimate.low <= 3.0 <= estimate.high <= 5.0


def cell(model: str, seed: int, lengths: list[list[float]]) -> Run:
    curves = [
        {
            "trained on": {"frames": [0, 100, 200], "length": row},
            "from scratch": {"frames": [0, 100, 200], "length": [500.0, 500.0, 500.0]},
        }
        for row in lengths
    ]
    info = {"model": model, "seed": seed, "kind": "1-step", "curves": curves}
    return Run("transfer", f"{model}-{seed}", info, {})


def test_the_table_by_hand() -> None:
    cells = [cell("gvf", 0, [[100, 50, 10], [100, 60, 20]]), cell("gvf", 1, [[100, 70, 30], [100, 80, 40]])]
    lines = transfer_table(cells, threshold=55).splitlines()
    assert len(lines) == 4
    row = [part.strip() for part in lines[2].split("|")[1:-1]]
    assert row[:4] == ["1-step", "gvf", "fine-tuned", "2"]
    assert row[4].split(" ")[0] == f"{(52.5 + 60 + 67.5 + 75) / 4:.1f}"
    assert row[5] == "100.0 [100.0, 100.0]"
    assert row[6].split(" ")[0] == "25.0"
    assert row[7].split(" ")[0] == f"{(90 + 112.5 + 137.5 + 162.5) / 4:,.0f}"
    assert row[8] == "4 of 4"
    assert lines[3].split("|")[8:10] == [" – ", " 0 of 4 "]


def test_the_picture(tmp_path: Path) -> None:
    path = draw_transfer(
        [cell("gvf", 0, [[100, 50, 10]]), cell("vusfa", 0, [[90, 40, 9]])], tmp_path / "a.png"
    )
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.png"]


def test_walked_lengths_against_episodes_that_are_walked(make_scene: Callable[..., Scene]) -> None:
    rooms, goals = SceneSet([make_scene("hall"), make_scene("attic", 3, 1)]), torch.tensor([2, 17, 20])
    generator, lengths, paths = torch.Generator().manual_seed(0), [], []
    for goal in goals.tolist():
        states = (rooms.scene_id == rooms.scene_id[goal]).nonzero().squeeze(-1)
        starts = states[states != goal].repeat(300)
        here, steps = starts.clone(), torch.zeros(len(starts))
        for _ in range(40):
            away = here != goal
            steps += away
            actions = torch.randint(rooms.num_actions, here.shape, generator=generator)
            here = torch.where(away, rooms.successor[here, actions], here)
        lengths.append(steps.mean().item())
        paths.append(sum(int(rooms.distance(s, goal)) for s in states[states != goal]) / (len(states) - 1))
    walk, shortest = walked_lengths(rooms, goals, max_steps=40)
    assert walk == pytest.approx(sum(lengths) / 3, rel=0.03)
    assert shortest == pytest.approx(sum(paths) / 3)


def test_floor_and_ceiling_stand_below_the_models() -> None:
    made = [cell("gvf", 0, [[8.0, 6.0, 4.0]]), cell("gvf", 1, [[8.0, 6.0, 4.0]])]
    lines = transfer_table(made, 5.0, {"1-step": [(300.0, 10.0), (320.0, 14.0)]}).splitlines()
    assert lines[-2].startswith("| 1-step | random walk | – | – | 310.0 [")
    assert lines[-1].startswith("| 1-step | shortest path | – | – | 12.0 [")


def test_differences_by_hand() -> None:
    """Areas of gvf: 55 and 62.5 with seed 0, 70 with seed 1; of usfa 10 less each, and nothing of seed 1."""
    gvf = [cell("gvf", 0, [[100, 50, 20], [100, 60, 30]]), cell("gvf", 1, [[100, 70, 40], [100, 70, 40]])]
    usfa = [cell("usfa", 0, [[90, 40, 10], [90, 50, 20]])]
    rows = [
        [part.strip() for part in line.split("|")[1:-1]]
        for line in difference_table([*gvf, *usfa]).splitlines()
    ]
    assert rows[2][:4] == ["1-step", "gvf", "from scratch", "2"]
    assert rows[2][4].split(" ")[0] == f"{(55 + 62.5 + 70 + 70) / 4 - 500:.1f}"
    assert rows[3][:4] == ["1-step", "usfa", "from scratch", "1"]
    assert rows[4] == ["1-step", "usfa", "gvf", "1", "-10.0 [-10.0, -10.0]"]
    assert len(rows) == 5
