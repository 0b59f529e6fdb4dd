"""Agents in scenes that they were not made for: refused wherever an agent meets scenes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.collectors import Collector

from vusfa.deploy import Navigator
from vusfa.envs import SceneObservation, TargetNavEnv
from vusfa.errors import ConfigError
from vusfa.evaluation import evaluate
from vusfa.evaluation.exact import exact_goals, expected_walks
from vusfa.evaluation.navigation import trails
from vusfa.modules import InferencePolicy, TabularPolicy, make_agent, transplant
from vusfa.scenes import Scene, SceneSet, check_home
from vusfa.training import make_collector, make_trainer
from vusfa.training.trainer import Trainer

SMALL: dict[str, Any] = {"history": 1, "hidden_size": 8, "embedding_size": 8}
GOALS = torch.tensor([3])
OTHERS = r"scenes are \['attic'\], and the agent was made for \['hall'\]; give it its own scenes, or "


@pytest.fixture
def hall(make_scene: Callable[..., Scene]) -> SceneSet:
    """Larger than the attic, so that no id is out of range there."""
    return SceneSet([make_scene("hall")])


@pytest.fixture
def attic(make_scene: Callable[..., Scene]) -> SceneSet:
    return SceneSet([make_scene("attic", 3, 1)])


MEETINGS: dict[str, Callable[[Any, SceneSet], object]] = {
    "evaluate": lambda agent, scenes: evaluate(InferencePolicy(agent), scenes, [3], history=1),
    "evaluate, actor": lambda agent, scenes: evaluate(agent.get_policy_operator(), scenes, [3], history=1),
    "trails": lambda agent, scenes: trails(InferencePolicy(agent), scenes, GOALS, GOALS + 1, history=1),
    "rollout": lambda agent, scenes: TargetNavEnv(scenes, [3], history=1).rollout(2, InferencePolicy(agent)),
    "rollout, actor": lambda agent, scenes: TargetNavEnv(scenes, [3], history=1).rollout(
        2, policy=agent.get_policy_operator()
    ),
    "TorchRL's collector": lambda agent, scenes: collector(scenes, agent.get_policy_operator()),
    "TorchRL's collector, InferencePolicy": lambda agent, scenes: collector(scenes, InferencePolicy(agent)),
    "make_collector": lambda agent, scenes: make_collector(
        "multi_sync",
        partial(TargetNavEnv, scenes, [3], history=1),
        InferencePolicy(agent),
        num_envs=2,
        num_workers=2,
        rollout=2,
    ),
    "TabularPolicy": TabularPolicy,
    "cached": lambda agent, scenes: InferencePolicy(agent).cached(GOALS, scenes).__enter__(),
    "Navigator": Navigator,
}


def collector(scenes: SceneSet, policy: Any, *transforms: Any) -> Collector:
    env = TargetNavEnv(scenes, [3], [2], history=1)
    for transform in transforms:
        env = env.append_transform(transform)
    return Collector(env, policy, frames_per_batch=4, total_frames=4, auto_register_policy_transforms=False)


@pytest.mark.parametrize("meeting", MEETINGS)
def test_refused_in_other_scenes(meeting: str, hall: SceneSet, attic: SceneSet) -> None:
    agent = make_agent("vusfa", scenes=hall, **SMALL).eval()
    with pytest.raises(ConfigError, match=OTHERS):
        MEETINGS[meeting](agent, attic)


def test_a_table_in_other_scenes(hall: SceneSet, attic: SceneSet) -> None:
    table = TabularPolicy(make_agent("gvf", scenes=hall, **SMALL), hall)
    for use in (
        lambda: exact_goals(table.probabilities, attic),
        lambda: expected_walks(table.probabilities, attic, GOALS),
        lambda: evaluate(table, attic, [3], history=1),
        lambda: collector(attic, table),
    ):
        with pytest.raises(ConfigError, match=OTHERS):
            use()


def test_a_trainer_of_an_agent_of_other_scenes(
    settings: Callable[..., Any], scene_file: Path, attic: SceneSet
) -> None:
    small = ["agent.hidden_size=8", "agent.embedding_size=8", "env.goals=[3]", "collector.num_envs=2"]
    good = make_trainer({**settings(f"scenes=[{scene_file}]", *small)})
    with pytest.raises(ConfigError, match=OTHERS):
        Trainer(attic, GOALS, good.agent, good.algorithm, good.optimizer, lambda _: None, good.settings)  # type: ignore[arg-type,return-value]


def test_the_same_names_with_other_content(hall: SceneSet, make_scene: Callable[..., Scene]) -> None:
    """Its table of features is not theirs; an agent that reads features sees theirs."""
    moved = make_scene("hall", 3, 1)
    agent = make_agent("gvf", scenes=hall, **SMALL)
    with pytest.raises(ConfigError, match=r"scenes \['hall'\] are called as the agent's, but their graphs"):
        check_home(agent, SceneSet([moved]))
    check_home(make_agent("gvf", scenes=hall, observation="features", **SMALL), SceneSet([moved]))


def test_scenes_in_another_order_or_some_of_them(rooms: SceneSet) -> None:
    """Heads are found by the scene's index."""
    for observation in ("index", "features"):
        agent = make_agent("gvf", scenes=rooms, observation=observation, **SMALL)
        for scenes in (rooms.scenes[::-1], rooms.scenes[:1], rooms.scenes[1:]):
            with pytest.raises(ConfigError, match="give it its own scenes, or train one with shared_heads"):
                check_home(agent, SceneSet(scenes))


def test_shared_heads_go_where_features_and_actions_fit(
    hall: SceneSet, attic: SceneSet, make_scene: Callable[..., Scene]
) -> None:
    seeing = make_agent("gvf", scenes=hall, observation="features", shared_heads=True, **SMALL)
    observation = SceneObservation(attic, "features")
    evaluate(InferencePolicy(seeing), attic, [3], history=1, max_steps=3, observe=observation)
    collector(attic, seeing.get_policy_operator(), observation).shutdown()
    by_id = make_agent("gvf", scenes=hall, shared_heads=True, **SMALL)
    with pytest.raises(ConfigError, match=r"or take it to these with vusfa\.modules\.transplant"):
        evaluate(InferencePolicy(by_id), attic, [3], history=1)
    evaluate(InferencePolicy(transplant(by_id, attic)), attic, [3], history=1, max_steps=3)
    wider = Scene("wider", make_scene("hall").graph, torch.rand(16, 1, 3))
    with pytest.raises(ConfigError, match="have 3 features per picture, and the agent was made for 8"):
        check_home(seeing, SceneSet([wider]))
    fewer = Scene("fewer", torch.tensor([[1, -1], [0, -1]]), torch.rand(2, 1, 8))
    with pytest.raises(ConfigError, match="have 2 actions, and the agent was made for 4"):
        check_home(seeing, SceneSet([fewer]))


def test_names_in_place_of_scenes(hall: SceneSet) -> None:
    agent = make_agent("gvf", scenes=hall, shared_heads=True, **SMALL)
    for use in (
        lambda: make_agent("gvf", scenes=["bathroom"]),
        lambda: transplant(agent, ["bathroom"]),
        lambda: evaluate(InferencePolicy(agent), ["bathroom"], [3]),
    ):
        with pytest.raises(ConfigError, match=r"scenes is \['bathroom'\]; give a SceneSet, such as"):
            use()


def test_what_is_no_agent_is_not_judged(attic: SceneSet, hall: SceneSet) -> None:
    agent = make_agent("gvf", scenes=hall, **SMALL)
    for policy in (None, torch.nn.Linear(1, 1), lambda data: data, "modules"):
        check_home(policy, attic)
    check_home(torch.nn.Linear(1, 1), None)
    with pytest.raises(ConfigError, match="made for"):
        check_home(torch.nn.Sequential(torch.nn.Linear(1, 1), agent), attic)


def test_many_scenes_make_a_short_message(hall: SceneSet, make_scene: Callable[..., Scene]) -> None:
    many = SceneSet([make_scene(f"room {i}", 1, 2) for i in range(40)])
    with pytest.raises(ConfigError, match="made for") as error:
        check_home(make_agent("gvf", scenes=many, **SMALL), hall)
    assert len(str(error.value)) < 400


def test_the_fingerprint_is_computed_once(hall: SceneSet, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = TargetNavEnv(hall, [3]).scenes
    agent = make_agent("gvf", scenes=hall, **SMALL)
    monkeypatch.setattr("hashlib.sha256", None)
    check_home(agent, copy)
    check_home(agent, hall.to("cpu"))
    assert copy.fingerprint == agent.config["fingerprint"]
