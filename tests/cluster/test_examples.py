"""examples/cluster/, as far as one machine can check it: keys that Ray knows, commands that exist."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from tests.docs.test_pages import options_of
from vusfa.conf.schema import check_overrides, validated

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "cluster"
FILES = sorted(FOLDER.iterdir())


def content(name: str) -> Any:
    return yaml.safe_load((FOLDER / name).read_text(encoding="utf-8"))


def commands(path: Path) -> Iterator[list[str]]:
    """The words of every command of vusfa in a file, those in comments included."""
    text = re.sub(r"\n#? *(?=launcher)", " ", path.read_text(encoding="utf-8"))
    for command in re.findall(r"vusfa (?:train|table1|transfer|generalise|evaluate)[^\n`'\"]*", text):
        yield shlex.split(command)


def test_there_is_an_example_of_each() -> None:
    assert [path.name for path in FILES] == ["Dockerfile", "kuberay.yaml", "ray.yaml", "slurm.sh"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_its_commands_exist(path: Path, settings: Any) -> None:
    found = list(commands(path))
    assert found or path.name == "Dockerfile"
    for words in found:
        if words[1] == "train":
            overrides = words[2:]
            check_overrides(overrides)
            assert validated(settings(*overrides))["cluster"]["kind"] == "ray"
            continue
        name, rest, options = options_of(words)
        for word in rest:
            assert f"--{word.partition('=')[0].replace('_', '-')}" in options, (name, word)


def test_the_autoscalers_file_has_rays_keys() -> None:
    import ray

    schema = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
    cluster = content("ray.yaml")
    jsonschema.validate(cluster, schema)
    assert cluster["head_node_type"] in cluster["available_node_types"]
    with pytest.raises(jsonschema.ValidationError, match="max_worker"):
        jsonschema.validate({**cluster, "max_worker": 2}, schema)


def test_the_job_of_kubernetes_has_what_a_ray_job_needs() -> None:
    import ray

    job = content("kuberay.yaml")
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    known = {
        "entrypoint",
        "shutdownAfterJobFinishes",
        "ttlSecondsAfterFinished",
        "backoffLimit",
        "rayClusterSpec",
    }
    assert set(job["spec"]) <= known
    cluster = job["spec"]["rayClusterSpec"]
    assert cluster["rayVersion"] == ray.__version__
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    for group in groups:
        pod = group["template"]["spec"]
        (container,) = pod["containers"]
        mounted = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
        assert mounted == {"shared": "/shared"}
        assert {volume["name"] for volume in pod["volumes"]} == set(mounted)
        assert container["resources"]["limits"].keys() == container["resources"]["requests"].keys()
    assert all(group["minReplicas"] <= group["replicas"] <= group["maxReplicas"] for group in groups[1:])


def test_the_script_of_slurm_is_one_command_of_ray(tmp_path: Path) -> None:
    """Run with programs that print what they are called with."""
    for name, text in (("scontrol", "printf 'one\\ntwo\\n'"), ("srun", 'printf "%s\\n" "$@"')):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    slurm = {
        "SLURM_JOB_NODELIST": "one,two",
        "SLURM_JOB_ID": "12",
        "SLURM_JOB_NUM_NODES": "2",
        "SLURM_CPUS_PER_TASK": "8",
    }
    done = subprocess.run(
        ["bash", str(FOLDER / "slurm.sh"), "vusfa", "--help"],
        env={**slurm, "PATH": f"{tmp_path}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
    )
    said = done.stdout.splitlines()
    assert said[1:5] == ["ray", "symmetric-run", "--address", "one:6412"]
    assert said[-3:] == ["--", "vusfa", "--help"]

    from ray.scripts.symmetric_run import symmetric_run

    options = {name for option in symmetric_run.params for name in option.opts}
    assert {"--address", "--min-nodes"} <= options


def test_the_image_copies_what_there_is_and_installs_an_extra_that_there_is() -> None:
    text = re.sub(r"\\\n *", "", (FOLDER / "Dockerfile").read_text(encoding="utf-8"))
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    assert [name for name, _ in lines if name in ("FROM", "CMD")] == ["FROM", "CMD"]
    assert {name for name, _ in lines} == {"FROM", "ARG", "WORKDIR", "COPY", "RUN", "ENV", "CMD"}
    for name, rest in lines:
        if name == "COPY":
            *sources, target = rest.split()
            assert target.startswith("./")
            assert all((ROOT / source).exists() for source in sources), rest
        if name == "RUN":
            assert subprocess.run(["bash", "-n", "-c", rest], check=False).returncode == 0
    assert dict(line for line in lines if line[0] == "ARG")["ARG"] == "TORCH=cpu"
    assert "whl/${TORCH} torch" in text
    assert json.loads(lines[-1][1]) == ["vusfa", "--help"]
    extras = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert all(f"\n{extra} = [" in extras for extra in re.findall(r'"\.\[(\w+)\]"', text))
