"""What a training needs around the objectives: collectors, loggers, a progress line, checkpoints.

``recipes/train.py`` puts them together.
"""

from vusfa.training.checkpoint import load_checkpoint, save_checkpoint
from vusfa.training.collectors import check_goals_dealt, make_collector, make_env
from vusfa.training.facts import machine_facts, run_facts
from vusfa.training.learning import annealed, descend, make_loss, make_optimiser, total_loss
from vusfa.training.loggers import make_loggers
from vusfa.training.metrics import EpisodeMeter, MeanMeter
from vusfa.training.progress import EvaluationProgress, ProgressLine
from vusfa.training.replay import HindsightReplay, HindsightSampler
from vusfa.training.session import (
    Session,
    load_agent,
    make_observation,
    rebuild_agent,
    scene_sources,
    set_threads,
    torch_device,
)
from vusfa.training.setup import Training, make_training, row_name
from vusfa.training.signals import StopOnSignal

__all__ = [
    "EpisodeMeter",
    "EvaluationProgress",
    "HindsightReplay",
    "HindsightSampler",
    "MeanMeter",
    "ProgressLine",
    "Session",
    "StopOnSignal",
    "Training",
    "annealed",
    "check_goals_dealt",
    "descend",
    "load_agent",
    "load_checkpoint",
    "machine_facts",
    "make_collector",
    "make_env",
    "make_loggers",
    "make_loss",
    "make_observation",
    "make_optimiser",
    "make_training",
    "rebuild_agent",
    "row_name",
    "run_facts",
    "save_checkpoint",
    "scene_sources",
    "set_threads",
    "torch_device",
    "total_loss",
]
