"""What goes into a page, what it weighs, and that it stands alone."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.report import Options, write_report
from vusfa.report.content import gather, goal_limit
from vusfa.report.packing import unpack
from vusfa.report.page import as_json
from vusfa.report.run_scenes import open_scenes
from vusfa.report.runs import LoggedRun
from vusfa.scenes import Scene


def data_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, flags=re.DOTALL)
    return json.loads(data)


def test_the_page_stands_alone(page: Path):
    text = page.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    assert "{{" not in text.replace(data_block(text), "")[:2000]
    assert text.count("</script>") == 3 == text.count("<script")
    assert not re.findall(r"<(?:link|iframe|img)[^>]+(?:href|src)=", text)
    assert "default-src 'none'" in text
    assert "unsafe" not in text[: text.index("<title>")]
    assert "&lt;/script&gt;</title>" in text
    assert data_of(page)["title"] == "A <b>title</b> & </script>"


def data_block(text: str) -> str:
    return text[text.index('id="data">') :]


def test_what_it_holds(page: Path, runs: list[LoggedRun]):
    data = data_of(page)
    assert [model["label"] for model in data["models"]] == ["vusfa", "gvf"]
    assert [model["seeds"] for model in data["models"]] == [2, 1]
    assert [agent["name"] for agent in data["agents"]] == ["vusfa, seed 0", "gvf, seed 0"]
    assert set(data["goals"]) == set(data["scenes"]) == {"bathroom", "bedroom"}
    for name, goals in data["goals"].items():
        assert len(goals) == 8
        assert sorted(data["agents"][0]["trained"][name]) == goals[:5]
        view = data["agents"][0]["scenes"][name]
        count = data["scenes"][name]["states"]
        assert unpack(view["value"]).shape == (8, count)
        chances = unpack(view["probabilities"])
        assert abs(chances.sum(-1) - 1).max() < 1e-3
        assert view["walks"] is None  # the page walks itself: this agent sees one frame
        assert [len(starts) for starts in view["starts"]] == [2] * 8
        assert len(data["scenes"][name]["pictures"]["ids"]) == count
    episodes = runs[2].episodes
    assert episodes is not None
    (drawn,) = [row for row in data["maps"] if (row["model"], row["scene"]) == ("gvf", "bedroom")]
    bedroom = episodes.select(episodes.scene == 1)
    found = torch.full((404,), torch.nan).double()
    found[bedroom.goal] = bedroom.success.double()
    assert torch.equal(torch.from_numpy(unpack(drawn["success_20"])), found)


def test_the_tables_lie_beside_it(page: Path):
    names = {path.stem for path in (page.parent / "page_tables").iterdir()}
    assert names == {"summary", "seeds", "distance", "goals", "runs"}
    assert (page.parent / "page_tables" / "goals.csv").read_text().count("\n") == 1 + 2 * 580


def test_pictures_give_way_to_the_weight(runs: list[LoggedRun], tmp_path: Path):
    (page, *_), _ = write_report(
        runs[:1], tmp_path / "deep" / "small.html", Options(megabytes=5.5, goals_per_scene=4, walks=1)
    )
    assert page.stat().st_size <= 5.5e6
    held = [len(scene["pictures"]["ids"]) for scene in data_of(page)["scenes"].values()]
    assert 0 < sum(held) < 580
    assert data_of(page)["goals_limit"] == 4


def test_too_heavy_without_a_picture(runs: list[LoggedRun], tmp_path: Path):
    with pytest.raises(ConfigError, match=r"more than megabytes=1; give fewer goals_per_scene"):
        write_report(runs[:1], tmp_path / "page.html", Options(megabytes=1, goals_per_scene=1))
    assert not list(tmp_path.iterdir())


def test_goals_are_fewer_where_the_page_would_be_too_heavy():
    assert goal_limit([1000], 1, Options(goals_per_scene=10**6, megabytes=4)) == 150
    assert goal_limit([1000], 10, Options(megabytes=4)) == 15
    assert goal_limit([10**9], 1, Options()) == 1
    assert goal_limit([100, 1000], 1, Options(megabytes=2)) == 68  # 68 goals in both weigh 74,800 states
    assert goal_limit([100, 200], 1, Options()) == 200


def test_who_asks_for_too_many_goals_is_told(runs: list[LoggedRun]):
    lines: list[str] = []
    options = Options(goals_per_scene=99, megabytes=1, walks=1, max_steps=3, tell=lines.append)
    content, _ = gather(runs[:1], options)
    assert content["goals_limit"] == 64 < content["goals_asked"] == 99
    assert [len(goals) for goals in content["goals"].values()] == [64, 64]
    assert "the explorer has 64 goals per scene, to limit the size of the page" in lines


def test_every_seed_on_demand(runs: list[LoggedRun]):
    content, _ = gather(runs, Options(seeds=2, goals_per_scene=1, walks=1, max_steps=3))
    assert [agent["name"] for agent in content["agents"]] == ["vusfa, seed 0", "vusfa, seed 1", "gvf, seed 0"]


def test_without_checkpoints_and_without_evaluation(runs: list[LoggedRun], tmp_path: Path):
    bare = [dataclasses.replace(run, checkpoint=None, episodes=None, references=()) for run in runs]
    content, tables = gather(bare, Options())
    assert content["agents"] == []
    assert content["maps"] == []
    assert tables["summary"] == []
    assert len(content["curves"]) > 4
    (page, *_), _ = write_report(bare, tmp_path / "page.html")
    assert not any(scene["pictures"]["ids"] for scene in data_of(page)["scenes"].values())


def test_no_runs():
    with pytest.raises(ConfigError, match="at least one run"):
        gather([])


def test_two_scenes_of_one_name(make_scene, tmp_path: Path):
    runs = []
    for width in (2, 3):
        scene: Scene = make_scene("hall", width, 2)
        scene.save(tmp_path / f"{width}.h5")
        runs.append(LoggedRun("a", width, tmp_path / str(width), {"scenes": [str(tmp_path / f"{width}.h5")]}))
    with pytest.raises(ConfigError, match="different scenes called 'hall'"):
        open_scenes(runs)


def test_json_within_a_script():
    assert json.loads(as_json(["<!--", "</SCRIPT>", float("inf"), (1,)])) == ["<!--", "</SCRIPT>", None, [1]]
    assert "</" not in as_json("</SCRIPT>")
    assert "<!--" not in as_json("<!--")
