"""Summaries against hand-computed numbers; the files and the terminal."""

from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path

import pytest
import torch
from rich.console import Console

from vusfa.evaluation import (
    Episodes,
    compare,
    print_summary,
    random_walk,
    random_walk_summary,
    shortest_paths,
    summary,
)
from vusfa.evaluation.long_table import MEAN_OF_SCENES, MEAN_OF_STATES
from vusfa.evaluation.summary import count_pairs
from vusfa.scenes import SceneSet


@pytest.fixture
def episodes() -> Episodes:
    """Two goals in the hall (one trained), one in the attic (trained); two episodes each."""
    return Episodes(
        scene=torch.tensor([0, 0, 0, 0, 1, 1]),
        goal=torch.tensor([3, 3, 5, 5, 9, 9]),
        start=torch.tensor([0, 1, 2, 3, 4, 5]),
        success=torch.tensor([True, True, False, True, True, False]),
        length=torch.tensor([4, 150, 500, 20, 90, 500]),
        shortest=torch.tensor([4, 50, 10, 10, 30, 30]),
        collisions=torch.tensor([0, 10, 300, 2, 8, 0]),
        trained=torch.tensor([True, True, False, False, True, True]),
        scene_names=("hall", "attic"),
        max_steps=500,
    )


def find(rows, goals: str, scene: str) -> dict:
    (row,) = [row for row in rows if (row["goals"], row["scene"]) == (goals, scene)]
    return row


def test_hand_computed(episodes: Episodes):
    rows = summary(episodes, "walker")
    hall = find(rows, "all", "hall")
    assert (hall["num_goals"], hall["num_episodes"]) == (2, 4)
    assert (hall["success_500"], hall["success_100"]) == (0.75, 0.5)
    assert hall["spl"] == pytest.approx((1 + 1 / 3 + 0 + 0.5) / 4)
    assert hall["length"] == pytest.approx(174 / 3)
    assert hall["length_ratio"] == pytest.approx(174 / 64)
    assert hall["collisions"] == 78.0
    trained = find(rows, "trained", "hall")
    assert (trained["success_500"], trained["success_100"], trained["num_goals"]) == (1.0, 0.5, 1)
    assert find(rows, "unseen", "hall")["success_500"] == 0.5


def test_both_averages(episodes: Episodes):
    rows = summary(episodes, "walker")
    assert find(rows, "all", MEAN_OF_SCENES)["success_500"] == pytest.approx((0.75 + 0.5) / 2)
    assert find(rows, "all", MEAN_OF_STATES)["success_500"] == pytest.approx((2 * 0.75 + 0.5) / 3)
    assert find(rows, "all", MEAN_OF_STATES)["num_goals"] == 3
    # the attic has no unseen goal, so there is one scene and nothing to average
    assert [row["scene"] for row in rows if row["goals"] == "unseen"] == ["hall"]


def test_the_papers_table_has_both_averages():
    # Table 1 of the paper: GVF 15.04 is the mean of scenes, 14.59 that of states.
    states, percent = [180, 408, 676, 468], [14.22, 17.84, 10.92, 17.20]
    scene = torch.repeat_interleave(torch.arange(4), torch.tensor(states))
    goal = torch.cat([torch.arange(n) for n in states]).repeat_interleave(10)
    scene = scene.repeat_interleave(10)
    success = torch.cat(
        [torch.arange(10 * n) < p / 100 * 10 * n for n, p in zip(states, percent, strict=True)]
    )
    one = torch.ones_like(scene)
    table = Episodes(scene, goal, one, success, one, one, one, one < 0, tuple("abcd"), 500)
    rows = summary(table, "gvf")
    assert 100 * find(rows, "all", MEAN_OF_SCENES)["success_500"] == pytest.approx(15.04, abs=0.02)
    assert 100 * find(rows, "all", MEAN_OF_STATES)["success_500"] == pytest.approx(14.59, abs=0.02)


def test_an_average_leaves_out_what_has_no_number(episodes: Episodes):
    lost = episodes.select(torch.tensor([True, True, True, True, False, True]))
    rows = summary(lost, "walker")
    assert math.isnan(find(rows, "all", "attic")["length_ratio"])
    assert find(rows, "all", MEAN_OF_STATES)["length_ratio"] == find(rows, "all", "hall")["length_ratio"]


def test_limits_above_the_episodes_own_are_left_out(episodes: Episodes):
    rows = summary(episodes, "walker", within=(1000, 20))
    assert [key for key in rows[0] if key.startswith("success")] == ["success_500", "success_20"]


def test_shortest_paths_are_the_ceiling(episodes: Episodes):
    best = find(summary(shortest_paths(episodes), "best", within=(500, 20)), "all", "hall")
    assert (best["success_500"], best["success_20"], best["spl"], best["length_ratio"]) == (
        1.0,
        0.75,
        1.0,
        1.0,
    )
    assert best["collisions"] == 0.0


def test_random_walk_rows_are_exact_means(rooms: SceneSet):
    rows = random_walk_summary(rooms, torch.arange(40), torch.tensor([2, 20]), max_steps=50, within=(50, 10))
    hall = random_walk(rooms.scenes[0], torch.arange(16), 50)
    attic = random_walk(rooms.scenes[1], torch.arange(24), 50)
    assert find(rows, "all", "hall")["success_50"] == pytest.approx(hall.mean().item())
    assert find(rows, "trained", "attic")["success_50"] == pytest.approx(attic[4].item())
    assert find(rows, "all", MEAN_OF_STATES)["success_50"] == pytest.approx(
        torch.cat([hall, attic]).mean().item()
    )
    assert find(rows, "all", "hall")["success_10"] < find(rows, "all", "hall")["success_50"]
    assert math.isnan(find(rows, "all", "hall")["spl"])


def test_unreachable_goals_are_left_out_or_failures(island: SceneSet):
    everything, nothing = torch.arange(5), torch.tensor([], dtype=torch.int64)
    skipped = find(random_walk_summary(island, everything, nothing, 50), "all", "trap")
    failed = find(random_walk_summary(island, everything, nothing, 50, unreachable="fail"), "all", "trap")
    assert (skipped["num_goals"], failed["num_goals"]) == (4, 5)
    exact = random_walk(island.scenes[0], torch.tensor([0]), 50)
    # state 0 is reached from 1, 2 and 4, not from the trap 3
    assert random_walk(island.scenes[0], torch.tensor([0]), 50, "fail").item() == pytest.approx(
        exact.item() * 3 / 4
    )
    lost = int((island.scenes[0].distance < 0).sum())
    assert f"{lost} in trap; no episode starts" in count_pairs(island.scenes, "skip")
    assert f"{lost} in trap; such pairs are drawn" in count_pairs(island.scenes, "fail")


def test_compare_puts_everything_side_by_side(rooms: SceneSet, policies, tmp_path: Path):
    told = []
    result = compare(
        {"guide": policies["guide"](rooms), "dice": policies["dice"]()},
        rooms,
        "all",
        trained=torch.tensor([3, 20]),
        within=(40, 5),
        progress=lambda *news: told.append(news),
        episodes_per_goal=2,
        max_steps=40,
    )
    names = list(dict.fromkeys(row["policy"] for row in result.rows))
    assert names == ["guide", "dice", "random walk", "shortest path"]
    assert {name for name, *_ in told} == {"guide", "dice"}
    table, content, episodes = result.save(tmp_path / "runs" / "zero_shot")
    with open(table, newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.rows) == 4 * 3 * 4
    assert rows[0]["policy"] == "guide"
    assert float(rows[0]["success_40"]) == float(rows[0]["soft_spl"]) == 1.0
    read = json.loads(content.read_text())
    assert read["settings"]["episodes_per_goal"] == 2
    assert read["settings"]["scenes"] == ["hall", "attic"]
    assert read["rows"][-1]["spl"] == 1.0
    assert {row["spl"] for row in read["rows"] if row["policy"] == "random walk"} == {None}
    with open(episodes, newline="") as file:
        walked = list(csv.DictReader(file))
    assert len(walked) == 80
    assert walked[0].keys() == {
        "scene",
        "goal",
        "start",
        "success",
        "length",
        "shortest",
        "collisions",
        "trained",
        "remaining",
    }
    assert {row["trained"] for row in walked} == {"0", "1"}


def test_the_table_fits_a_terminal(episodes: Episodes):
    page = io.StringIO()
    rows = summary(episodes, "walker") + summary(shortest_paths(episodes), "shortest path")
    print_summary(rows, Console(file=page, width=80), note="a note")
    text = page.getvalue()
    assert "…" not in text
    assert text.index("trained goals") < text.index("unseen goals") < text.index("all goals")
    (line,) = [line for line in text.splitlines() if "hall" in line and "58.00" in line]
    assert [part for part in line.split() if part != "–"] == [
        "hall",
        "walker",
        "75.0",
        "50.0",
        "45.8",
        "58.00",
        "2.72",
        "78.0",
    ]
    assert "a note" in text


@pytest.mark.parametrize("policy", ["vusfa + replay search", "vusfa, fine-tuned for the kitchen"])
def test_a_long_name_breaks_and_numbers_do_not(episodes: Episodes, policy: str):
    page = io.StringIO()
    rows = summary(episodes, policy) + summary(shortest_paths(episodes), "shortest path")
    print_summary(rows, Console(file=page, width=72))
    assert "…" not in page.getvalue()
    assert page.getvalue().count("100.0") >= 9


def test_the_table_does_not_repeat_itself(episodes: Episodes):
    page = io.StringIO()
    print_summary(summary(episodes.select(episodes.trained), "walker"), Console(file=page, width=80))
    assert "trained goals" in page.getvalue()
    assert "all goals" not in page.getvalue()


def test_columns_must_agree(episodes: Episodes):
    with pytest.raises(ValueError, match="columns"):
        Episodes(**{**vars(episodes), "length": torch.tensor([1])})


def test_names_are_neither_markup_nor_commands_to_the_terminal(episodes: Episodes):
    page = io.StringIO()
    renamed = Episodes(**{**vars(episodes), "scene_names": ("[red]hall[/nothing]", "attic\x1b[2J")})
    print_summary(summary(renamed, "[link=x]walker"), Console(file=page, width=200), note="[bold]\x07")
    for text in ("[red]hall[/nothing]", "attic\\x1b[2J", "[link=x]walker", "[bold]\\x07"):
        assert text in page.getvalue()
