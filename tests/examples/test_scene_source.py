"""The example of a new source of scenes: a command of its own whose product passes the check."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vusfa.scenes import Scene, validate

EXAMPLE = Path(__file__).parents[2] / "examples" / "extending" / "scene_source.py"


def test_a_grid_world_is_a_scene(tmp_path: Path, program: Any) -> None:
    def command(*arguments: object) -> Any:
        return program("examples/extending/scene_source.py", *arguments, folder=tmp_path)

    target = tmp_path / "maze.h5"
    done = command("grid-world", target, "--columns", 4, "--rows", 3)
    assert (done.returncode, done.stdout) == (0, f"{target}: 40 states\n"), done.stderr
    assert validate(target) == []
    checked = command("check", target)  # the example's program has all other commands, too
    assert checked.returncode == 0, checked.stderr
    maze = Scene.load(target)
    assert maze.islands == ()
    assert maze.picture_shape == (64, 64, 3)
    assert maze.attributes["feature_backbone"] == "efficientnet-lite0"
    # by hand: from the corner, +Z ahead: two cells north, then the wall
    assert maze.graph[0].tolist() == [4, 1, 3, -1]
    assert int(maze.distance[0, 8]) == 2


def test_it_is_one_short_file() -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 81  # 80 lines and the registry line
