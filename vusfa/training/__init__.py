"""One trainer, and what it needs: collectors, checkpoints, loggers, a progress line.

>>> from vusfa.conf import FOLDER
>>> (FOLDER / "train.yaml").is_file()  # the settings that make_trainer takes
True
"""

from vusfa.deprecated import moved_names
from vusfa.training.checkpoint import (
    checkpoint_file,
    load_agent,
    load_checkpoint,
    rebuild_agent,
    save_checkpoint,
)
from vusfa.training.collectors import check_goals_dealt, make_collector, make_env
from vusfa.training.facts import machine_facts, run_facts
from vusfa.training.folder import RunFolder
from vusfa.training.hogwild import HogwildTrainer
from vusfa.training.loggers import make_loggers
from vusfa.training.metrics import EpisodeMeter, MeanMeter
from vusfa.training.optimization import descend, make_optimizer, total_loss
from vusfa.training.progress import EvaluationProgress, ProgressLine
from vusfa.training.run import run_training
from vusfa.training.scene_files import scene_sources
from vusfa.training.setup import make_observation, make_trainer, row_name, set_threads
from vusfa.training.signals import StopOnSignal
from vusfa.training.trainer import Trainer

__all__ = [
    "EpisodeMeter",
    "EvaluationProgress",
    "HogwildTrainer",
    "MeanMeter",
    "ProgressLine",
    "RunFolder",
    "StopOnSignal",
    "Trainer",
    "check_goals_dealt",
    "checkpoint_file",
    "descend",
    "load_agent",
    "load_checkpoint",
    "machine_facts",
    "make_collector",
    "make_env",
    "make_loggers",
    "make_observation",
    "make_optimizer",
    "make_trainer",
    "rebuild_agent",
    "row_name",
    "run_facts",
    "run_training",
    "save_checkpoint",
    "scene_sources",
    "set_threads",
    "total_loss",
]

__getattr__ = moved_names(
    __name__,
    {
        "HindsightReplay": "vusfa.algorithms.HindsightReplay",
        "HindsightSampler": "vusfa.algorithms.HindsightSampler",
        "annealed": "vusfa.algorithms.annealed",
        "make_loss": "vusfa.algorithms.make_usf_loss",
        "make_optimiser": "vusfa.training.optimization.make_optimizer",
        "make_training": "vusfa.training.setup.make_trainer",
        "Session": "vusfa.training.trainer.Trainer",
        "Training": "vusfa.training.trainer.Trainer",
        "torch_device": "vusfa.envs.scene_env.usable_device",
    },
)
