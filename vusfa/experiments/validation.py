"""Evaluation during a training: what its curves show, and which checkpoint is the best.

The goals are those trained on, and validation goals, which no training goal is among. One-frame agents are
measured exactly, others by a few episodes per goal. Weights and random states stay as they are: the training
is the same number for number with and without.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from vusfa.envs.dynamics import MAX_STEPS
from vusfa.envs.goals import resolve_goals
from vusfa.errors import VusfaError
from vusfa.evaluation.baselines import random_walk
from vusfa.evaluation.exact import ExpectedWalks
from vusfa.experiments.manifest import draw_goals
from vusfa.experiments.measure import measure_goals
from vusfa.files import say
from vusfa.training import Trainer
from vusfa.training.loggers import Logger
from vusfa.training.metrics import MAX_SCENES, quantiles

__all__ = ["Draw", "Validation"]

#: Pictures (PNG) and films (GIF) by name, of the success from each state (S,) and the goals (G,) it is of.
Draw = Callable[[Trainer, Tensor, Tensor], Mapping[str, bytes]]

#: ``evaluation.interval=auto``: evaluations per training, and the largest share of its time; media may take
#: the same share again.
EVALUATIONS, TIME_SHARE = 20, 0.05
#: Most goals per scene, and episodes to each for agents of several frames.
TRAINED_GOALS, VALIDATION_GOALS, EPISODES = 20, 5, 5


class Validation:
    """Evaluations of an agent in training; see :data:`vusfa.training.run.Validate`.

    Args:
        trainer: of the agent; ``settings["evaluation"]`` has the interval.
        loggers: receive a table per evaluation, and media where they show these.
        draw: makes the media; None for none.

    Attributes:
        goals: (G,) global ids, scene by scene.
        subsets: which of them (G,) bool are "trained" goals and which "validation" goals. Where every state
            is a trained goal, validation goals are drawn from these. Of more than 100 scenes, 100 are
            drawn, the same each time.

    >>> from vusfa.experiments.training import compose_settings
    >>> from vusfa.training import make_loggers, make_trainer
    >>> settings = compose_settings(["scenes=[bathroom]", "agent.hidden_size=8", "agent.embedding_size=8"])
    >>> validation = Validation(make_trainer(settings), make_loggers([], "run", {}, run_id="a"))
    >>> [int(chosen.sum()) for chosen in validation.subsets.values()]
    [5, 5]
    >>> sorted(validation.measure())[:3]
    ['eval/trained/length_ratio', 'eval/trained/spl', 'eval/trained/success']
    """

    def __init__(self, trainer: Trainer, loggers: Logger, draw: Draw | None = None) -> None:
        self._trainer, self._loggers, self._draw = trainer, loggers, draw
        settings, scenes = trainer.settings["evaluation"], trainer.scenes
        self.interval = settings.get("interval", "auto")
        self.max_steps = settings["max_steps"] or MAX_STEPS
        self._scene = scenes.scene_id.cpu()
        every, trained, draws = resolve_goals(scenes, "all"), trainer.goals.cpu().unique(), torch.Generator()
        self._many = scenes.num_scenes > MAX_SCENES
        if self._many:
            chosen = torch.randperm(scenes.num_scenes, generator=draws.manual_seed(0))[:MAX_SCENES]
            every, trained = (ids[torch.isin(self._scene[ids], chosen)] for ids in (every, trained))
            trained = trained if len(trained) else every
        unseen = every[~torch.isin(every, trained)]
        unseen = draw_goals(scenes, unseen if len(unseen) else every, VALIDATION_GOALS, draws.manual_seed(0))
        trained = draw_goals(scenes, trained, TRAINED_GOALS, draws)
        self.goals = torch.cat([trained, unseen]).unique()
        subsets = {"trained": trained, "validation": unseen}
        self.subsets = {name: torch.isin(self.goals, ids) for name, ids in subsets.items()}
        self._columns: list[str] = []
        self.latest: dict[str, float] = {}

    def __call__(self, is_last: bool) -> dict[str, float]:
        """Metrics of the agent as it is now; NaN where no evaluation is due.

        Args:
            is_last: whether the training ends here.
        """
        if self._trainer.ranks.first(lambda: self._is_due(is_last)):
            return self.measure()
        if not self._columns:
            walks = torch.zeros(7, len(self.goals), dtype=torch.float64)
            self._columns = list(self._metrics(ExpectedWalks._make(walks)))
        return dict.fromkeys(self._columns, math.nan)

    def measure(self) -> dict[str, float]:
        """Metrics of the agent as it is now, logged as a table and media, too; all ranks call it."""
        began, trainer = time.monotonic(), self._trainer
        walks = measure_goals(trainer, self.goals, episodes_per_goal=EPISODES, max_steps=self.max_steps)
        return trainer.ranks.first(lambda: self._logged(walks, began))

    def _logged(self, walks: ExpectedWalks, began: float) -> dict[str, float]:
        trainer, self.latest = self._trainer, self._metrics(walks)
        self._loggers.log_table("validation", self._rows(walks), trainer.frames)
        self._spent("", began)
        is_last = trainer.frames >= trainer.settings["total_frames"]
        if self._draw and self._loggers.shows_media and (is_last or self._can_afford("media_")):
            began, goals = time.monotonic(), self.goals[self.subsets["validation"]]
            try:
                self._loggers.log_media(self._draw(trainer, walks.from_start, goals), trainer.frames)
            except (VusfaError, OSError) as error:  # pictures that have gone end no training
                say(f"warning: films and maps cannot be drawn ({error}); the run goes on without them")
                self._draw = None
            self._spent("media_", began)
        trainer.validation["frames"] = trainer.frames
        return self.latest

    def _spent(self, what: str, began: float) -> None:
        spent, seconds = self._trainer.validation, time.monotonic() - began
        spent |= {f"{what}seconds": spent[f"{what}seconds"] + seconds, f"last_{what}seconds": seconds}

    def _can_afford(self, what: str) -> bool:
        spent = self._trainer.validation
        after = spent[f"{what}seconds"] + spent[f"last_{what}seconds"]
        return not after or self.interval != "auto" or after <= TIME_SHARE * self._trainer.seconds

    def advice(self) -> str | None:
        """A line for an agent that ends below the random walk; None for any other, and without evaluation."""
        if not self.latest:
            return None
        found = {}
        for subset, chosen in self.subsets.items():
            success, walk = self.latest[f"eval/{subset}/success"], self._random_walk(self.goals[chosen])
            if success < walk - 0.01:
                found[subset] = (
                    f"{100 * success:.1f} % of the {subset} goals, a random walk {100 * walk:.1f} %"
                )
        if not found:
            return None
        remedy = "begin a new training with preset=replay_search, which learns to reach every state"
        if self._trainer.settings["algorithm"]["name"] in ("hindsight", "replay_search"):
            remedy = "train for longer: give a larger total_frames beside resume"
        within = f"within {self.max_steps} steps"
        return f"below the random walk: the agent reaches {found.popitem()[1]} {within}; {remedy}"

    def _is_due(self, is_last: bool) -> bool:
        trainer, spent = self._trainer, self._trainer.validation
        if self.interval is None:
            return False
        if is_last:
            return spent["frames"] < trainer.frames
        every = self.interval
        if every == "auto":
            every = max(1, trainer.settings["total_frames"] // EVALUATIONS)
        return spent["frames"] // every < trainer.frames // every and self._can_afford("")

    def _metrics(self, walks: ExpectedWalks) -> dict[str, float]:
        metrics, scene = {}, self._scene[self.goals]
        for subset, chosen in self.subsets.items():
            for name in ("success", "spl"):
                column = getattr(walks, name)
                metrics[f"eval/{subset}/{name}"] = column[chosen].nanmean().item()
                if self._many:
                    means = [column[chosen & (scene == index)].nanmean() for index in scene.unique()]
                    metrics |= quantiles(f"scenes/eval/{subset}/{name}", torch.stack(means))
                    continue
                for index, place in enumerate(self._trainer.scenes.names):
                    here = column[chosen & (scene == index)]
                    metrics[f"scene/{place}/eval/{subset}/{name}"] = here.nanmean().item()
            metrics[f"eval/{subset}/length_ratio"] = walks.length_ratio_of(chosen)
        return metrics

    def _rows(self, walks: ExpectedWalks) -> list[dict[str, Any]]:
        """One row per goal."""
        scenes, goals = self._trainer.scenes, self.goals
        columns = {
            "scene": [scenes.names[index] for index in self._scene[goals].tolist()],
            "goal": scenes.local_id(goals.to(scenes.device)).tolist(),
            **{name: chosen.tolist() for name, chosen in self.subsets.items()},
            "success": walks.success.tolist(),
            "spl": walks.spl.tolist(),
            "length_ratio": (walks.arrived_length / walks.arrived_shortest).tolist(),
            "shortest": walks.shortest.tolist(),
        }
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def _random_walk(self, goals: Tensor) -> float:
        found = []
        for index, scene in enumerate(self._trainer.scenes.scenes):
            here = goals[self._scene[goals] == index] - int(self._trainer.scenes.offsets[index])
            if len(here):
                found.append(random_walk(scene, here, self.max_steps))
        return torch.cat(found).nanmean().item()
