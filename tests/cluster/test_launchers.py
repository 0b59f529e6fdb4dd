"""Hydra's launchers of cells, with a Slurm of two shell scripts."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path

import pytest

import vusfa.cluster  # noqa: F401
from tests.cluster import work
from vusfa.cluster.cells import Cell, run_cells
from vusfa.errors import ConfigError, SceneError

#: What Hydra's launcher uses of Slurm: sbatch begins an array's jobs in the background, srun runs a command.
SBATCH = """#!/usr/bin/env bash
set -eu
script="${@: -1}"
export SLURM_ARRAY_JOB_ID=7 SLURM_JOB_ID=7 SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0
export SLURM_JOB_NODELIST=here
export SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_JOB_PARTITION=small
last="$(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\)%.*/\\1/p' "$script")"
for task in $(seq 0 "${last:-0}"); do
    SLURM_ARRAY_TASK_ID="$task" bash "$script" >"$script.$task.log" 2>&1 &
done
grep '^#SBATCH' "$script" >"${0%/*}/asked"
echo "Submitted batch job 7"
"""
SRUN = """#!/usr/bin/env bash
while [ "${1#--}" != "$1" ]; do
    case "$1" in --output|--error) shift 2 ;; *) shift ;; esac
done
exec "$@"
"""


def cells_of(folder: Path, names: str, log: Path) -> list[Cell]:
    return [Cell(folder / name, partial(work.make, folder / name, log)) for name in names]


def ends(log: Path) -> Counter[str]:
    return Counter(line.split()[1] for line in log.read_text().splitlines() if line.startswith("end"))


def test_processes_of_this_machine(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Two cells with errors do not stop the others; the command ends with the first error."""
    log, results = tmp_path / "log", tmp_path / "results"
    faulty = [Cell(results / name, partial(work.fail, name)) for name in "ef"]
    with pytest.raises(SceneError) as error:
        run_cells([*faulty, *cells_of(results, "abcd", log)], "local", ["n_jobs=2"])
    assert str(error.value) == "e.h5: dataset 'graph' is missing (and 1 more cells with errors)"
    assert ends(log) == Counter("abcd")
    assert sorted(capfd.readouterr().out.splitlines()) == [f"made {name}" for name in "abcd"]


def test_jobs_of_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", "#!/usr/bin/env bash\n")):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{Path('/usr/bin')}:{Path('/bin')}")
    monkeypatch.setenv("PYTHONPATH", str(Path(work.__file__).parents[2]))  # jobs import the cells' functions
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log"
    run_cells(cells_of(tmp_path / "results", "ab", log), "slurm", ["partition=small", "timeout_min=5"])
    assert ends(log) == Counter("ab")
    asked = (programs / "asked").read_text()
    assert "#SBATCH --partition=small" in asked
    assert "#SBATCH --time=5" in asked


@pytest.mark.parametrize(
    ("launcher", "option", "message"),
    [
        ("local", "n_job=2", "launcher_options has no 'n_job'; did you mean 'n_jobs'"),
        ("local", "n_jobs=two", "launcher_options: .*'two'"),
        ("slurm", "partitions=a", "launcher_options has no 'partitions'; did you mean 'partition'"),
        ("ray", "cpus=2", "launcher_options has no 'cpus'; did you mean 'num_cpus'"),
        ("ray", "num_cpus=some", "launcher_options has num_cpus='some'; give a number of 0 or more"),
        ("ray", "retries=1.5", "launcher_options has retries='1.5'"),
        ("ray", "num_gpus=-1", "launcher_options has num_gpus='-1'"),
    ],
)
def test_options_that_a_launcher_does_not_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launcher: str, option: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        run_cells(cells_of(tmp_path / "results", "a", tmp_path / "log"), launcher, [option])
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(("launcher", "missing"), [("ray", "ray"), ("local", "hydra"), ("slurm", "hydra")])
def test_without_the_extra_one_error_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launcher: str, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"pip install 'vusfa\[cluster\]'$"):
        run_cells(cells_of(tmp_path / "results", "a", tmp_path / "log"), launcher)


def test_importing_the_package_imports_neither_ray_nor_torch() -> None:
    code = "import sys, vusfa.cluster; print(sorted({'ray', 'torch', 'hydra'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
