"""vusfa scenes render, without a renderer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vusfa.sources.render import Rendered, layout, load_plan, room, save_plan
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
