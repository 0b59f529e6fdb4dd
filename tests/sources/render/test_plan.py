from __future__ import annotations

from pathlib import Path

import pytest

from vusfa.errors import SceneError
from vusfa.sources.render import from_yaml, load_plan, save_plan, to_yaml
from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.faults import plan_faults
from vusfa.sources.render.plan import (
    Camera,
    Furniture,
    Grid,
    Light,
    Picture,
    Plan,
    Solid,
    Surfaces,
    Window,
    Zone,
)

FULL = Plan(
    name="größer",
    size=(4.0, 3.0, 2.5),
    kind="hall",
    seed=7,
    solids=(Solid((0.0, 0.0, 1.0, 3.0999999999999996 - 2)), Solid((2.0, 0.0, 2.1, 3.0), bottom=2.1)),
    surfaces=Surfaces("check", 5, ("brick", "dots"), (Zone((0.0, 0.0, 2.0, 3.0), "tile"),)),
    furniture=(
        Furniture("Scopia#5", (3.0, 1.5), 90.0),
        Furniture("Scopia#27", (3.0, 2.5), 30.0, 0.5, (0.5, 1.0, 0.25), "top", False),
    ),
    pictures=(Picture((0.0, 2.0), 90.0, 1.5, (0.4, 0.3), 11),),
    windows=(Window("KatorLegaz#5", (4.0, 1.0), 270.0, 3, daylight=2.0),),
    lights=(Light((1.0, 2.0)), Light((3.0, 2.0), 0.5, (1.0, 2.0, 3.0))),
    grid=Grid(0.25, (0.4, 0.3), 8, 0.2),
    camera=Camera(1.2, 0.0, 75.0, (64, 48), 2, 1.5),
)


def test_yaml_gives_the_same_plan_back_to_the_last_digit(tmp_path: Path) -> None:
    assert from_yaml(to_yaml(FULL)) == FULL
    save_plan(FULL, tmp_path / "plan.yaml")
    assert load_plan(tmp_path / "plan.yaml") == FULL
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yaml"]
    assert plan_faults(FULL) == []


def test_every_wrong_word_and_type_is_named_at_once() -> None:
    text = """
name: 5
size: [3, 3, high]
furniture:
- {model: Scopia#5, at: [1]}
- {modle: Scopia#5, at: [1, 1], blocks: 1}
lights: {at: [1, 1]}
grid: {headings: 4.5}
camera: wide
"""
    with pytest.raises(SceneError) as caught:
        from_yaml(text, "room.yaml")
    lines = str(caught.value).split("\n")
    assert lines[0] == "room.yaml: 9 faults"
    assert [line.split(":")[0].removeprefix("  - ") for line in lines[1:]] == [
        "name",
        "size[2]",
        "furniture[0].at",
        "furniture[1].modle",
        "furniture[1].blocks",
        "furniture[1].model",
        "lights",
        "grid.headings",
        "camera",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: [", "cannot be read as YAML"),
        ("- 1", "the plan: must be a mapping"),
        ("name: a\nsize: [3, 3, 2.6]\ngrid: {step: .nan}", "grid.step"),
        ("name: a\nsize: [3, 3, 2.6]\nseed: .inf", "must be a whole number"),
        ("name: a\nsize: [3, 3, 2.6]\nseed: 1" + 30 * "0", "must be a whole number below"),
        ('name: "a\\e[2J"\nsize: [3, 3, 2.6]', "must be text of one line"),
        ("name: a\nkind: " + 999 * "x" + "\nsize: [3, 3, 2.6]", "at most 200 characters"),
        ("name: a\nsize: [3, .inf, 2.6]", "finite"),
    ],
)
def test_broken_yaml_is_a_clear_error(text: str, said: str) -> None:
    with pytest.raises(SceneError, match=r"^room\.yaml: ") as caught:
        from_yaml(text, "room.yaml")
    assert said in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"nothing\.yaml: cannot be read"):
        load_plan(tmp_path / "nothing.yaml")
    with pytest.raises(SceneError, match=r"cannot be written"):
        save_plan(FULL, tmp_path / "no folder" / "plan.yaml")


def test_values_that_cannot_be_are_named() -> None:
    plan = Plan(
        "a",
        (3.0, 3.0, 2.6),
        solids=(Solid((1.0, 0.0, 0.5, 1.0)), Solid((0.0, 0.0, 9.0, 1.0))),
        surfaces=Surfaces("mud", walls=("brick", "mirror")),
        furniture=(
            Furniture("Scopia#5", (2.9, 1.0), size=(1.0, 1.0, 1.0)),
            Furniture("x", (1.0, 1.0), role="roof"),
        ),
        pictures=(Picture((5.0, 1.0), 0.0, 1.5, (0.1, 0.1), 1),),
        grid=Grid(step=0.0, radius=-1.0, headings=3),
        camera=Camera(height=2.6, pitch=90.0, fov=0.0, resolution=(0, 4), samples=0, exposure=0.0),
    )
    said = "\n".join(plan_faults(plan))
    for word in [
        "grid.step",
        "grid.radius",
        "grid.headings",
        "camera.height",
        "camera.pitch",
        "camera.fov",
        "camera.resolution",
        "camera.samples",
        "camera.exposure",
        "surfaces.floor: 'mud'",
        "surfaces.walls[1]: 'mirror'",
        "solids[0].rect",
        "solids[1].rect",
        "pictures[0].at",
        "furniture[0] (Scopia#5): reaches out of the room",
        "furniture[1].role: 'roof'",
    ]:
        assert word in said
    assert len(plan_faults(plan)) == 16


def test_sizes_come_from_the_catalogue_where_the_plan_has_none(boxes: Catalogue) -> None:
    plan = Plan(
        "a",
        (3.0, 3.0, 2.6),
        furniture=(
            Furniture("Boxes#2", (1.0, 1.0)),
            Furniture("Boxes#1", (2.0, 2.0), 0.0, 0.3, (1.0, 2.0, 0.2)),
        ),
    )
    assert not plan.is_complete
    filled = plan.completed(boxes)
    assert filled.is_complete
    assert (filled.furniture[0].size, filled.furniture[0].elevation) == ((0.6, 0.3, 0.2), 1.5)
    assert filled.furniture[1] == plan.furniture[1]
    with pytest.raises(SceneError, match=r"has no size"):
        _ = plan.furniture[0].rect
    wrong = Plan("b", (3.0, 3.0, 2.6), furniture=(Furniture("Boxes#9", (1.0, 1.0)),))
    with pytest.raises(SceneError, match=r"plan 'b': the furniture catalogue has no Boxes#9"):
        wrong.completed(boxes)


def test_a_lintel_is_walked_under_and_shows_no_wall() -> None:
    plan = Plan("a", (3.0, 3.0, 2.6), solids=(Solid((1.0, 0.0, 1.2, 3.0), bottom=2.1),))
    assert plan.obstacles == []
    assert len(plan.walls) == 4


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        pytest.param("size: [100000, 100000, 3]", "grid.step: 0.5 makes over 100000", id="cells"),
        pytest.param("size: [3, 3, 3]\ngrid: {step: 0.0001}", "grid.step: 0.0001 makes over", id="step"),
        pytest.param(
            "size: [3, 3, 3]\nfurniture: [" + "{}, " * 100_000 + "{}]",
            "it has more than 100000 entries",
            id="furniture",
        ),
        pytest.param(
            "size: [3, 3, 3]\ncamera: {resolution: [100000, 2]}", "at most 4096 per side", id="picture"
        ),
        pytest.param("size: " + "[" * 5000, "nested more than 20 deep", id="deep"),
    ],
)
def test_plans_that_would_fill_the_machine(entries: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        from_yaml(f"name: cell\n{entries}", "cell.yaml")


def test_a_plan_of_aliases_is_refused_briefly() -> None:
    lines = ["name: &a [x, x, x, x, x, x, x, x, x, x]"]
    for before, key in zip("abcdefg", "bcdefgh", strict=True):
        lines.append(f"{key}: &{key} [{', '.join([f'*{before}'] * 10)}]")
    with pytest.raises(SceneError) as caught:
        from_yaml("\n".join([*lines, "size: *h"]), "cell.yaml")
    assert len(str(caught.value)) < 5000


def test_a_plan_that_is_no_regular_file() -> None:
    with pytest.raises(SceneError, match=r"/dev/zero: cannot be read .it is no regular file"):
        load_plan("/dev/zero")
