"""Data-parallel learners as a job of Ray Train: ``vusfa train cluster=ray``.

Every worker of the job is one rank of torch.distributed and runs :func:`vusfa.experiments.training.train`.
When a worker or its machine dies, Ray ends the others and starts all anew, and these go on from the last
checkpoint of the run's folder, which lies on a file system that all machines share.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vusfa.cluster.locks import FileLock, LockedError
from vusfa.cluster.ray_workers import connected
from vusfa.errors import ConfigError, VusfaError, WorkerError
from vusfa.experiments.training import train
from vusfa.experiments.validation import Draw
from vusfa.files import check_folder
from vusfa.limits import brief
from vusfa.training import RunFolder, make_trainer
from vusfa.training.folder import AUTO, CHECKPOINT, default_folder, found_checkpoint
from vusfa.training.ranks import check_ranks

__all__ = ["train_on_ray"]


def train_on_ray(settings: Mapping[str, Any], overrides: Sequence[str] = (), draw: Draw | None = None) -> int:
    """Train with data-parallel learners on a Ray cluster; what a run leaves is as that of one process.

    Args:
        settings: as in vusfa/conf/train.yaml, resolved. ``cluster`` has the number of workers, what each
            needs, and how often the job may restart.
        overrides: their command line, recorded in checkpoints.
        draw: see :func:`vusfa.experiments.training.train`.

    Returns:
        the exit code, 0.

    Raises:
        ConfigError: Ray is not installed, no cluster answers, or settings that make no sense; before any
            work.
        WorkerError: workers have died more often than ``cluster.max_failures``.
        VusfaError: see :func:`vusfa.experiments.training.train`.
    """
    chosen: dict[str, Any] = dict(settings["cluster"])
    workers = _number_of_workers(chosen)
    plain: dict[str, Any] = {"overwrite": False, "resume": None, "name": "run", **settings}
    folder = Path(plain["folder"] or default_folder(plain)).absolute()
    plain["folder"] = str(check_folder(folder, "folder"))
    for size in {chosen["workers"], chosen["min_workers"] or chosen["workers"]} - {1}:
        check_ranks(plain, size)
    if plain["resume"] == AUTO:
        plain["resume"] = found_checkpoint(folder)
    with connected(chosen["address"], log_to_driver=True):
        from ray.train import FailureConfig, RunConfig, ScalingConfig
        from ray.train.torch import TorchTrainer

        RunFolder(folder, plain)  # refused now rather than by every worker
        _check_free(folder)
        make_trainer(plain, overrides)
        resources = {"CPU": 1.0, **chosen["resources"]}
        begun = {"settings": plain, "overrides": list(overrides), "draw": draw, "cwd": os.getcwd()}
        job = TorchTrainer(
            _learn,
            train_loop_config={**begun, "checkpoint": _stamp(folder)},
            scaling_config=ScalingConfig(
                num_workers=workers, use_gpu=resources.get("GPU", 0) > 0, resources_per_worker=resources
            ),
            run_config=RunConfig(
                name="ray_train",
                storage_path=str(folder),
                failure_config=FailureConfig(max_failures=chosen["max_failures"]),
            ),
        )
        try:
            job.fit()
        except Exception as error:
            raise _explained(error, folder) from error
    return 0


def _number_of_workers(chosen: Mapping[str, Any]) -> int | tuple[int, int]:
    if chosen["kind"] != "ray":
        raise ConfigError(f"cluster.kind is {brief(chosen['kind'])}; it must be ray or null")
    most, fewest = chosen["workers"], chosen["min_workers"]
    if most < 1:
        raise ConfigError(f"cluster.workers is {brief(most)}; it must be 1 or more")
    if fewest is not None and not 1 <= fewest <= most:
        raise ConfigError(f"cluster.min_workers is {brief(fewest)}; it must be 1 to cluster.workers ({most})")
    if chosen["max_failures"] < 0:
        raise ConfigError(f"cluster.max_failures is {brief(chosen['max_failures'])}; it must be 0 or more")
    return most if fewest in (None, most) else (fewest, most)


def _stamp(folder: Path) -> int | None:
    """When the last checkpoint of a folder was written."""
    path = folder / CHECKPOINT
    return path.stat().st_mtime_ns if path.is_file() else None


def _check_free(folder: Path) -> None:
    """Workers wait for those of this job that were there before; another job is none of these."""
    try:
        with suppress(FileNotFoundError), FileLock(folder / ".lock"):
            pass
    except LockedError as error:
        raise ConfigError(
            f"folder is '{folder}', where {error.owner} is writing a run; wait for it, or give another folder"
        ) from error


def _learn(begun: Mapping[str, Any]) -> None:
    """A worker's training; one that Ray has restarted goes on from the last checkpoint."""
    os.chdir(begun["cwd"])
    settings = dict(begun["settings"])
    folder = Path(settings["folder"])
    with FileLock(folder / ".lock", wait=True):  # until a worker that wrote there before has ended
        found = _stamp(folder)  # hence the same for all workers
    if found not in (None, begun["checkpoint"]):
        settings["resume"] = str(folder / CHECKPOINT)
    train(settings, begun["overrides"], begun["draw"])


def _explained(error: BaseException, folder: Path) -> Exception:
    """The error of a training as the user may get it."""
    failures: Any = getattr(error, "worker_failures", None) or {}
    causes = [getattr(failure, "_base_exc", failure) for failure in failures.values()]
    for cause in causes:
        if isinstance(cause, VusfaError):
            return cause
    reason = " ".join(str(causes[0] if causes else error).split()) or type(error).__name__
    kept = f"resume from {folder / CHECKPOINT}" if _stamp(folder) else "there is no checkpoint yet"
    return WorkerError(f"the Ray Train job has ended early ({brief(reason)}); {kept}")
