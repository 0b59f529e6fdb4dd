"""The film of a walk and the learning curve."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vusfa.errors import ConfigError
from vusfa.evaluation import Episodes, evaluate
from vusfa.report.curve import plot_curve, read_metrics
from vusfa.report.film import draw_film, longest_success, record_walk, write_gif
from vusfa.scenes import SceneSet


@pytest.fixture
def hall(scene_file: Path) -> SceneSet:
    return SceneSet.open([scene_file])


def test_the_guides_walk_is_a_shortest_path(hall: SceneSet, policies):
    trail = record_walk(policies["guide"](hall), hall, start=0, goal=14, history=1)
    assert trail[0] == 0
    assert trail[-1] == 14
    assert len(trail) == 1 + int(hall.distance(0, 14))
    assert all(b in hall.successor[a].tolist() for a, b in pairwise(trail))


def test_of_several_walks_the_shortest_is_kept_and_the_random_state_too(hall: SceneSet, policies):
    before = torch.get_rng_state()
    once, often = (
        len(record_walk(policies["dice"](), hall, 0, 14, attempts=n, max_steps=200, seed=3)) for n in (1, 40)
    )
    assert often < once
    assert torch.equal(torch.get_rng_state(), before)


def test_a_walk_that_never_arrives_ends_with_the_time(hall: SceneSet, policies):
    assert len(record_walk(policies["turner"](1), hall, 0, 14, attempts=2, max_steps=6)) == 7


def test_the_film_shows_view_goal_and_map(hall: SceneSet, tmp_path: Path):
    film = draw_film(hall, [0, 8, 11], goal=11, scale=1)
    width = 48 + 8 + 48 + 8 + 40
    assert [picture.size for picture in film] == [(width, 40 + 22)] * 3
    seen = torch.from_numpy(np.array(film[1].crop((0, 22, 48, 62))))
    assert torch.equal(seen, hall.pictures(8))
    path = write_gif(tmp_path / "walk.gif", film, frames_per_second=5)
    with Image.open(path) as gif:
        assert gif.n_frames == 3
        assert gif.info["duration"] == 200
        gif.seek(2)
        assert gif.info["duration"] == 1600
    assert list(tmp_path.glob("*.tmp")) == []


def test_a_scene_without_pictures_shows_its_map(rooms: SceneSet):
    (picture,) = draw_film(rooms, [0], goal=5, scale=1)
    assert picture.size == (150, 172)


def test_the_longest_success_is_filmed(rooms: SceneSet, guide):
    table = evaluate(guide, rooms, [3, 20, 30], episodes_per_goal=20, trained=torch.tensor([3]))
    start, goal = longest_success(table, rooms)
    assert goal == 3
    assert int(rooms.distance(start, goal)) == int(table.shortest[table.trained].max())
    lost = Episodes(**{**vars(table), "success": torch.zeros_like(table.success)})
    assert longest_success(lost, rooms) is None


def test_no_film_without_pictures():
    with pytest.raises(ValueError, match="at least one"):
        write_gif("never.gif", [])


def test_the_curve(tmp_path: Path):
    metrics = tmp_path / "metrics.csv"
    metrics.write_text("frames,success,length_ratio\n1000,,\n2000,0.5,4.0\n3000,1.0,1.5\n")
    assert read_metrics(metrics)["success"][1:].tolist() == [0.5, 1.0]
    with Image.open(plot_curve(metrics, tmp_path / "curve.png", random_walk=0.4, title="vusfa")) as picture:
        assert picture.format == "PNG"
        assert picture.width > 600
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    assert (0x1F, 0x61, 0xB6) in colours


def test_a_run_without_rows_has_no_curve(tmp_path: Path):
    with pytest.raises(ConfigError, match="no such file"):
        read_metrics(tmp_path / "metrics.csv")
    (tmp_path / "metrics.csv").write_text("frames,success\n")
    with pytest.raises(ConfigError, match="no rows yet"):
        plot_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
