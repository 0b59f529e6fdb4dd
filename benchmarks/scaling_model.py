"""Predict the speed of many learners from measured constants: python benchmarks/scaling_model.py

Reads results/scaling/ranks.json, which ``benchmarks/run.py --suite ranks --out results/scaling`` measures,
and prints the tables of docs/scaling.md, which ``--docs docs/scaling.md`` writes with their figure. A learner
is a rank of one thread.

An update of N ranks takes

    t(N) = fixed + each * frames + reduce(N),    reduce(N) = 2 (N - 1) (latency + gradient / (N * bandwidth))

with a ring all-reduce, as gloo's: 2 (N - 1) messages of an N-th of the gradient each, one after the other.
On a GPU ``fixed`` is the launches of an update's kernels, and ``each`` its operations over what the card
reaches.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

CONSTANTS = Path("results/scaling/ranks.json")
RANKS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000)
#: Environments per GPU; states of 10,000 rooms of 80 states, and of the largest set.
ENVS, STATES = (1024, 4096, 16384), (800_000, 100_000_000)
BEGIN, END = "<!-- begin: benchmarks/scaling_model.py -->", "<!-- end -->"


@dataclass(frozen=True)
class Network:
    """Links between learners: latency of a message in seconds, bytes per second of each."""

    latency: float
    bandwidth: float


#: Assumed, not measured: what such networks are sold with, and latencies that gloo and NCCL see on them.
NETWORKS = {"10 Gbit/s": Network(50e-6, 1.25e9), "100 Gbit/s": Network(20e-6, 12.5e9)}
#: Assumed, not measured: a card of the size of an H100. Operations per second that it reaches on products of
#: this size (a tenth of its 989e12 in bfloat16), seconds per kernel launch, kernels per torch call, NVLink.
REACHED, LAUNCH, KERNELS, NVLINK = 99e12, 5e-6, 1.5, Network(10e-6, 450e9)


@dataclass(frozen=True)
class Update:
    """Measured constants of an update.

    Attributes:
        fixed, each: seconds per update, and per frame.
        frames: per rank.
        gradient: bytes.
        flop: operations per frame.
        calls: torch calls per update.
        rollout: steps of each environment per update.
        opening: seconds per state of scenes that are opened.
        features: bytes of a state's features.
        measured: frames per second of 1 and of 2 ranks, with as many frames each, and with as many in all.
        loopback: links between processes of this machine.
    """

    fixed: float
    each: float
    frames: int
    gradient: float
    flop: float
    calls: float
    rollout: int
    opening: float
    features: float
    measured: Mapping[str, float]
    loopback: Network

    @classmethod
    def read(cls, path: Path) -> Update:
        """From the file of the suite ``ranks``."""
        suites = json.loads(path.read_text(encoding="utf-8"))["suites"]
        value = {row["name"]: row["value"] for suite in suites for row in suite["rows"]}
        one, whole = value["all-reduce of one number"], value["all-reduce of the gradient"]
        name = "ids, 4 frames"
        return cls(
            fixed=value["an update's fixed time"],
            each=value["an update's time per frame"],
            frames=int(value["frames of an update per rank"]),
            gradient=value["gradient"],
            flop=value["operations of an update"],
            calls=value["torch calls of an update"],
            rollout=int(value["steps of a rollout"]),
            opening=value["opening scenes"],
            features=value["features of a state"],
            measured={
                "1 rank": value[f"{name}: 1 rank"],
                "2 ranks, as many environments each": value[f"{name}: 2 ranks, as many environments each"],
                "2 ranks, as many in all": value[f"{name}: 2 ranks, as many in all"],
            },
            loopback=Network(one / 2, value["gradient"] / max(whole - one, 1e-9)),
        )

    def seconds(self, ranks: int, network: Network, frames: float | None = None) -> float:
        """Seconds of an update of so many ranks, with so many frames each."""
        return self.fixed + self.each * (frames or self.frames) + reduce(self.gradient, ranks, network)

    def sizes(self) -> dict[str, float]:
        """Bytes per state of what a learner keeps of the world, with four actions."""
        return {
            "features, one copy": self.features,
            "graph: successors, blocked moves, scene": 4 * 8 + 4 + 8,
            "replay_search: transitions seen, and scene": 4 * 8 + 8,
        }

    def on_gpus(self, cards: int, frames: int) -> float:
        """Frames per second on so many cards, with so many frames of an update each."""
        compute = self.calls * KERNELS * LAUNCH + frames * self.flop / REACHED
        return cards * frames / (compute + reduce(self.gradient, cards, NVLINK))


def reduce(gradient: float, ranks: int, network: Network) -> float:
    """Seconds of a ring all-reduce.

    >>> reduce(1e9, 2, Network(0.0, 1e9))
    1.0
    """
    return 2 * (ranks - 1) * (network.latency + gradient / (ranks * network.bandwidth))


def predict(update: Update) -> dict[str, dict[int, float]]:
    """Frames per second by number of learners, for each curve of the figure."""
    alone = update.frames / update.seconds(1, update.loopback)
    curves = {"N times one": {n: n * alone for n in RANKS}}
    for name, network in NETWORKS.items():
        curves[f"{name}, {update.frames:,} frames each"] = {
            n: n * update.frames / update.seconds(n, network) for n in RANKS
        }
        curves[f"{name}, {update.frames:,} frames in all"] = {
            n: update.frames / update.seconds(n, network, update.frames / n) for n in RANKS
        }
    return curves


def check(update: Update) -> dict[str, tuple[float, float]]:
    """Predicted and measured frames per second on this machine."""
    frames, link = update.frames, update.loopback
    predicted = {
        "1 rank": frames / update.seconds(1, link),
        "2 ranks, as many environments each": 2 * frames / update.seconds(2, link),
        "2 ranks, as many in all": frames / update.seconds(2, link, frames / 2),
    }
    return {name: (value, update.measured[name]) for name, value in predicted.items()}


def tables(update: Update) -> list[list[list[str]]]:
    """The tables of the page, rows of cells, the heading first."""
    rows = [["on this machine", "predicted, frames/s", "measured", "predicted / measured"]]
    for name, (predicted, measured) in check(update).items():
        rows.append([name, f"{predicted:,.0f}", f"{measured:,.0f}", f"{predicted / measured:.2f}"])
    found, curves = [rows], predict(update)
    found.append([["learners", *curves]])
    found[-1] += [[f"{n:,}", *(f"{curve[n]:,.0f}" for curve in curves.values())] for n in RANKS]
    compute = update.fixed + update.each * update.frames
    head = [f"share of the all-reduce, {name}" for name in NETWORKS]
    found.append([["learners", "seconds of collecting and learning", *head]])
    for n in RANKS:
        shares = [1 - compute / update.seconds(n, network) for network in NETWORKS.values()]
        found[-1].append([f"{n:,}", f"{compute:.3f}", *(f"{100 * share:.1f} %" for share in shares)])
    found.append([["GPUs (assumed constants)", *(f"{envs:,} environments each" for envs in ENVS)]])
    for cards in (1, 2, 4, 8):
        rates = [update.on_gpus(cards, envs * update.rollout) for envs in ENVS]
        found[-1].append([str(cards), *(f"{rate:,.0f}" for rate in rates)])
    found.append([["what", "per state or learner", *(f"{states:,} states" for states in STATES)]])
    for name, size in update.sizes().items():
        found[-1].append([name, f"{size:,.0f} bytes", *(f"{size * n / 2**30:,.1f} GiB" for n in STATES)])
    opened = [f"{update.opening * n / 60:,.1f} min" for n in STATES]
    found[-1].append(["opening all scenes, one process", f"{1e6 * update.opening:,.1f} us", *opened])
    return found


def markdown(update: Update, link: str) -> str:
    """The tables and the figure, as Markdown."""
    parts = []
    for head, *rows in tables(update):
        lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
        parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    first, second, *others = parts
    figure = f"![Predicted frames per second by number of learners]({link})"
    return "\n\n".join([first, figure, second, *others])


def main(
    constants: Annotated[Path, typer.Argument(help="file of the suite ranks")] = CONSTANTS,
    docs: Annotated[Path | None, typer.Option(help="page whose tables and figure to write anew")] = None,
) -> None:
    """Print predictions from measured constants."""
    update, console = Update.read(constants), Console(width=140)
    for head, *rows in tables(update):
        table = Table(*head)
        for row in rows:
            table.add_row(*row)
        console.print(table)
    if docs is not None:
        draw(predict(update), docs.with_suffix(".png"))
        before, _, rest = docs.read_text(encoding="utf-8").partition(BEGIN)
        text = f"{before}{BEGIN}\n\n{markdown(update, docs.with_suffix('.png').name)}\n\n{END}"
        docs.write_text(text + rest.partition(END)[2], encoding="utf-8")
        console.print(f"written: {docs}", soft_wrap=True)


def draw(curves: Mapping[str, Mapping[int, float]], path: Path) -> None:
    """Draw the curves, both axes logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure((7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, curve in curves.items():
        style = {"color": "0.7", "linestyle": ":"} if name.startswith("N times") else {}
        axes.loglog(list(curve), list(curve.values()), label=name, **style)
    axes.set(xlabel="learners", ylabel="frames per second (predicted)")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    typer.run(main)
