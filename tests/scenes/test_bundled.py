"""What is shipped: the rooms, their credits, and a wheel that works alone."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from vusfa.scenes import Scene, SceneSet, bundled_names, validate
from vusfa.scenes.store import bundled_path

_ROOT = Path(__file__).parents[2]
_LIMIT = 30_000_000


@pytest.mark.parametrize("name", ["bathroom", "bedroom", "kitchen", "living_room"])
def test_every_room_is_sound_and_says_where_it_is_from(name: str) -> None:
    assert validate(bundled_path(name)) == []
    room = Scene.bundled(name)
    assert room.name == name
    assert room.picture_shape == (150, 200, 3)
    assert {"seed", "feature", "licences", "models"} <= set(room.attributes)
    # State = 4 * cell + heading / 90: turning right adds 90 degrees and stays in place.
    right = room.graph[:, room.actions.index("RotateRight")]
    assert (room.rotation[right] - room.rotation).remainder(360).unique().tolist() == [90]
    assert (room.location[right] == room.location).all()


def test_credits_name_every_model_collection_and_licence() -> None:
    text = (_ROOT / "CREDITS.md").read_text()
    for name in bundled_names():
        attributes = Scene.bundled(name).attributes
        for model in attributes["models"]:
            rows = [line for line in text.splitlines() if line.startswith(f"| {model} |")]
            assert len(rows) == 1, model
            assert name in rows[0].split("|")[-2].strip().split(", ")
        assert attributes["licences"] == [
            "BlendSwap-CC-0: CC0 (public domain)",
            "BlendSwap-CC-BY: CC BY 3.0",
            "KatorLegaz: CC BY 3.0 US",
            "Scopia: CC BY 3.0 Unported",
        ]
    for words in (
        "https://creativecommons.org/licenses/by/3.0/",
        "https://creativecommons.org/licenses/by/3.0/us/",
        "https://creativecommons.org/publicdomain/zero/1.0/",
        "Andrew Kator and Jennifer Legaz",
        "Emmanuel Puybaret / eTeks",
        "Scopia Visual Interfaces Systems, s.l.",
    ):
        assert words in text
    # Nothing is credited that is not shown.
    models = {model for name in bundled_names() for model in Scene.bundled(name).attributes["models"]}
    assert set(re.findall(r"^\| ((?:BlendSwap|KatorLegaz|Scopia)[^|]*) \|", text, flags=re.M)) == models


def test_the_wheel_works_alone(tmp_path: Path) -> None:
    # From a copy of what git would hand over: a build leaves nothing in the working tree.
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "CREDITS.md"):
        if (_ROOT / name).exists():
            shutil.copy(_ROOT / name, source)
    shutil.copytree(_ROOT / "vusfa", source / "vusfa", ignore=shutil.ignore_patterns("__pycache__"))
    line = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*line, "-w", str(tmp_path), str(source)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("vusfa-*.whl")
    assert wheel.stat().st_size <= _LIMIT
    alone = tmp_path / "alone"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(alone)
        names = archive.namelist()
    assert any(name.endswith("licenses/CREDITS.md") for name in names)
    assert "vusfa/py.typed" in names
    program = f"""
import sys
sys.path.insert(0, {str(alone)!r})
import vusfa.scenes
rooms = vusfa.scenes.SceneSet.bundled()
print(vusfa.scenes.__file__, rooms.num_states, tuple(rooms.pictures([0, 1711]).shape), rooms.fingerprint)
print(vusfa.load_pretrained("vusfa", rooms).agent.config["model"])
"""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = subprocess.run(
        [sys.executable, "-I", "-c", program],
        cwd=elsewhere,
        env={"PATH": os.environ["PATH"], "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rooms = SceneSet.bundled()
    expected = f"{alone}/vusfa/scenes/__init__.py 1712 (2, 150, 200, 3) {rooms.fingerprint}\nvusfa\n"
    assert done.stdout == expected
