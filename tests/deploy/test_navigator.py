"""A trained agent at a camera: the same actions as in its dump, arrival, rooms, and faults."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from vusfa.deploy import Navigator
from vusfa.deploy.pictures import as_picture, in_shape
from vusfa.errors import CheckpointError, ConfigError, GoalError, SceneError
from vusfa.modules import InferencePolicy, make_agent
from vusfa.scenes import SceneSet
from vusfa.training import load_agent


def navigate(world: Any, path: Path, **options: Any) -> Navigator:
    return Navigator.load(path, scenes=world.scenes, backbone=world.backbone, **options)


@pytest.mark.parametrize(
    "options",
    [
        {"history": 3},
        {"history": 1, "architecture": "reference"},
        {"model": "gvf", "history": 2, "normalize_features": False},
        {"model": "sfdp", "observation": "features"},
        {"model": "usfa", "shared_heads": True},
        {"model": "gvf", "pretrained": "autoencoder", "history": 2},
    ],
    ids=str,
)
def test_pictures_of_the_dump_give_the_actions_that_its_states_give(
    world: Any, options: dict[str, Any]
) -> None:
    path = world.checkpoint(**options)
    navigator = navigate(world, path, sample=False)
    agent, scenes, _ = load_agent(path, world.scenes)
    walk, goal = torch.tensor([17, 18, 18, 22, 30]), 35
    assert navigator.goal(scenes.pictures(goal)) == "attic"
    kept = agent.config["history"]
    states = torch.cat([walk[:1].expand(kept - 1), walk]).unfold(0, kept, 1)
    read = states, torch.full((5,), goal)
    if agent.config["observation"] == "features":
        read = scenes.features[read[0], 0], scenes.features[read[1], 0]
    with torch.no_grad():
        logits = InferencePolicy(agent).logits(*read, torch.ones(5, dtype=torch.int64))
    for row, state in zip(logits.softmax(-1), walk, strict=True):
        found = navigator.act(scenes.pictures(state))
        assert found.index == int(row.argmax())
        assert found.name == scenes.actions[found.index]
        assert found.confidence == pytest.approx(row.max().item(), abs=1e-5)


@pytest.mark.parametrize("acted", [False, True], ids=["pictures", "and actions"])
def test_an_agent_with_a_memory_remembers_until_it_is_reset(world: Any, acted: bool) -> None:
    path = world.checkpoint(memory="lstm", previous_action=acted)
    navigator, (agent, scenes, _) = navigate(world, path, sample=False), load_agent(path, world.scenes)
    actor = agent.get_policy_operator(["logits"])
    navigator.goal(scenes.pictures(5))
    for begin in (0, 1):
        memory: dict[Any, Any] = {}
        before = 4
        for number, state in enumerate([1, 1, 9][begin:]):
            rows = TensorDict({"state_id": torch.tensor([[state]]), "goal_id": torch.tensor([5])}, [1])
            rows["scene_id"], rows["is_init"] = torch.tensor([0]), torch.tensor([[number == 0]])
            rows.update(memory)
            rows["previous_action"] = torch.tensor([before])
            rows = actor(rows)
            memory = {key: rows["next", key] for key in ("recurrent_state_h", "recurrent_state_c")}
            found = navigator.act(scenes.pictures(state))
            assert found.confidence == pytest.approx(rows["logits"].softmax(-1).max().item(), abs=1e-5)
            before = found.index
        navigator.reset()


def test_an_agent_of_pictures_needs_no_backbone(world: Any) -> None:
    path = world.checkpoint("gvf", encoder="conv", picture_size=[36, 40])
    navigator, (agent, scenes, _) = Navigator.load(path, sample=False), load_agent(path)
    assert navigator.backbone is None
    assert navigator.goal(scenes.pictures(2)) == "hall"
    with torch.no_grad():
        logits = InferencePolicy(agent).logits(
            torch.tensor([[7, 7, 7, 7]]), torch.tensor([2]), torch.tensor([0])
        )
    found = navigator.act(scenes.pictures(7))
    assert (found.index, found.arrived) == (int(logits.argmax()), False)
    assert found.confidence == pytest.approx(logits.softmax(-1).max().item(), abs=1e-5)
    assert navigator.act(scenes.pictures(2)).arrived


def test_it_arrives_at_its_goal_and_nowhere_else_even_through_jpeg(world: Any, tmp_path: Path) -> None:
    scenes = world.scenes
    navigator = navigate(world, world.checkpoint())
    for goal in (4, 25):
        Image.fromarray(scenes.pictures(goal).numpy()).save(tmp_path / "goal.jpg", quality=50)
        navigator.goal(tmp_path / "goal.jpg")
        arrived = {state: navigator.act(scenes.pictures(state)).arrived for state in range(1, 40, 3)}
        assert [state for state, yes in arrived.items() if yes] == [goal]


def test_the_thresholds_are_percentiles_of_the_most_similar_other_state(world: Any) -> None:
    navigator, scenes = navigate(world, world.checkpoint()), world.scenes
    features = scenes.features[:, 0].double().numpy()
    scaled = (features - features.mean(0)) / features.std(0)
    scaled /= np.linalg.norm(scaled, axis=1, keepdims=True)
    like = scaled @ scaled.T
    like[scenes.scene_id.numpy()[:, None] != scenes.scene_id.numpy()[None]] = -2
    np.fill_diagonal(like, -2)
    wanted = np.percentile(like.max(1), [95, 5])
    assert [navigator.threshold, navigator.places.known] == pytest.approx(list(wanted), abs=1e-5)


def test_the_room_is_named_or_recognized(world: Any, stranger: Any) -> None:
    scenes, path = world.scenes, world.checkpoint()
    assert navigate(world, path).goal(scenes.pictures(15)) == "hall"
    assert navigate(world, path).goal(scenes.pictures(16)) == "attic"
    assert navigate(world, path, scene="hall").goal(scenes.pictures(15)) == "hall"
    with pytest.raises(GoalError, match=r"the picture: was not taken in room 'hall' \(similarity"):
        navigate(world, path, scene="hall").goal(scenes.pictures(16))
    with pytest.raises(GoalError, match="was not taken in the rooms hall, attic"):
        navigate(world, path).goal(stranger())
    navigate(world, world.checkpoint(shared_heads=True)).goal(stranger())  # made for rooms it has never seen
    with pytest.raises(SceneError, match="no scene is called 'cellar'; this set has hall, attic"):
        navigate(world, path, scene="cellar")


def test_actions_are_drawn_with_the_policys_probabilities(world: Any) -> None:
    picture, path = world.scenes.pictures(9), world.checkpoint(history=1)
    navigator, again = navigate(world, path, seed=3), navigate(world, path, seed=3)
    drawn = []
    for one in (navigator, again):
        one.goal(world.scenes.pictures(3))
        drawn.append([one.act(picture) for _ in range(80)])
    assert drawn[0] == drawn[1]
    share = np.bincount([action.index for action in drawn[0]], minlength=4) / 80
    expected = {action.index: action.confidence for action in drawn[0]}
    assert all(abs(share[index] - chance) < 0.2 for index, chance in expected.items())
    assert len(expected) > 1


def test_faults_are_one_clear_error(world: Any, tmp_path: Path, stranger: Any) -> None:
    path = world.checkpoint()
    with pytest.raises(ConfigError, match="'patches', whose weights are a file of yours; pass backbone="):
        Navigator.load(path)
    with pytest.raises(ConfigError, match="features of backbone 'patches', not 'others'"):
        Navigator.load(path, backbone=replace(world.backbone, name="others"))
    with pytest.raises(ConfigError, match="weights_sha256"):
        Navigator.load(path, backbone=replace(world.backbone, weights_sha256="1" * 64))
    with pytest.raises(ConfigError, match="threshold is 7"):
        navigate(world, path, threshold=7.0)
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        Navigator.load(tmp_path / "none.pt")
    navigator = navigate(world, path)
    with pytest.raises(GoalError, match=r"there is no goal yet; call goal\(picture\) first"):
        navigator.act(stranger())
    with pytest.raises(
        SceneError, match=r"is 64 x 64 pixels, the rooms' pictures are 64 x 48; set the camera"
    ):
        navigator.goal(np.zeros((64, 64, 3), np.uint8))
    (tmp_path / "goal.jpg").write_bytes(b"no picture")
    with pytest.raises(SceneError, match=r"goal.jpg: is no picture that can be read \(unknown format\)"):
        navigator.goal(tmp_path / "goal.jpg")
    with pytest.raises(SceneError, match=r"none.jpg: cannot be read \(there is no such file\)"):
        navigator.goal(tmp_path / "none.jpg")


def test_scenes_that_do_not_name_their_backbone_ask_for_it(rooms: SceneSet) -> None:
    agent = make_agent("gvf", scenes=rooms, hidden_size=8, embedding_size=8)
    with pytest.raises(ConfigError, match="scene 'hall' does not say which backbone made its features"):
        Navigator(agent, rooms)


def test_a_backbone_of_another_size_is_found_at_the_first_picture(rooms: SceneSet, world: Any) -> None:
    agent = make_agent("gvf", scenes=rooms, hidden_size=8, embedding_size=8)
    with pytest.raises(ConfigError, match="backbone patches gives 48 features, the rooms have 8"):
        Navigator(agent, rooms, world.backbone).goal(world.scenes.pictures(0))


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((48, 64), np.uint8),
        np.zeros((48, 64, 4), np.uint8),
        torch.zeros(48, 64, 3),
        np.zeros((8, 9, 3), np.uint8),
    ],
)
def test_what_is_no_picture_is_refused(picture: Any) -> None:
    with pytest.raises(SceneError, match=r"the picture is \S+ of shape .*; give uint8 \(H, W, 3\)"):
        as_picture(picture)


def test_photographs_are_turned_upright_and_cut(tmp_path: Path) -> None:
    sideways = Image.new("RGB", (30, 40))
    exif = sideways.getexif()
    exif[0x0112] = 6  # the camera was held upright
    sideways.save(tmp_path / "a.jpg", exif=exif)
    assert as_picture(tmp_path / "a.jpg")[0].shape == (30, 40, 3)
    wide = np.arange(100, dtype=np.uint8)[None, :, None].repeat(30, 0).repeat(3, 2)
    cut = in_shape(wide, "wide", [(150, 200)], crop=True)
    assert cut.shape == (30, 40, 3)
    assert cut[0, 0, 0] == 30
    assert in_shape(wide, "wide", [(150, 200), (3, 10)]) is wide  # of one of the rooms


@pytest.mark.skipif(not find_spec("efficientnet_lite_pytorch"), reason="needs vusfa[encode]")
def test_the_bundled_rooms_pictures_through_their_own_backbone() -> None:
    rooms = SceneSet.bundled(["bathroom", "bedroom"])
    agent = make_agent("vusfa", scenes=rooms, history=1, hidden_size=16, embedding_size=16).eval()
    navigator = Navigator(agent, rooms, sample=False)
    assert navigator.backbone is not None
    assert navigator.backbone.name == "efficientnet-lite0"
    assert navigator.goal(rooms.pictures(300)) == "bedroom"
    found = navigator.act(rooms.pictures(310))
    logits = InferencePolicy(agent).logits(torch.tensor([[310]]), torch.tensor([300]), torch.tensor([1]))
    # The bundled pictures are JPEG, the features were made before: not the same numbers.
    assert found.confidence == pytest.approx(logits.softmax(-1).max().item(), abs=0.05)
    assert not found.arrived
    assert navigator.act(rooms.pictures(300)).arrived
