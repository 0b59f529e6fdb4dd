"""Settings that nothing knows, that are missing, or of the wrong kind."""

from __future__ import annotations

from typing import Any

import pytest

from vusfa.errors import ConfigError
from vusfa.training.checks import check_names, check_types


def test_a_whole_number_will_do_for_a_fraction():
    check_types({"lr": 1, "new": "x"}, {"lr": 0.5})
    check_types({"horizon": 5}, {"horizon": None})
    with pytest.raises(ConfigError, match="lr is 'x'"):
        check_types({"lr": "x"}, {"lr": 0.5})
    with pytest.raises(ConfigError, match=r"steps is 0\.5"):
        check_types({"steps": 0.5}, {"steps": 1})


@pytest.mark.parametrize("default", [None, 1000])
@pytest.mark.parametrize(("group", "name"), [("optim", "horizon"), ("entropy", "horizon")])
def test_what_may_be_null_is_still_of_a_kind(group: str, name: str, default: int | None):
    expected = {group: {name: default}}
    check_types({group: {name: None}}, expected)
    check_types({group: {name: 7}}, expected)
    with pytest.raises(ConfigError, match=rf"{group}.{name} is 'abc'; it must be a whole number.* or null"):
        check_types({group: {name: "abc"}}, expected)
    for value in (0, -1):
        with pytest.raises(ConfigError, match=rf"{group}.{name} is {value}; it must be more than 0"):
            check_types({group: {name: value}}, expected)


@pytest.mark.parametrize(
    ("value", "default", "words"),
    [
        (None, 1, "is null; it must be a whole number, such as 1"),
        (None, "cpu", "is null; it must be text, such as 'cpu'"),
        (None, ["a", "b"], r"is null; it must be a list, such as \[a, b\]"),
        ("a", ["a", "b"], r"is 'a'; it must be a list, such as \[a, b\]"),
        (["a", 1], ["a", "b"], r"is \[a, 1\]; each entry must be as in \[a, b\]"),
        (1, True, "is 1; it must be true or false"),
    ],
)
def test_every_kind_has_its_words(value: Any, default: Any, words: str):
    with pytest.raises(ConfigError, match=f"^key {words}$"):
        check_types({"key": value}, {"key": default})


def test_some_settings_take_several_kinds():
    check_types({"scenes": "kitchen", "env": {"goals": [3]}}, {"scenes": ["hall"], "env": {"goals": "paper"}})
    check_types({"agent": {"encoder": None}}, {"agent": {"encoder": "conv"}})
    with pytest.raises(ConfigError, match=r"agent\.preset is null"):
        check_types({"agent": {"preset": None}}, {"agent": {"preset": "controlled"}})


def test_names_are_those_of_the_defaults():
    defaults = {
        "agent": {"model": "gvf"},
        "env": {"goals": "paper"},
        "optim": {"lr": 1.0, "options": {"eps": 1.0}},
    }
    check_names(defaults, defaults)
    check_names(
        {
            "agent": {"model": "gvf", "foo": 1},
            "env": {"goals": {"hall": [1]}},
            "optim": {"lr": 1, "options": {"betas": [0, 1]}},
        },
        defaults,
    )
    for change, words in (
        ({"optim": {"lr": 1, "lrr": 2}}, "no setting is called 'optim.lrr'; did you mean 'optim.lr'"),
        ({"optim": {"lr": 1, "options": None}}, "optim.options is null; it is a group of settings"),
        ({"optim": {}}, "optim.lr is missing; it may be 1.0"),
        ({"agent": {}}, "agent.model is missing; it may be 'gvf'"),
        ({"env": None}, r"env is null; it is a group of settings: give env.goals=\.\.\.$"),
    ):
        with pytest.raises(ConfigError, match=words):
            check_names({**defaults, **change}, defaults)
