"""vusfa scenes render, without a renderer."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest

from vusfa.cluster.cells import LAUNCHERS
from vusfa.errors import SceneError
from vusfa.scenes import Scene
from vusfa.scenes.provenance import Provenance
from vusfa.sources.capture import PoseGraph, capture
from vusfa.sources.render import VARIATIONS, Rendered, Variation, layout, load_plan, room, save_plan
from vusfa.sources.render.backend import Backend


def test_plan_only_writes_the_plan_that_the_seed_draws(run: Callable[..., Any], tmp_path: Path) -> None:
    target = tmp_path / "bath.yaml"
    result = run("render", "--kind", "bathroom", "--seed", 2, "--plan-only", "-o", target)
    assert result.exit_code == 0
    assert load_plan(target) == layout("bathroom", 2)
    assert "176 states, 44 places" in result.stdout


def test_a_plan_or_a_kind_must_be_given(run: Callable[..., Any], tmp_path: Path) -> None:
    for options in ([], ["--kind", "hall", "--plan", "x.yaml"]):
        result = run("render", *options)
        assert result.exit_code == 1
        assert "--plan FILE, --kind KIND or --flat KIND,KIND" in result.stderr
    save_plan(layout("bathroom", 2), tmp_path / "x.yaml")
    result = run("render", "--plan", tmp_path / "x.yaml", "--cells", 40, "-o", tmp_path / "x.h5")
    assert "--cells belongs to --kind and --flat" in result.stderr
    assert "no kind of room is called 'attic'" in run("render", "--kind", "attic").stderr


def test_a_flat_is_one_plan(run: Callable[..., Any], tmp_path: Path) -> None:
    target = tmp_path / "flat.yaml"
    options = ["--flat", "bathroom, hall", "--cells", 60, "--plan-only", "-o", target]
    assert run("render", *options).exit_code == 0
    assert load_plan(target).kind == "flat: bathroom, hall"


def test_nothing_is_replaced_without_force(run: Callable[..., Any], tmp_path: Path) -> None:
    target = tmp_path / "hall.yaml"
    target.write_text("mine")
    options = ["--kind", "hall", "--cells", 30, "--seed", 1, "--plan-only", "-o", target]
    result = run("render", *options)
    assert result.exit_code == 1
    assert "exists" in result.stderr
    assert target.read_text() == "mine"
    assert run("render", *options, "--force").exit_code == 0
    assert load_plan(target).kind == "hall"


def test_the_renderer_gets_the_plan_and_its_progress_is_told(
    run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = layout("bathroom", 2)
    save_plan(plan, tmp_path / "bath.yaml")
    given = {}

    def render(plan: Any, out: Path, progress: Any, **options: Any) -> Rendered:
        given.update(plan=plan, out=out, **options)
        options["say"]("rendering with chalk")
        for done in range(3):
            progress("frames", done, 2)
        for done in (1, 2):
            progress("features", done, 2)
        return Rendered(out, 2, "chalk", 0.25, 0.5)

    monkeypatch.setattr(room, "render_room", render)
    monkeypatch.setattr("vusfa.sources.backbones.load_backbone", lambda name, weights: (name, weights))
    monkeypatch.setattr("vusfa.cli.progress._BRIEF", 0.0, raising=False)
    result = run("render", "--plan", tmp_path / "bath.yaml", "-o", tmp_path / "bath.h5", "--threads", 1)
    assert result.exit_code == 0, result.stderr
    assert (given["threads"], given["backend"]) == (1, None)
    assert given["plan"] == plan
    assert given["out"] == tmp_path / "bath.h5"
    assert given["backbone"] == ("efficientnet-lite0", None)
    assert "rendering with chalk" in result.stderr
    assert "2 of 2 frames" in result.stderr
    assert "0.25 s per frame; 50.0 % of them look like another state" in result.stdout
    run("render", "--plan", tmp_path / "bath.yaml", "-o", tmp_path / "bath.h5", "--scalar")
    assert given["backend"] == Backend("scalar_rgb")
    assert given["variation"] == Variation()
    cheap = ["--width", 100, "--samples", 2, "--vary", "dimmer"]
    assert run("render", "--plan", tmp_path / "bath.yaml", "-o", tmp_path / "bath.h5", *cheap).exit_code == 0
    assert (given["plan"].camera.resolution, given["plan"].camera.samples) == ((100, 75), 2)
    assert given["variation"] == VARIATIONS["dimmer"]


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Variation]]:
    """Names and variations of rooms that were rendered; seed 2 is dark when it is rendered first."""
    made: list[tuple[str, Variation]] = []

    def render(plan: Any, out: Path, *, variation: Variation, **options: Any) -> Rendered:
        made.append((f"{plan.name}-{plan.seed}", variation))
        if plan.seed == 2 and sum(name == made[-1][0] for name, _ in made) == 1:
            raise SceneError("the room is dark")
        corridor = PoseGraph(np.array([[1], [0]]), np.array([[0, 0], [0, 1.0]]), np.zeros(2), ("forward",))
        grey = np.full((2, 24, 32, 3), 128, np.uint8)
        capture(out, plan.name, corridor, grey, Provenance(), features=np.eye(2)[:, None])
        return Rendered(out, 2, "chalk", 0.25, 0.5)

    monkeypatch.setattr(room, "render_room", render)
    monkeypatch.setattr("vusfa.sources.backbones.load_backbone", lambda name, weights: (name, weights))
    return made


def test_many_rooms_fill_a_folder_and_a_second_run_does_the_rest(
    run: Callable[..., Any], tmp_path: Path, painted: list[tuple[str, Variation]]
) -> None:
    words = ["render-rooms", tmp_path / "rooms", "kind=[bathroom]", "seeds=[1-2,5]", "cells=20"]
    result = run(*words)
    assert result.exit_code == 1
    assert "1 of 3 rooms could not be rendered" in result.stderr
    assert "bathroom-2.h5: the room is dark" in result.stderr
    assert sorted(path.name for path in (tmp_path / "rooms").iterdir()) == ["bathroom-1.h5", "bathroom-5.h5"]
    assert Scene.load(tmp_path / "rooms" / "bathroom-1.h5").num_states == 2
    result = run(*words)
    assert result.exit_code == 0, result.stderr
    assert "2 of 3 files are there already" in result.stderr
    assert [name for name, _ in painted] == [f"bathroom-{seed}" for seed in (1, 2, 5, 2)]


SPLIT = """\
kinds: [bathroom, hall]
parts: {train: {seeds: [1, 1], cells: 20}, test: {seeds: [3, 3], cells: 20}}
width: 96
samples: 1
layer: _blocks.14
grid: 3x4
"""


def test_the_rooms_of_a_split(
    run: Callable[..., Any],
    tmp_path: Path,
    painted: list[tuple[str, Variation]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Small pictures, which are not kept; the split is written beside the rooms."""
    network: dict[str, Any] = {}
    monkeypatch.setattr("vusfa.sources.backbones.load_backbone", lambda **how: network.update(how))
    cameras = []
    monkeypatch.setattr("vusfa.cli.render_rooms.with_camera", lambda plan, *how: cameras.append(how) or plan)
    (tmp_path / "two.yaml").write_text(SPLIT)
    result = run("render-rooms", tmp_path / "rooms", f"split={tmp_path / 'two.yaml'}")
    assert result.exit_code == 0, result.stderr
    assert [name for name, _ in painted] == ["bathroom-1", "hall-1", "bathroom-3", "hall-3"]
    assert cameras == [(96, 1)] * 4
    assert network["layer"] == "_blocks.14"
    assert network["grid"] == (3, 4)
    names = ["bathroom-1.h5", "bathroom-3.h5", "hall-1.h5", "hall-3.h5", "split.yaml"]
    assert sorted(path.name for path in (tmp_path / "rooms").iterdir()) == names
    assert not Scene.load(tmp_path / "rooms" / "hall-1.h5").has_pictures
    again = run("render-rooms", tmp_path / "rooms", f"split={tmp_path / 'rooms' / 'split.yaml'}")
    assert "4 of 4 files are there already" in again.stderr
    for word in ("cells=20", "width=100", "vary=[dimmer]"):
        refused = run("render-rooms", tmp_path / "rooms", "split=unseen", word)
        assert "leave these, plan and vary out" in refused.stderr
    few = ["render-rooms", tmp_path / "few", f"split={tmp_path / 'two.yaml'}"]
    assert run(*few, "seeds=2-9", "kind=[hall]").exit_code == 0
    assert [path.name for path in (tmp_path / "few").glob("*.h5")] == ["hall-3.h5"]
    assert "two.yaml: has no room of kind None and seeds ['2']" in run(*few, "seeds=2").stderr
    assert "two.yaml: has no room of kind ['cellar']" in run(*few, "kind=[cellar]").stderr
    assert "is another split" in run("render-rooms", tmp_path / "rooms", "split=unseen").stderr


def test_a_launcher_renders_rooms(
    run: Callable[..., Any],
    tmp_path: Path,
    painted: list[tuple[str, Variation]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def travel(jobs: Any, options: Any) -> None:
        for job in jobs:
            pickle.loads(cloudpickle.dumps(job))()

    monkeypatch.setitem(LAUNCHERS, "travel", travel)
    words = ["render-rooms", tmp_path / "rooms", "kind=[bathroom]", "seeds=[1,5]", "cells=20"]
    result = run(*words, "launcher=travel")
    assert result.exit_code == 0, result.stderr
    assert [name for name, _ in painted] == ["bathroom-1", "bathroom-5"]
    assert sorted(path.name for path in (tmp_path / "rooms").iterdir()) == ["bathroom-1.h5", "bathroom-5.h5"]
    (tmp_path / "rooms" / "bathroom-1.h5").unlink()
    assert "no such launcher" in run(*words, "launcher=rai").stderr


def test_every_change_of_a_room_has_its_folder(
    run: Callable[..., Any], tmp_path: Path, painted: list[tuple[str, Variation]]
) -> None:
    result = run("render-rooms", tmp_path, "plan=[bathroom,kitchen]", "vary=[dimmer,blur]")
    assert result.exit_code == 0, result.stderr
    files = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.glob("*/*"))
    assert files == [
        f"{change}/{name}.h5" for change in ("blur", "dimmer") for name in ("bathroom", "kitchen")
    ]
    assert {variation for _, variation in painted} == {VARIATIONS["dimmer"], VARIATIONS["blur"]}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], r"plan=\[FILE,...\], or kind="),
        (["plan=[bathroom]", "kind=[hall]"], r"plan=\[FILE,...\], or kind="),
        (["plan=[bathroom]", "seeds=1-2"], "seeds and cells belong to kind"),
        (["kind=[hall]", "seeds=1-x"], "'1-x' is neither a number nor a range"),
        (["kind=[hall]", "seeds=9-2"], "'9-2' must go upward"),
        (["kind=[hall]", "seeds=0-999999999"], "at most 100,000 seeds"),
        (["kind=[hall]", "vary=[darker]"], "darker: .* one of noise, brighter"),
        (["kind=[attic]"], "no kind of room is called 'attic'"),
        (["plan=[attic]"], "attic: cannot be read"),
        (["plan=[bathroom,x/bathroom]"], "two plans have one name"),
        (["kind=[hall]", "vary=[blur,blur]"], "two changes have one name"),
    ],
)
def test_what_cannot_be_made_is_said_before_anything_is(
    run: Callable[..., Any],
    tmp_path: Path,
    painted: list[tuple[str, Variation]],
    words: list[str],
    message: str,
) -> None:
    result = run("render-rooms", tmp_path / "rooms", *words)
    assert result.exit_code == 1
    assert re.search(message, result.stderr.replace("\n", " "))
    assert not painted
    assert not list(tmp_path.iterdir())
