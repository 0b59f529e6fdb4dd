"""The README's example runs as it stands, and what the README points to exists."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_trains() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(example.strip().splitlines()) <= 25
    torch.manual_seed(0)
    names: dict[str, Any] = {}
    exec(compile(example, "README.md", "exec"), names)
    losses = {key for key in names["terms"].keys() if key.startswith("loss_")}
    assert losses == {
        f"loss_{term}" for term in ("objective", "critic", "successor", "entropy", "bottleneck")
    }
    assert float(names["terms"]["beta"]) >= 0
    assert all(bool(value.isfinite().all()) for value in names["terms"].values())


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\((?!http)([^)#]+)\)", README))))
def test_links_lead_somewhere(link: str) -> None:
    assert (ROOT / link).exists(), f"README.md links to {link}"


@pytest.mark.parametrize("script", sorted(set(re.findall(r"python (\S+\.py)", README))))
def test_recipes_exist(script: str) -> None:
    assert (ROOT / script).is_file()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"^make (\w+)", README, flags=re.MULTILINE))))
def test_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)


def test_continuous_integration_calls_the_readmes_test_command() -> None:
    assert "make test" in README
    commands = [
        line.strip()
        for line in (ROOT / ".ci" / "run").read_text().splitlines()
        if line.strip() and not line.startswith(("#", "set ", "cd ", "export CI="))
    ]
    assert commands == [".ci/packages", "make test"]
    packages = (ROOT / ".ci" / "packages").read_text()
    assert all(f"`{name}`" in README for name in re.findall(r"packages=\((.*)\)", packages)[0].split())
