"""Old names: they give the very objects, and warn with the new name."""

from __future__ import annotations

import importlib
import sys

import pytest

from vusfa.deprecated import MOVED_MODULES, moved_names


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
