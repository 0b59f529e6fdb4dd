"""Which states are goals."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from vusfa.envs import TargetNavEnv
from vusfa.envs.goals import PAPER_MANIFEST, read_manifest, resolve_goals, spread_goals
from vusfa.errors import GoalError
from vusfa.scenes import Scene, SceneSet, bundled_names


@pytest.fixture
def scenes(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("hall"), make_scene("attic", 3, 1)])  # 16 and 12 states


def test_the_papers_twenty_goals() -> None:
    manifest = read_manifest(PAPER_MANIFEST)
    assert manifest["bathroom_02"] == [26, 37, 43, 53, 69]
    assert manifest["bedroom_04"] == [134, 264, 320, 384, 387]
    assert manifest["kitchen_02"] == [90, 136, 157, 207, 329]
    assert manifest["living_room_08"] == [92, 135, 193, 228, 254]


BUNDLED_GOALS = {
    "bathroom": [0, 73, 96, 101, 173],
    "bedroom": [4, 41, 236, 381, 397],
    "kitchen": [0, 33, 413, 485, 676],
    "living_room": [0, 180, 196, 356, 448],
}


@pytest.mark.parametrize("name", bundled_names())
def test_the_goals_of_the_bundled_rooms_are_always_these(name: str) -> None:
    assert resolve_goals(SceneSet.bundled([name]), "paper").tolist() == BUNDLED_GOALS[name]


def test_paper_goals_of_the_bundled_rooms_are_global_ids() -> None:
    goals = resolve_goals(SceneSet.bundled(["kitchen", "bathroom"]), "paper").tolist()
    assert goals == BUNDLED_GOALS["kitchen"] + [680 + g for g in BUNDLED_GOALS["bathroom"]]


def test_a_room_of_a_bundled_rooms_name_but_with_another_graph_gets_its_own_goals(
    make_scene: Callable[..., Scene],
) -> None:
    """A bedroom that was rendered from another seed has fewer states than the bundled one's goals name."""
    room = make_scene("bedroom")
    assert resolve_goals(SceneSet([room]), "paper").tolist() == spread_goals(room, 5)


def test_paper_goals_of_a_scene_that_is_called_as_the_papers(make_scene: Callable[..., Scene]) -> None:
    scenes = SceneSet([make_scene("bathroom_02", 5, 5)])
    assert resolve_goals(scenes, "paper").tolist() == [26, 37, 43, 53, 69]


def test_paper_goals_of_any_other_scene_are_spread_by_the_rule_of_the_bundled_rooms(
    make_scene: Callable[..., Scene],
) -> None:
    scenes = SceneSet([make_scene("hall"), Scene("pair", *_pair())])
    hall = spread_goals(scenes.scenes[0], 5)
    assert len(set(hall)) == 5
    assert resolve_goals(scenes, "paper").tolist() == hall + [16, 17]  # only two states: both are goals


def _pair() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor([[1, -1, -1, -1], [0, -1, -1, -1]]), torch.rand(2, 1, 8)


def test_a_paper_goal_that_the_scene_does_not_have(make_scene: Callable[..., Scene]) -> None:
    with pytest.raises(GoalError, match=r"scene 'bathroom_02' has no state 26; its states are 0\.\.15"):
        resolve_goals(SceneSet([make_scene("bathroom_02")]), "paper")


def test_all_leaves_out_what_nothing_leads_to() -> None:
    # 0 -> 1 -> 2 -> 1; state 3 leads to itself alone, and nothing to state 0
    graph = torch.tensor([[1, -1], [2, -1], [1, -1], [3, -1]])
    assert resolve_goals(SceneSet([Scene("one-way", graph, torch.rand(4, 1, 2))]), "all").tolist() == [1, 2]


def test_all_of_several_scenes(scenes: SceneSet) -> None:
    assert resolve_goals(scenes, "all").tolist() == list(range(28))


def test_random_goals_are_the_same_in_every_process_and_set(scenes: SceneSet) -> None:
    found = resolve_goals(scenes, "random:3")
    assert found.shape == (6,)
    assert found.unique().numel() == 6
    assert (found[:3] < 16).all()
    assert (found[3:] >= 16).all()
    torch.manual_seed(1)
    assert torch.equal(resolve_goals(scenes, "random:3"), found)
    other_order = SceneSet([scenes.scenes[1], scenes.scenes[0]])
    assert resolve_goals(other_order, "random:3").tolist() == [
        *(found[3:] - 16).tolist(),
        *(found[:3] + 12).tolist(),
    ]


def test_random_goals_of_another_draw_differ(scenes: SceneSet) -> None:
    draws = {tuple(resolve_goals(scenes, f"random:3:{draw}").tolist()) for draw in range(4)}
    assert len(draws) == 4
    assert tuple(resolve_goals(scenes, "random:3").tolist()) in draws


def test_a_manifest_and_a_dict_say_the_same(scenes: SceneSet, tmp_path: Path) -> None:
    path = tmp_path / "goals.yaml"
    path.write_text("# mine\nattic: [0, 11]\nhall: [3]\n")
    assert resolve_goals(scenes, path).tolist() == [3, 16, 27]
    assert resolve_goals(scenes, str(path)).tolist() == [3, 16, 27]
    assert resolve_goals(scenes, {"attic": [0, 11], "hall": [3]}).tolist() == [3, 16, 27]


def test_ids_keep_their_order(scenes: SceneSet) -> None:
    for ids in (
        [20, 3, 3],
        (20, 3, 3),
        torch.tensor([20, 3, 3]),
        torch.tensor([20, 3, 3], dtype=torch.int32),
    ):
        found = resolve_goals(scenes, ids)
        assert (found.tolist(), found.dtype) == ([20, 3, 3], torch.int64)


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ([28], r"goal 28 is out of range; .* 0\.\.27"),
        ([-1], "goal -1 is out of range"),
        ([], "at least one global state id"),
        ([[1]], "at least one global state id"),
        ([1.5], "give integers"),
        ([True], "give integers"),
        (7, "goals are 7"),
        ({"cellar": [1]}, "goals name the scene 'cellar'; this set has hall, attic"),
        ({"attic": [12]}, r"scene 'attic' has no state 12; its states are 0\.\.11"),
        ({"attic": []}, "no goal is given"),
        (["paper"], r"goals: \['paper'\] are no state ids"),
        ([1, True], r"goals: \[1, True\] are no state ids"),
        ([2**70], "are no state ids"),
        ({"hall": ["a"]}, r"goals: scene 'hall': \['a'\] are no state ids"),
        ({"hall": 3}, "scene 'hall' has 3; give a list"),
        ({"hall": [1.5]}, r"scene 'hall' has \[1.5\]; give a list"),
        ({"hall": [[1]]}, r"scene 'hall' has \[\[1\]\]; give a list"),
        ({"hall": None}, "scene 'hall': None are no state ids"),
        ("papre", "goals are 'papre'; give 'paper', 'all'"),
        ("random:0", "write 'random:5'"),
        ("random:x", "write 'random:5'"),
        ("random:1:2:3", "write 'random:5'"),
        ("random:13", "only 12 states of 'attic' can be reached"),
        ("nowhere.yaml", "nowhere.yaml: cannot be read"),
    ],
)
def test_bad_goals_name_the_culprit(scenes: SceneSet, goals: object, message: str) -> None:
    with pytest.raises(GoalError, match=message):
        resolve_goals(scenes, goals)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no scenes"),
        ("- 1\n- 2\n", "holds no scenes"),
        ("hall: 3\n", "scene 'hall' has 3; give a list"),
        ("hall: [a]\n", "give a list of state ids"),
        ("hall: [true]\n", "give a list of state ids"),
        ("hall: [1\n", "cannot be read as YAML"),
        ("cellar: [1]\n", "name the scene 'cellar'"),
        ("hall: [16]\n", "scene 'hall' has no state 16"),
    ],
)
def test_bad_manifests_name_the_file(scenes: SceneSet, tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(GoalError, match=message) as caught:
        resolve_goals(scenes, path)
    assert "mine.yaml" in str(caught.value)


def test_a_goal_that_nothing_can_reach_is_an_error_at_once() -> None:
    graph = torch.tensor([[1, -1], [0, -1], [0, -1]])  # state 2 leads away, and nothing leads to it
    scenes = SceneSet([Scene("trap", graph, torch.rand(3, 1, 2))])
    with pytest.raises(GoalError, match=r"scene 'trap': no other state can reach goal 2 \(global id 2\)"):
        TargetNavEnv(scenes, goals=[0, 2])


def test_spread_goals_by_hand() -> None:
    """A corridor of seven places that can be walked both ways: the ends, the middle, the rest."""
    count = 7
    graph = torch.stack([torch.arange(1, count + 1), torch.arange(-1, count - 1)], 1)
    graph[-1, 0] = -1
    corridor = Scene("corridor", graph, torch.rand(count, 1, 2))
    assert spread_goals(corridor, 1) == [0]
    assert spread_goals(corridor, 2) == [0, 6]
    assert spread_goals(corridor, 3) == [0, 3, 6]
    assert spread_goals(corridor, 7) == list(range(7))
    with pytest.raises(GoalError, match="8 goals asked for; its largest part has 7 states"):
        spread_goals(corridor, 8)


def test_spread_goals_leave_islands_alone() -> None:
    graph = torch.tensor([[1], [2], [0], [4], [3]])  # a ring of three and an island of two
    scene = Scene("ring and island", graph, torch.rand(5, 1, 2))
    assert set(spread_goals(scene, 3)) == {0, 1, 2}


def test_a_manifest_of_aliases_is_refused_at_once_and_briefly(scenes: SceneSet, tmp_path: Path) -> None:
    """A few hundred bytes that are 10^9 entries when they are written out."""
    lines = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [
        f"{n}: &{n} [{', '.join([f'*{before}'] * 10)}]"
        for before, n in zip("abcdefgh", "bcdefghi", strict=True)
    ]
    path = tmp_path / "goals.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(GoalError, match="more than 100000 entries") as caught:
        resolve_goals(scenes, path)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("text", ["[" * 5000, "a: [" + "1, " * 500_000 + "1]"], ids=["deep", "large"])
def test_a_manifest_beyond_its_limits(scenes: SceneSet, tmp_path: Path, text: str) -> None:
    (tmp_path / "goals.yaml").write_text(text)
    with pytest.raises(GoalError, match=r"goals\.yaml: "):
        resolve_goals(scenes, tmp_path / "goals.yaml")


def test_a_manifest_that_is_a_pipe(scenes: SceneSet, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "goals.yaml")
    with pytest.raises(GoalError, match="no regular file"):
        resolve_goals(scenes, tmp_path / "goals.yaml")
