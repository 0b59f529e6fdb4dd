"""What two pictures of a room tell about the way from one to the other: ``recipes/recognition.py``.

Probes learn it from pairs of states of some rooms, from pooled features and from maps, and are tested in
rooms that they have never seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vusfa.errors import ConfigError
from vusfa.evaluation.long_table import DISTANCE_BINS
from vusfa.evaluation.statistics import Estimate, Sums, bootstrap_mean
from vusfa.experiments.generalise import rooms_of
from vusfa.modules.pair_probe import PROBES, PairProbe
from vusfa.scenes import Scene, SceneSet
from vusfa.scenes.feature_grid import feature_grid
from vusfa.scenes.views import places_in_view
from vusfa.training.progress import ProgressLine

__all__ = ["Pairs", "feature_maps", "recognition", "scores"]

#: Answers of a probe and how their scores are called; all but the place are shares of right answers.
ANSWERS = {"distance": "distance", "turn": "turn", "view": "in view", "action": "action", "place": "place, m"}
#: Pairs of every room that a probe is tested on.
TESTED = 2000
#: Rooms that the pairs of a step are of.
ROOMS_AT_ONCE = 16


def feature_maps(scenes: SceneSet) -> Tensor:
    """Features (S, T, C) of the first crop of all states as maps of T parts, T = 1 for pooled ones.

    Raises:
        ConfigError: see :func:`~vusfa.scenes.feature_grid.feature_grid`.
    """
    rows, columns = feature_grid(scenes)
    flat = torch.cat([scene.features[:, 0] for scene in scenes.scenes])
    return flat.view(len(flat), -1, rows * columns).transpose(1, 2)


class Pairs:
    """Pairs of states of one room, and what is asked about them.

    Args:
        scene: the room.

    >>> pairs = Pairs(Scene.bundled("bathroom"))
    >>> first, second = pairs.draw(2, torch.Generator())
    >>> {name: tuple(part.shape) for name, part in pairs.asked(first, second).items()}
    {'distance': (2,), 'turn': (2,), 'view': (2,), 'action': (2, 4), 'place': (2, 2)}
    """

    def __init__(self, scene: Scene) -> None:
        self.distance = scene.distance.long()
        self.view = places_in_view(scene)
        self.location, self.rotation = scene.location.double(), scene.rotation.double()
        self.ahead = torch.where(scene.graph < 0, torch.arange(len(scene.graph))[:, None], scene.graph)
        self.reachable = (self.distance >= 0).nonzero()

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """First and second states (count,) of pairs with a path, drawn uniformly."""
        rows = torch.randint(len(self.reachable), (count,), generator=generator)
        first, second = self.reachable[rows].T
        return first, second

    def asked(self, first: Tensor, second: Tensor) -> dict[str, Tensor]:
        """What is asked about pairs (n,).

        Returns:
            distance: (n,) int64, the bin of :data:`~vusfa.evaluation.long_table.DISTANCE_BINS` of the
            shortest path's length; turn: (n,) int64, quarters clockwise from the first heading to the second;
            view: (n,) int64, whether the second's place is in view from the first
            (:func:`~vusfa.scenes.views.places_in_view`); action: (n, A) bool, those with which a shortest
            path begins, none where there is no way to go; place: (n, 2) float32, metres to the right and
            ahead, in the frame of the first.
        """
        bins = torch.tensor(DISTANCE_BINS)
        apart = self.distance[first, second]
        turn = ((self.rotation[second] - self.rotation[first]) / 90).round().long() % 4
        heading = torch.deg2rad(self.rotation[first])
        x, z = (self.location[second] - self.location[first]).T
        sine, cosine = heading.sin(), heading.cos()
        place = torch.stack([x * cosine - z * sine, x * sine + z * cosine], 1)
        onward = self.distance[self.ahead[first], second[:, None]]
        return {
            "distance": torch.bucketize(apart, bins, right=True) - 1,
            "turn": turn,
            "view": self.view[first, second].long(),
            "action": onward == apart[:, None] - 1,
            "place": place.float(),
        }


def _loss(answers: dict[str, Tensor], asked: dict[str, Tensor]) -> Tensor:
    """Sum of cross entropies, that of the action over the pairs with a way to go, and the place's error."""
    total = F.smooth_l1_loss(answers["place"], asked["place"])
    for name in ("distance", "turn", "view"):
        total = total + F.cross_entropy(answers[name], asked[name])
    right = asked["action"].float()
    going = right.sum(1) > 0
    share = right[going] / right[going].sum(1, keepdim=True)
    return total + F.cross_entropy(answers["action"][going], share) if bool(going.any()) else total


def scores(answers: dict[str, Tensor], asked: dict[str, Tensor]) -> dict[str, Tensor]:
    """Right answers (n,) float64 by name: 1, 0, or NaN where nothing is asked; the place's error in metres.

    >>> asked = {"turn": torch.tensor([1, 0]), "action": torch.tensor([[True, False], [False, False]])}
    >>> scores({"turn": torch.eye(2), "action": torch.eye(2)}, asked)["action"].tolist()
    [1.0, nan]
    """
    found = {}
    for name, answer in answers.items():
        if name == "place":
            found[name] = (answer - asked[name]).double().norm(dim=1)
        elif name == "action":
            right = asked[name].gather(1, answer.argmax(1, keepdim=True)).squeeze(1).double()
            found[name] = torch.where(asked[name].any(1), right, torch.nan)
        else:
            found[name] = (answer.argmax(1) == asked[name]).double()
    return found


def _train(
    probe: PairProbe, maps: Tensor, rooms: SceneSet, pairs: Sequence[Pairs], how: dict[str, Any], report: Any
) -> None:
    generator = torch.Generator().manual_seed(how["seed"])
    optimizer = torch.optim.AdamW(probe.parameters(), lr=how["lr"])
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, how["lr"], total_steps=how["steps"] + 1)
    probe.normalize_by(maps)
    for step in range(how["steps"]):
        drawn = torch.randint(len(pairs), (min(ROOMS_AT_ONCE, how["batch"]),), generator=generator)
        states, asked = [], []
        for index in drawn.tolist():
            first, second = pairs[index].draw(how["batch"] // len(drawn), generator)
            states.append(torch.stack([first, second]) + rooms.offsets[index])
            asked.append(pairs[index].asked(first, second))
        one, other = torch.cat(states, 1)
        targets = {name: torch.cat([part[name] for part in asked]) for name in asked[0]}
        optimizer.zero_grad()
        _loss(probe(maps[one], maps[other]), targets).backward()
        optimizer.step()
        schedule.step()
        report(step + 1)


class _Constant(nn.Module):
    """The most frequent answers in the rooms of the training: what no picture is needed for."""

    def __init__(self, asked: dict[str, Tensor]) -> None:
        super().__init__()
        self.answers = {
            name: part.double().mean(0) if part.ndim > 1 else part.bincount().double()
            for name, part in asked.items()
        }
        self.answers["place"] = asked["place"].median(0).values

    def forward(self, first: Tensor, second: Tensor) -> dict[str, Tensor]:
        return {name: answer.expand(len(first), -1) for name, answer in self.answers.items()}


@torch.no_grad()
def _test(
    probe: nn.Module, maps: Tensor, rooms: SceneSet, pairs: Sequence[Pairs], seed: int
) -> list[dict[str, Any]]:
    """Estimates by answer, of all pairs of two states and of those whose second place is in view."""
    generator = torch.Generator().manual_seed(seed + 1)
    sums: dict[tuple[str, str], list[tuple[Tensor, Tensor]]] = {}
    for offset, room in zip(rooms.offsets.tolist(), pairs, strict=False):
        first, second = room.draw(TESTED, generator)
        asked = room.asked(first, second)
        parts = zip((maps[first + offset]).split(256), (maps[second + offset]).split(256), strict=True)
        answers = [probe(*part) for part in parts]
        found = scores({name: torch.cat([part[name] for part in answers]) for name in answers[0]}, asked)
        two = first != second
        for subset, counted in (("all", two), ("in view", two & asked["view"].bool())):
            for name, values in found.items():
                kept = values[counted & ~values.isnan()]
                sums.setdefault((subset, name), []).append((kept.sum(), torch.tensor(float(len(kept)))))
    rows: list[dict[str, Any]] = []
    for subset in dict.fromkeys(subset for subset, _ in sums):
        row: dict[str, Any] = {"pairs": subset}
        for name, label in ANSWERS.items():
            over, under = (torch.stack(part).double()[None] for part in zip(*sums[subset, name], strict=True))
            row[label] = bootstrap_mean(Sums(over, under), torch.zeros(over.shape[1]))
        rows.append(row)
    return rows


def recognition(
    rooms: Path,
    *,
    trained: int | None = None,
    tested: int | None = None,
    test: str | None = None,
    kinds: list[str] = [*PROBES],  # noqa: B006
    steps: int = 4000,
    batch: int = 512,
    lr: float = 1e-3,
    hidden_size: int = 64,
    seed: int = 0,
) -> None:
    """Train probes on pairs of states of some rooms, and test them in others.

    A probe sees the features of two states and says how far it is, how much the headings differ, whether the
    second place is in view, which action a shortest path begins with, and where the place is. Prints right
    answers in per cent and the mean error of the place in metres, with 95 % bootstrap intervals over rooms;
    ``constant`` says what is most frequent in the rooms of the training, without a picture.

    Args:
        rooms: folder of dumps (.h5), with features on a grid for both kinds of probe.
        trained, tested, test: rooms to train on and to test in, as for vusfa generalise.
        kinds: pooled (features averaged over the picture) and spatial (the map).
        steps: of the training.
        batch: pairs per step.
        lr: largest step size of AdamW.
        hidden_size: width of the probes' layers.
        seed: of everything.
    """
    wrong = [kind for kind in kinds if kind not in PROBES]
    if wrong or min(steps, batch, hidden_size // 4) < 1 or hidden_size % 4 or not lr > 0:
        raise ConfigError(
            f"kinds is {kinds}, steps {steps}, batch {batch}, lr {lr}, hidden_size {hidden_size}; kinds are"
            f" {' and '.join(PROBES)}, the others above 0, hidden_size a multiple of 4"
        )
    first, last, part = rooms_of(rooms, trained, tested, test)
    worlds = [SceneSet.open(paths) for paths in (first, last)]
    maps = [feature_maps(world) for world in worlds]
    if maps[0].shape[1:] != maps[1].shape[1:]:
        raise ConfigError(f"{rooms}: rooms to train in and to test in have features of different sizes")
    if "spatial" in kinds and maps[0].shape[1] == 1:
        raise ConfigError(f"{rooms}: these rooms have pooled features, no maps; give kinds=[pooled]")
    pairs = [[Pairs(scene) for scene in world.scenes] for world in worlds]
    generator = torch.Generator().manual_seed(seed)
    drawn = [room.asked(*room.draw(500, generator)) for room in pairs[0]]
    asked = {name: torch.cat([part[name] for part in drawn]) for name in drawn[0]}
    probes: dict[str, nn.Module] = {"constant": _Constant(asked)}
    sizes = {
        "distance": len(DISTANCE_BINS),
        "turn": 4,
        "view": 2,
        "action": worlds[0].num_actions,
        "place": 2,
    }
    how = {"steps": steps, "batch": batch, "lr": lr, "seed": seed}
    for kind in kinds:
        torch.manual_seed(seed)
        probe = PairProbe(kind, maps[0].shape[1], maps[0].shape[2], sizes, hidden_size)
        with ProgressLine(steps, unit=f"steps of the {kind} probe") as line:
            _train(probe, maps[0], worlds[0], pairs[0], how, line.update)
        probes[kind] = probe.eval()
    table = [
        {"probe": kind} | row
        for kind, probe in probes.items()
        for row in _test(probe, maps[1], worlds[1], pairs[1], seed)
    ]
    where = f"{len(last)} rooms" + (f" ({part})" if part else "")
    print(f"trained in {len(first)} rooms, tested in {where}: right answers in %, place: error in metres\n")
    head = list(table[0])
    lines = [head, ["---"] * len(head), *([_text(key, row[key]) for key in head] for row in table)]
    print("\n".join(f"| {' | '.join(line)} |" for line in lines))


def _text(key: str, value: Any) -> str:
    if not isinstance(value, Estimate):
        return str(value)
    scale, digits = (1, 2) if key == ANSWERS["place"] else (100, 1)
    return "{:.{d}f} [{:.{d}f}, {:.{d}f}]".format(*(scale * number for number in value), d=digits)
