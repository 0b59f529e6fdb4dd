from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vusfa.errors import SceneError
from vusfa.scenes import Scene, SceneSet, bundled_names


def random_scene(rng: np.random.Generator, name: str, num_states: int, num_actions: int = 3) -> Scene:
    graph = rng.integers(-1, num_states, (num_states, num_actions))
    return Scene(
        name,
        graph,
        rng.standard_normal((num_states, 2, 5)),
        location=rng.standard_normal((num_states, 2)),
        rotation=rng.uniform(0, 360, num_states),
    )


@pytest.fixture(scope="module")
def rooms() -> SceneSet:
    return SceneSet.bundled()


@given(st.lists(st.integers(1, 8), min_size=1, max_size=4), st.integers(0, 1000))
def test_tables_are_those_of_the_scenes_one_after_the_other(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    scenes = [random_scene(rng, f"room {index}", size) for index, size in enumerate(sizes)]
    together = SceneSet(scenes)
    assert (together.num_scenes, together.num_states) == (len(sizes), sum(sizes))
    assert (together.num_actions, together.num_crops, together.feature_size) == (3, 2, 5)
    assert together.offsets.tolist() == np.cumsum([0, *sizes]).tolist()
    first = 0
    for index, scene in enumerate(scenes):
        for state in range(scene.num_states):
            here = first + state
            for action in range(3):
                target = int(scene.graph[state, action])
                assert together.blocked[here, action].item() == (target < 0)
                assert together.successor[here, action] == (here if target < 0 else first + target)
            assert torch.equal(together.features[here], scene.features[state])
            assert torch.equal(together.location[here], scene.location[state])
            assert together.rotation[here] == scene.rotation[state]
            assert together.scene_id[here] == index
            assert together.global_id(index, state) == here
            assert together.global_id(scene.name, [state]).tolist() == [here]
            assert together.local_id(here) == state
        first += scene.num_states
    states = torch.arange(together.num_states)
    found = together.distance(states.unsqueeze(1), states)
    assert found.dtype == torch.int64
    for state in states.tolist():
        for goal in states.tolist():
            scene_id = int(together.scene_id[state])
            expected = -1
            if scene_id == together.scene_id[goal]:
                start = together.offsets[scene_id]
                expected = int(scenes[scene_id].distance[state - start, goal - start])
            assert found[state, goal] == expected
    flat, begin = together.distance_tables
    assert begin.tolist() == np.cumsum([0, *(size * size for size in sizes)]).tolist()
    assert flat.numel() == begin[-1]


def test_the_bundled_rooms(rooms: SceneSet) -> None:
    assert rooms.names == bundled_names() == ("bathroom", "bedroom", "kitchen", "living_room")
    assert rooms.offsets.tolist() == [0, 176, 580, 1260, 1712]
    assert (rooms.num_actions, rooms.num_crops, rooms.feature_size) == (4, 1, 1280)
    assert rooms.actions == ("MoveForward", "RotateRight", "RotateLeft", "MoveBackward")
    dtypes = {name: getattr(rooms, name).dtype for name in ("successor", "blocked", "features", "scene_id")}
    assert list(dtypes.values()) == [torch.int64, torch.bool, torch.float32, torch.int64]
    assert all(scene.islands == () for scene in rooms.scenes)


def test_distance_takes_numbers_and_broadcasts(rooms: SceneSet) -> None:
    kitchen = rooms.scenes[2]
    assert rooms.distance(580 + 3, 580 + 100) == kitchen.distance[3, 100]
    assert rooms.distance([[580], [581]], [580, 581, 0]).tolist() == [
        [0, kitchen.distance[0, 1], -1],
        [kitchen.distance[1, 0], 0, -1],
    ]


@pytest.mark.parametrize(("ids", "wrong"), [([0, -1], -1), (10**6, 10**6), ([[3], [10**12]], 10**12)])
def test_ids_that_are_no_states(rooms: SceneSet, ids: Any, wrong: int) -> None:
    calls = [lambda: rooms.distance(ids, 0), lambda: rooms.distance(0, ids)]
    calls += [lambda: rooms.local_id(ids), lambda: rooms.pictures(ids)]
    for call in calls:
        with pytest.raises(SceneError, match=f"there is no state {wrong}; this set has 0"):
            call()


def test_opens_names_and_files_alike(make_file: Callable[..., Path], tmp_path: Path) -> None:
    bathroom = Scene.bundled("bathroom")
    copied = tmp_path / "copy.h5"
    Scene("copy", bathroom.graph, bathroom.features).save(copied)
    together = SceneSet.open(["bathroom", str(copied)])
    assert together.names == ("bathroom", "copy")
    assert SceneSet.open(copied).names == ("copy",)
    assert SceneSet.open("kitchen").names == ("kitchen",)
    assert SceneSet.bundled("kitchen").names == ("kitchen",)
    assert SceneSet.open([make_file(), make_file("other.h5")]).names == ("room", "other")


def test_a_bundled_name_wins_over_a_file_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kitchen").write_text("not HDF5")
    (tmp_path / "attic").write_text("not HDF5")
    assert SceneSet.open("kitchen").num_states == 680
    with pytest.raises(SceneError, match="attic: cannot be read as HDF5"):
        SceneSet.open("attic")
    with pytest.raises(SceneError, match="kitchen: cannot be read as HDF5"):
        SceneSet.open("./kitchen")


def test_pictures_come_in_the_order_asked_for(rooms: SceneSet) -> None:
    ids = torch.tensor([[600, 3], [1300, 600], [0, 1711]])
    found = rooms.pictures(ids)
    assert found.shape == (3, 2, 150, 200, 3)
    for place in np.ndindex(3, 2):
        scene = rooms.scenes[int(rooms.scene_id[ids[place]])]
        assert torch.equal(found[place], scene.pictures(rooms.local_id(ids[place])))
    assert rooms.pictures([]).shape == (0, 150, 200, 3)
    assert torch.equal(rooms.pictures(600), found[0, 0])


def test_the_fingerprint_tells_names_graphs_features_and_order_apart() -> None:
    rng = np.random.default_rng(0)
    a, b = random_scene(rng, "a", 4), random_scene(rng, "b", 4)
    graph = a.graph.clone()
    graph[0, 0] = -1 if graph[0, 0] != -1 else 0
    features = a.features.clone()
    features[3, 1, 4] += 1e-3
    sets = [
        [a, b],
        [b, a],
        [a],
        [Scene("c", a.graph, a.features), b],
        [Scene("a", graph, a.features), b],
        [Scene("a", a.graph, features), b],
    ]
    prints = [SceneSet(scenes).fingerprint for scenes in sets]
    assert len(set(prints)) == len(prints)
    assert all(len(print_) == 16 and int(print_, 16) >= 0 for print_ in prints)
    assert SceneSet([Scene("a", a.graph, a.features), b]).fingerprint == prints[0]
    # It must never change: checkpoints carry it.
    fixed = Scene("fixed", torch.tensor([[1, -1], [-1, 0]]), torch.arange(4.0).reshape(2, 1, 2))
    assert SceneSet([fixed]).fingerprint == "fe427d42d6c4a8f1"


def test_copies_and_pickles_are_whole_and_small(rooms: SceneSet) -> None:
    pickled = pickle.dumps(rooms)
    scenes = pickle.dumps(rooms.scenes)
    assert len(pickled) < len(scenes) + 1000  # nothing is sent twice
    for other in (pickle.loads(pickled), copy.deepcopy(rooms), rooms.to("cpu")):
        assert other.fingerprint == rooms.fingerprint
        for name in ("successor", "blocked", "features", "scene_id", "offsets", "location", "rotation"):
            assert torch.equal(getattr(other, name), getattr(rooms, name))
        assert other.distance(0, 100) == rooms.distance(0, 100)


def test_moves_to_another_device(rooms: SceneSet) -> None:
    moved = rooms.to("meta")
    assert moved.device.type == "meta"
    tables = ("successor", "blocked", "features", "scene_id", "offsets", "location", "rotation")
    assert {getattr(moved, name).device.type for name in tables} == {"meta"}
    assert {table.device.type for table in moved.distance_tables} == {"meta"}
    assert rooms.device.type == "cpu"
    assert moved.scenes[0].graph.device.type == "cpu"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_answers_are_the_same_on_a_gpu(rooms: SceneSet) -> None:
    moved = rooms.to("cuda")
    states = torch.arange(0, 1712, 7)
    expected = rooms.distance(states.unsqueeze(1), states)
    assert torch.equal(moved.distance(states.cuda().unsqueeze(1), states.cuda()).cpu(), expected)
    assert torch.equal(moved.pictures(states[:3].cuda()), rooms.pictures(states[:3]))
    assert moved.global_id("kitchen", [1]).tolist() == [581]
    assert moved.fingerprint == rooms.fingerprint
    assert pickle.loads(pickle.dumps(moved)).device.type == "cuda"


def facts(rooms: SceneSet) -> tuple[int, int, str]:
    return rooms.distance(3, 150).item(), int(rooms.pictures([700]).numpy().sum()), rooms.fingerprint


def _send_distance(rooms: SceneSet, connection) -> None:
    connection.send(facts(rooms))
    connection.close()


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")  # Python 3.12: the test process has threads
def test_a_set_works_in_other_processes(rooms: SceneSet, method: str) -> None:
    expected = facts(rooms)
    context = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_distance, args=(rooms, sender))
    process.start()
    sender.close()
    try:
        assert receiver.poll(60)
        assert receiver.recv() == expected
    finally:
        process.join(10)
        process.kill()
    assert process.exitcode == 0


LOAD_AFTER_FORK = """
import os, torch
from vusfa.scenes import SceneSet
rooms = SceneSet.bundled()
torch.set_num_threads(4)
torch.rand(3_000_000).exp().sum()  # now there are threads, which a forked child lacks and waits for
child = os.fork()
if not child:
    again = SceneSet.bundled()
    same = again.fingerprint == rooms.fingerprint and again.pictures([0, 700, 1711]).shape == (3, 150, 200, 3)
    os._exit(0 if same else 1)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_rooms_open_in_a_fork_of_a_process_that_has_computed(
    program: Callable[..., Any], tmp_path: Path
) -> None:
    done = program("vusfa", folder=tmp_path, code=LOAD_AFTER_FORK, seconds=60.0)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: SceneSet([]), "needs at least one scene"),
        (lambda: SceneSet(["bathroom"]), "'bathroom' is no Scene; open names and files with SceneSet.open"),
        (
            lambda: SceneSet.open("attic"),
            "'attic' is neither a bundled scene .bathroom, bedroom, .* nor a file",
        ),
        (lambda: SceneSet.open(["attic.h5"]), "attic.h5: there is no such file"),
        (lambda: SceneSet.open(5), "5 is no scene; give names and files, such as"),
        (lambda: SceneSet.open(["bathroom", None]), "None is no scene; give names and files"),
        (lambda: SceneSet.open("x" * 100_000), "x' is neither a bundled scene"),
        (lambda: SceneSet.bundled(["attic"]), "no bundled scene is called 'attic'; there are bathroom"),
        (lambda: SceneSet.open(["bathroom", "bathroom"]), "2 scenes are called 'bathroom'"),
        (lambda: SceneSet.open("bathroom").global_id("attic", 0), "no scene is called 'attic'"),
        (
            lambda: SceneSet.open("bathroom").global_id(1, 0),
            "there is no scene 1; this set has the scenes 0..0",
        ),
        (lambda: SceneSet.open("bathroom").global_id(0, [1, 176]), "'bathroom' has no state 176; .* 0..175"),
        (lambda: SceneSet.open("bathroom").pictures([3, -1]), "no state -1; this set has 0..175"),
    ],
)
def test_errors_name_the_culprit(call: Callable[[], object], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        call()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"graph": torch.tensor([[0], [1]])}, "'one' and 'two' differ in actions"),
        ({"actions": ("left", "right")}, "'one' and 'two' differ in actions"),
        ({"features": torch.rand(2, 2, 4)}, r"differ in crops \(1, 2\)"),
        ({"features": torch.rand(2, 1, 5)}, r"differ in feature size \(4, 5\); put them in different sets"),
    ],
)
def test_scenes_that_do_not_go_together(changes: dict, words: str) -> None:
    common = {"graph": torch.tensor([[1, -1], [-1, 0]]), "features": torch.rand(2, 1, 4)}
    with pytest.raises(SceneError, match=words):
        SceneSet([Scene("one", **common), Scene("two", **{**common, **changes})])


def test_pictures_of_different_sizes_or_none(make_file: Callable[..., Path], pictures: np.ndarray) -> None:
    seen = Scene.load(make_file("seen.h5", observation=pictures))
    large = Scene.load(make_file("large.h5", observation=np.tile(pictures, (1, 2, 2, 1))))
    blind = Scene.load(make_file("blind.h5"))
    together = SceneSet([seen, large, blind])
    assert together.pictures([1, 2]).shape == (2, 6, 8, 3)
    with pytest.raises(SceneError, match="'seen' and 'large' have pictures of different sizes"):
        together.pictures([1, 6])
    for ids in ([1, 11], [11], [11, 1]):
        with pytest.raises(SceneError, match="scene 'blind' has no pictures"):
            together.pictures(ids)


def test_files_whose_scenes_are_called_alike_are_called_by_their_files_names(
    scene_file: Path, tmp_path: Path
) -> None:
    """Rooms of one kind that are rendered from several seeds all call themselves by their kind."""
    paths = [tmp_path / "room-1.h5", tmp_path / "room-2.h5"]
    for path in paths:
        path.write_bytes(scene_file.read_bytes())
    assert SceneSet.open(paths).names == ("room-1", "room-2")
    alone = Scene.load(scene_file).name
    assert SceneSet.open([paths[0]]).names == (alone,)
    with pytest.raises(SceneError, match="2 scenes are called 'room-1'"):
        SceneSet.open([paths[0], paths[0]])


def test_a_folder_and_a_pattern_stand_for_their_files(
    tmp_path: Path, make_scene: Callable[..., Scene]
) -> None:
    folder = tmp_path / "rooms"
    folder.mkdir()
    for name in ("b_small", "a_small", "c"):
        make_scene(name).save(folder / f"{name}.h5")
    (folder / "notes.txt").write_text("no scene")
    opened = SceneSet.open(folder)
    assert opened.names == ("a_small", "b_small", "c")
    assert opened.sources == tuple(str(folder / f"{name}.h5") for name in opened.names)
    assert SceneSet.open(["bathroom", "kitchen"]).sources == ("bathroom", "kitchen")
    assert SceneSet.open([f"{folder}/*_small.h5", str(folder / "c.h5")]).names == opened.names
    (tmp_path / "none").mkdir()
    for nothing in (tmp_path / "none", f"{folder}/*_large.h5"):
        with pytest.raises(SceneError, match="there are no scene files"):
            SceneSet.open(nothing)


def test_a_broken_file_is_named_and_can_be_left_out(tmp_path: Path, make_scene: Callable[..., Scene]) -> None:
    for name in ("a", "b", "c"):
        make_scene(name).save(tmp_path / f"{name}.h5")
    (tmp_path / "b.h5").write_bytes((tmp_path / "b.h5").read_bytes()[:1000])
    with pytest.raises(SceneError, match=r"b\.h5: cannot be read as HDF5"):
        SceneSet.open(tmp_path)
    with pytest.warns(UserWarning, match=r"1 scenes cannot be opened and are left out:\n  - .*b\.h5"):
        assert SceneSet.open(tmp_path, skip_broken=True).names == ("a", "c")
    for name in ("a", "c"):
        (tmp_path / f"{name}.h5").write_bytes(b"")
    with pytest.warns(UserWarning, match="3 scenes"), pytest.raises(SceneError, match="at least one scene"):
        SceneSet.open(tmp_path, skip_broken=True)


def test_scenes_that_differ_are_named_with_their_files(
    tmp_path: Path, make_scene: Callable[..., Scene]
) -> None:
    make_scene("a").save(tmp_path / "a.h5")
    make_scene("b", features=9).save(tmp_path / "b.h5")
    with pytest.raises(SceneError, match=r"'a' \(.*a\.h5\) and 'b' \(.*b\.h5\) differ in feature size"):
        SceneSet.open(tmp_path)


def test_a_set_and_its_scenes_share_one_copy_of_the_features(make_scene: Callable[..., Scene]) -> None:
    one, other = make_scene("a"), make_scene("b", width=3)
    values = other.features.clone()
    both = SceneSet([one, other])
    assert other.features.data_ptr() == both.features[one.num_states :].data_ptr()
    assert torch.equal(other.features, values)
    for again in (copy.deepcopy(other), pickle.loads(pickle.dumps(other))):
        assert torch.equal(again.features, values)
        assert again.features.untyped_storage().nbytes() == values.untyped_storage().nbytes()
    assert torch.equal(pickle.loads(pickle.dumps(both)).features, both.features)
