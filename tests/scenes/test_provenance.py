"""Where a scene comes from, in its file and back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from vusfa import __version__
from vusfa.scenes import Scene
from vusfa.scenes.provenance import Provenance, this_tool, today

FULL = Provenance(
    made_with=this_tool("scenes render", mitsuba="3.9.1"),
    made_by="A. Fan",
    made_on="2026-11-23",
    plan="size: [3, 4]\nwalls: ümlaut",
    seed=0,
    licences=("CC BY 3.0",),
    credits=("Bath: B. Smith", "Door: C. Jones"),
)


@pytest.mark.parametrize("origin", [FULL, Provenance(), Provenance(credits=("one",), seed=7)])
def test_a_file_carries_it(origin: Provenance, make_scene: Callable[..., Scene], tmp_path: Path) -> None:
    scene = make_scene("hall")
    attributes = {**origin.attributes(), "exposure": 2.5}
    Scene("hall", scene.graph, scene.features, attributes=attributes).save(tmp_path / "a.h5")
    loaded = Scene.load(tmp_path / "a.h5")
    assert Provenance.of(loaded.attributes) == origin
    assert Provenance.other(loaded.attributes) == {"exposure": 2.5}


def test_what_is_not_known_is_left_out() -> None:
    assert Provenance().attributes() == {}
    assert Provenance(seed=0).attributes() == {"seed": 0}, "zero is a seed"


def test_bundled_rooms_tell_theirs() -> None:
    origin = Provenance.of(Scene.bundled("kitchen").attributes)
    assert origin.seed == 1
    assert any("CC BY 3.0" in licence for licence in origin.licences)


def test_a_plan_may_be_long(make_scene: Callable[..., Scene], tmp_path: Path) -> None:
    """HDF5 gives an attribute 64 KiB, but a text's bytes lie elsewhere."""
    scene, plan = make_scene("hall"), "chair: [1, 2]\n" * 20_000
    Scene("hall", scene.graph, scene.features, attributes={"plan": plan}).save(tmp_path / "a.h5")
    assert Scene.load(tmp_path / "a.h5").attributes["plan"] == plan


def test_tools_name_their_versions() -> None:
    assert this_tool("scenes encode") == f"vusfa {__version__} scenes encode"
    assert this_tool("x", a="1", b="2").endswith(" x, a 1, b 2")


def test_the_day_can_be_fixed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    assert today() == "2001-09-09"
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert today() >= "2026"
