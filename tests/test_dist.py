"""The check of a built wheel and sdist, .ci/check-dist, with small archives; the commands of the trial."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import io
import re
import subprocess
import tarfile
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from PIL import Image

ROOT = Path(__file__).parents[1]
WHEEL, SOURCE = "vusfa-1.0-py3-none-any.whl", "vusfa-1.0.tar.gz"


@pytest.fixture(scope="module")
def check() -> ModuleType:
    loader = importlib.machinery.SourceFileLoader("check_dist", str(ROOT / ".ci" / "check-dist"))
    spec = importlib.util.spec_from_loader("check_dist", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def build(folder: Path, wheel: list[str], source: list[str], name: str = SOURCE) -> Path:
    with zipfile.ZipFile(folder / WHEEL, "w") as archive:
        for entry in wheel:
            archive.writestr(entry, "")
    with tarfile.open(folder / name, "w:gz") as tar:
        for entry in source:
            tar.addfile(tarfile.TarInfo(f"vusfa-1.0/{entry}"), io.BytesIO())
    return folder


def sound(check: ModuleType) -> tuple[list[str], list[str]]:
    licences = ["LICENSE", "CREDITS.md"]
    return [*check.INSIDE, *(f"vusfa-1.0.dist-info/licenses/{name}" for name in licences)], [
        *check.INSIDE,
        *licences,
    ]


def test_what_is_checked_for_is_in_the_package(check: ModuleType) -> None:
    assert not [name for name in check.INSIDE if not (ROOT / name).is_file()]


def test_sound_ones_have_no_faults(check: ModuleType, tmp_path: Path) -> None:
    assert check.faults(build(tmp_path, *sound(check))) == []


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        ("vusfa/__pycache__/a.pyc", "vusfa/__pycache__/a.pyc should not be in it"),
        ("runs/first/checkpoint.pt", "runs/first/checkpoint.pt should not be in it"),
        ("tests/test_a.py", "tests/test_a.py would be installed beside the package"),
    ],
)
def test_what_should_not_be_inside(check: ModuleType, tmp_path: Path, more: str, fault: str) -> None:
    wheel, source = sound(check)
    assert f"{WHEEL}: {fault}" in check.faults(build(tmp_path, [*wheel, more], source))


def test_what_is_missing_or_too_large(
    check: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel, source = sound(check)
    build(tmp_path, wheel[1:-1], source[1:])
    found = check.faults(tmp_path)
    assert found == [
        f"{WHEEL}: {check.INSIDE[0]} is missing",
        f"{WHEEL}: CREDITS.md is missing",
        f"{SOURCE}: {check.INSIDE[0]} is missing",
    ]
    monkeypatch.setattr(check, "LIMIT", 10)
    assert sum("more than 0" in line for line in check.faults(tmp_path)) == 2


def test_two_versions_or_no_wheel(check: ModuleType, tmp_path: Path) -> None:
    build(tmp_path, *sound(check), name="vusfa-2.0.tar.gz")
    assert check.faults(tmp_path) == [f"{WHEEL} and vusfa-2.0.tar.gz are not of one version"]
    (tmp_path / WHEEL).unlink()
    assert check.faults(tmp_path) == [f"{tmp_path}: 0 wheels and 1 sdists; there should be one of each"]


def test_the_trial_is_a_script_that_runs_the_start_pages_commands() -> None:
    script = ROOT / ".ci" / "try-wheel"
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
    tried = {words[1] for words in map(str.split, re.findall(r"^say (.*)", script.read_text(), re.MULTILINE))}
    page = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    named = {line.split()[1] for line in re.findall(r"^vusfa .*", page, re.MULTILINE)} - {"--help"}
    assert named <= tried


def test_public_ci_runs_what_there_is() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    makefile = (ROOT / "Makefile").read_text()
    targets = [line.split()[1] for line in commands if line.startswith("make ")]
    assert set(targets) == {"test", "docs", "dist"}
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    scripts = [word for line in commands for word in line.split() if word.startswith(".ci/")]
    assert scripts == [".ci/packages", ".ci/try-wheel"]
    assert all((ROOT / script).stat().st_mode & 0o100 for script in [*scripts, ".ci/check-dist"])


def test_the_readme_opens_with_a_film() -> None:
    with Image.open(ROOT / "docs" / "walk.gif") as film:
        assert film.n_frames > 10
    assert (ROOT / "docs" / "walk.gif").stat().st_size < 2_000_000
    for page in ("README.md", "docs/index.md"):
        assert "vusfa film vusfa" in (ROOT / page).read_text(encoding="utf-8")


def test_one_version_everywhere() -> None:
    import vusfa

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == vusfa.__version__
    assert f"## {vusfa.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"vusfa-{vusfa.__version__}-py3" in (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
