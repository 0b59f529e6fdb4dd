"""Launchers of jobs: processes of this machine and jobs of Slurm, by Hydra's launchers; tasks of Ray.

Each is a :data:`vusfa.cluster.cells.Launcher`. Machines share the file system, and the folder that the
command was given in is theirs, too.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vusfa.cluster.cells import Job
from vusfa.errors import ConfigError, VusfaError, WorkerError, near
from vusfa.files import say
from vusfa.limits import brief

__all__ = ["launch_locally", "launch_on_ray", "launch_on_slurm"]

#: Options of ``launcher=ray``, with their defaults as text.
_RAY_OPTIONS = {"address": "", "num_cpus": "1", "num_gpus": "0", "memory": "0", "retries": "3"}


def launch_locally(jobs: Sequence[Job], options: Mapping[str, str]) -> None:
    """Launcher ``local``: processes of this machine, by Hydra's Joblib launcher.

    Args:
        jobs: to run.
        options: of that launcher, such as ``n_jobs``; as many processes as processors unless given.
    """
    with TemporaryDirectory() as folder:
        _launch_by_hydra("joblib", jobs, {"verbose": "0", **options}, Path(folder))


def launch_on_slurm(jobs: Sequence[Job], options: Mapping[str, str]) -> None:
    """Launcher ``slurm``: jobs of a Slurm cluster, by Hydra's submitit launcher; returns when all have ended.

    Args:
        jobs: to run, each as a job of an array.
        options: of that launcher: ``partition``, ``timeout_min``, ``cpus_per_task``, ``mem_gb``,
            ``array_parallelism`` and others.
    """
    folder = Path("runs", "slurm", time.strftime("%Y-%m-%d_%H-%M-%S")).absolute()
    say(f"logs of the jobs: {folder}")
    _launch_by_hydra("submitit_slurm", jobs, options, folder)


def _launch_by_hydra(plugin: str, jobs: Sequence[Job], options: Mapping[str, str], folder: Path) -> None:
    try:
        import hydra
        from hydra._internal.callbacks import Callbacks
        from hydra.core.global_hydra import GlobalHydra
        from hydra.core.plugins import Plugins
        from hydra.errors import HydraException
        from hydra.types import HydraContext
        from omegaconf.errors import OmegaConfBaseException
    except ModuleNotFoundError as error:
        raise ConfigError(f"the launcher needs {error.name}: pip install 'vusfa[cluster]'") from error

    quoted = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    settings = [
        f"hydra/launcher={plugin}",
        f"hydra.sweep.dir='{quoted}'",
        "hydra.sweep.subdir=.",
        "hydra.output_subdir=null",
        "hydra/job_logging=none",
        "hydra/hydra_logging=none",
    ]
    GlobalHydra.instance().clear()
    with hydra.initialize(config_path=None, job_name="cells", version_base="1.3"):
        try:
            known = hydra.compose(overrides=settings, return_hydra_config=True).hydra.launcher
        except HydraException as error:
            raise ConfigError(f"Hydra has no launcher {plugin}: pip install 'vusfa[cluster]'") from error
        names = [str(name) for name in known if not str(name).startswith("_")]
        for name in options:
            if name not in names:
                raise ConfigError(f"launcher_options has no {brief(name)}; {near(name, names)}")
        settings += [f"hydra.launcher.{name}={value}" for name, value in options.items()]
        try:
            config = hydra.compose(overrides=settings, return_hydra_config=True)
        except (HydraException, OmegaConfBaseException) as error:
            reason = " ".join(str(error.__cause__ or error).split())
            raise ConfigError(f"launcher_options: {brief(reason)}") from error
        loader = GlobalHydra.instance().config_loader()
        context = HydraContext(config_loader=loader, callbacks=Callbacks(config))
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=context, task_function=partial(_run_numbered, jobs, os.getcwd()), config=config
        )
        try:
            ended = launcher.launch([[f"+job={number}"] for number in range(len(jobs))], initial_job_idx=0)
        except Exception as error:  # a process was killed, Slurm refuses, and others that its libraries raise
            reason = " ".join(str(error).split()) or type(error).__name__
            raise WorkerError(
                f"the launcher has ended early ({brief(reason)}); run the command again"
            ) from error
    _conclude(done.return_value for done in ended)


def _run_numbered(jobs: Sequence[Job], folder: str, config: Any) -> str | VusfaError | None:
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()  # a cell composes settings of its own
    return _outcome(jobs[config.job], folder)


def launch_on_ray(jobs: Sequence[Job], options: Mapping[str, str]) -> None:
    """Launcher ``ray``: tasks of a Ray cluster; one whose machine or process dies is run again.

    Args:
        jobs: to run, each as a task.
        options: ``address`` of the cluster (see :func:`vusfa.cluster.ray_workers.connected`); what a task
            needs: ``num_cpus``, ``num_gpus``, ``memory`` in bytes; ``retries`` of a task that dies.

    Raises:
        ConfigError: an unknown option, Ray is not installed, or no cluster answers.
        WorkerError: a task has died more often than ``retries``.
    """
    from vusfa.cluster.ray_workers import connected

    for name in options:
        if name not in _RAY_OPTIONS:
            raise ConfigError(f"launcher_options has no {brief(name)}; {near(name, _RAY_OPTIONS)}")
    given = {**_RAY_OPTIONS, **options}
    numbers = {name: _number(name, given[name]) for name in _RAY_OPTIONS if name != "address"}
    retries = int(numbers.pop("retries"))
    with connected(given["address"]) as ray:
        _say_if_too_large(ray, numbers)
        task = ray.remote(**{name: value for name, value in numbers.items() if value}, max_retries=retries)(
            _outcome
        )
        waiting = [task.remote(job, os.getcwd()) for job in jobs]
        outcomes: list[str | VusfaError | None] = []
        while waiting:
            (done,), waiting = ray.wait(waiting)
            try:
                outcomes.append(ray.get(done))
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error  # a fault of the program: its traceback
            except ray.exceptions.RayError as error:
                reason = " ".join(str(error).split("\n")[0].split())
                outcomes.append(WorkerError(f"a task has died {retries + 1} times ({brief(reason)})"))
            if isinstance(outcomes[-1], str):
                print(outcomes[-1], flush=True)
    _conclude(outcome for outcome in outcomes if not isinstance(outcome, str))


def _say_if_too_large(ray: Any, needed: Mapping[str, float]) -> None:
    """Say it if no machine of the cluster, as it is now, can run a task."""
    names = {"num_cpus": "CPU", "num_gpus": "GPU"}
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    for name, value in needed.items():
        most = max((machine.get(names.get(name, name), 0) for machine in machines), default=0)
        if value > most:
            say(f"no machine of the cluster has {name}={value:g}, but {most:g} at most: tasks wait for one")


def _outcome(job: Job, folder: str) -> str | VusfaError | None:
    """Run a job in the folder of the command; errors that the user can mend are returned, not raised."""
    try:
        os.chdir(folder)
    except OSError as error:
        reason = f"{os.uname().nodename} has no folder {folder} ({error.strerror})"
        return ConfigError(f"{reason}: the machines of a cluster need a file system that they share")
    try:
        return job()
    except VusfaError as error:
        with suppress(Exception):
            error.__traceback__ = error.__cause__ = error.__context__ = None  # it travels without its causes
        return error


def _conclude(outcomes: Iterable[str | VusfaError | None]) -> None:
    """Print lines; raise the first error, with the number of errors."""
    errors = []
    for outcome in outcomes:
        if isinstance(outcome, str):
            print(outcome, flush=True)
        elif outcome is not None:
            errors.append(outcome)
    if errors:
        more = f" (and {len(errors) - 1} more cells with errors)" if len(errors) > 1 else ""
        raise type(errors[0])(f"{errors[0]}{more}")


def _number(name: str, text: str) -> float:
    with suppress(ValueError):
        if 0 <= (value := float(text)) < float("inf") and (name != "retries" or value.is_integer()):
            return value
    raise ConfigError(f"launcher_options has {name}={brief(text)}; give a number of 0 or more")
