"""Settings that would exhaust the machine, and values that are no numbers: one bounded line each."""

from __future__ import annotations

import pytest

from vusfa.cli.launch import explain
from vusfa.conf import FOLDER
from vusfa.conf.compose import compose
from vusfa.conf.schema import register_schema, validated
from vusfa.errors import ConfigError
from vusfa.training import set_threads


def checked(*overrides: str) -> dict:
    register_schema()
    settings = compose(overrides=["env.goals=[3]", *overrides])
    from omegaconf import OmegaConf

    OmegaConf.resolve(settings)
    return validated(settings)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("threads=1000000000", "threads is 1000000000; it must be at most 1,024"),
        ("collector.num_workers=1000000", "collector.num_workers is 1000000; it must be at most 1,024"),
        ("hindsight.capacity=10000000000000", "hindsight.capacity is 10000000000000; it must be at most"),
        ("hindsight.batch_size=10000000000000", "hindsight.batch_size is 1"),
        ("optim.lr=nan", "optim.lr is nan; it must be a finite number"),
        ("objective.bottleneck_coeff=nan", "objective.bottleneck_coeff is nan"),
        ("entropy.end=inf", "entropy.end is inf"),
        ("env.goal_reward=-inf", "env.goal_reward is -inf"),
    ],
)
def test_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        checked(override)


def test_of_an_algorithm() -> None:
    with pytest.raises(
        ConfigError, match=r"^algorithm\.batch_size is 10000000000000; it must be at most 16,777"
    ):
        checked("algorithm=replay_search", "algorithm.batch_size=10000000000000")
    with pytest.raises(ConfigError, match=r"^algorithm\.path_share is nan; it must be a finite number"):
        checked("algorithm=replay_search", "algorithm.path_share=nan")
    for name in ("capacity", "policy_pairs", "horizon"):
        with pytest.raises(ConfigError, match=f"algorithm.{name} is 10000000000000; it must be at most"):
            checked("algorithm=contrastive", f"algorithm.{name}=10000000000000")


def test_keys_of_a_mapping_are_given_as_the_documents_say() -> None:
    for given in ("env.scene_weights={hall: 2, attic: 0.5}", "env.scene_weights.hall=2"):
        assert checked(given)["env"]["scene_weights"]["hall"] == 2.0
    both = checked("env.scene_weights={hall: 2}", "env.scene_weights.hall=3", "env.scene_weights.attic=1")
    assert both["env"]["scene_weights"] == {"hall": 3.0, "attic": 1.0}
    assert checked("optim.options={eps: 0.5}")["optim"]["options"]["eps"] == 0.5
    assert checked("optim.options.weight_decay=0.1")["optim"]["options"]["weight_decay"] == 0.1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.scene_weights=[1]", "env.scene_weights is '[1]'; it is a group of settings"),
        ("env.scene_weights.hall=x", "env.scene_weights.hall is 'x'; it must be a number"),
        ("scenes={a: 1}", "scenes is '{a: 1}'; it must be "),
        ("algorithm.updates=2.5", "algorithm.updates is 2.5; it must be a whole number"),
        ("algorithm=" + "x" * 3000, "algorithm=xxx"),
    ],
)
def test_errors_of_hydra_are_a_bounded_line(override: str, message: str) -> None:
    register_schema()
    with pytest.raises(Exception) as error:  # noqa: PT011
        compose(overrides=["algorithm=replay_search", override])
    line = explain(error.value, FOLDER)
    assert line.startswith(message)
    assert len(line) < 400


@pytest.mark.parametrize("threads", [0, -1, 10**9])
def test_threads(threads: int) -> None:
    with pytest.raises(ConfigError, match=r"threads is -?\d+; give 1 to 1,024"):
        set_threads(threads)
