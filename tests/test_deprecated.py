"""Old names: they give the very objects, and warn with the new name."""

from __future__ import annotations

import importlib
import re
import sys

import pytest

from vusfa.deprecated import MOVED_MODULES, REMOVED_MODULES, REMOVED_NAMES, moved_names


@pytest.mark.parametrize("old", MOVED_MODULES)
def test_an_old_module_is_the_new_one_and_warns(old: str) -> None:
    new = MOVED_MODULES[old]
    try:
        module = importlib.import_module(new)
    except ModuleNotFoundError as error:  # of an extra that is not installed
        pytest.skip(str(error))
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=new.replace(".", r"\.")):
        assert importlib.import_module(old) is module
    assert module.__spec__ is not None
    assert module.__spec__.name == new


def test_a_module_inside_a_moved_package_moves_with_it() -> None:
    with pytest.warns(DeprecationWarning, match=r"vusfa\.sources\.render\.plan"):
        old = importlib.import_module("vusfa.scenes.render.plan")
    assert old is importlib.import_module("vusfa.sources.render.plan")


def test_a_module_that_never_was_is_missing_as_ever() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"vusfa\.scenes\.nothing"):
        importlib.import_module("vusfa.scenes.nothing")


def test_moved_names_finds_warns_and_refuses() -> None:
    find = moved_names("vusfa.old", {"root": "math.sqrt"})
    with pytest.warns(DeprecationWarning, match=r"vusfa\.old\.root is called math\.sqrt"):
        assert find("root")(9.0) == 3.0
    with pytest.raises(AttributeError, match="has no attribute 'other'"):
        find("other")


@pytest.mark.parametrize("name", REMOVED_NAMES)
def test_a_name_that_is_gone_says_what_to_use(name: str) -> None:
    home = "vusfa.objectives" if name == "n_step_return" else "vusfa.modules"
    with pytest.raises(ImportError, match=rf"{home}\.{name} is not in version 0\.2 any more: .*\w"):
        exec(f"from {home} import {name}")


@pytest.mark.parametrize("name", REMOVED_MODULES)
def test_a_module_that_is_gone_says_what_to_use(name: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=rf"{name} is not in version 0\.2 any more: vusfa"):
        importlib.import_module(name)


@pytest.mark.parametrize("instead", [*REMOVED_NAMES.values(), *REMOVED_MODULES.values()])
def test_what_to_use_instead_is_there(instead: str) -> None:
    place = re.search(r"vusfa(?:\.\w+)+", instead)
    if place is None:
        assert instead.startswith("agent.get_policy_operator()")
        return
    _, room, *names = place[0].split(".")
    found = importlib.import_module(f"vusfa.{room}")
    for each in names:
        found = getattr(found, each)
