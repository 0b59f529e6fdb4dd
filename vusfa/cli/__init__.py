"""The command line: ``vusfa train ...``, ``vusfa scenes ...``.

One module per group of commands. Each has a function ``register(scenes)`` that adds its commands to ``vusfa
scenes``, and imports slow packages (torch, matplotlib, a renderer) only inside them, so that
``--help`` answers at once.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import NamedTuple

from vusfa.cli.interrupts import quiet_interrupts

__all__ = ["COMMANDS", "FIRST_STEPS", "FUNCTIONS", "TRAINING_COMMANDS", "Forwarded", "main"]
quiet_interrupts()  # here: the modules of this package take seconds to import

#: Modules that add commands, in the order in which ``--help`` shows them. A new command is a module with a
#: function ``register(scenes)``, and a line here.
COMMANDS = [
    "vusfa.cli.inspect",
    "vusfa.cli.photos",
    "vusfa.cli.thor",
    "vusfa.cli.miniworld",
    "vusfa.cli.encode",
    "vusfa.cli.augment",
    "vusfa.cli.fetch",
    "vusfa.cli.render",
    "vusfa.cli.render_rooms",
    "vusfa.cli.compact",
]

#: Modules that add a command to ``vusfa`` itself, with a function ``register(app)``.
TRAINING_COMMANDS = ["vusfa.cli.train", "vusfa.cli.deploy", "vusfa.cli.film", "vusfa.cli.pretrained"]


class Forwarded(NamedTuple):
    """A command that runs functions of other packages, imported when it runs.

    Attributes:
        words: help in the list of commands.
        functions: ``module.function`` by the subcommand's name; "" for a single function.
        examples: command lines, shown in its help.
        panel: section of the list of commands.
    """

    words: str
    functions: dict[str, str]
    examples: tuple[str, ...]
    panel: str = "Experiments"


#: Commands beside ``vusfa scenes`` and those of the modules above.
FUNCTIONS: dict[str, Forwarded] = {
    "evaluate": Forwarded(
        "Evaluate a checkpoint: every state of every scene a goal.",
        {"": "vusfa.experiments.zero_shot.zero_shot"},
        ("vusfa evaluate runs/first", "vusfa evaluate runs/first/checkpoint.pt episodes=50 goals=random:5"),
        panel="Agents",
    ),
    "report": Forwarded(
        "Write one HTML page of runs and results.",
        {"": "vusfa.report.command.report_runs"},
        ("vusfa report runs/first", "vusfa report VUSFA=runs/first GVF=runs/second out=both.html"),
        panel="Agents",
    ),
    "table1": Forwarded(
        "Reproduce the paper's Table 1: train and evaluate, per model and seed.",
        {"": "vusfa.experiments.table1.table1"},
        ("vusfa table1", "vusfa table1 preset=paper models=[gvf,vusfa] seeds=[0,1] experiment=paper"),
    ),
    "tables": Forwarded(
        "Print the tables of results, with intervals, as Markdown and CSV.",
        {"": "vusfa.report.print_tables.print_tables"},
        ("vusfa tables table1", "vusfa tables table1 hindsight results=results out=csv"),
    ),
    "transfer": Forwarded(
        "Reproduce the paper's Figure 2: fine-tune towards new goals, show the figure.",
        {
            "run": "vusfa.experiments.run_transfer.run_transfer",
            "show": "vusfa.report.transfer_figure.show_transfer",
        },
        ("vusfa transfer run models=[gvf,vusfa] seeds=[0]", "vusfa transfer show out=transfer.png"),
    ),
    "generalise": Forwarded(
        "Train in some rooms, test in others.",
        {"": "vusfa.experiments.generalise.generalise"},
        ("vusfa generalise rooms/unseen", "vusfa generalise rooms/small preset=unseen seed=1"),
    ),
    "transplant": Forwarded(
        "Take an agent to rooms that it has never seen.",
        {"": "vusfa.experiments.transplant_run.transplant_run"},
        ("vusfa transplant runs/first rooms/hall.h5 rooms/attic.h5 folder=runs/elsewhere",),
        panel="Agents",
    ),
    "robustness": Forwarded(
        "Evaluate an agent in changed renderings of its rooms.",
        {"": "vusfa.deploy.robustness.robustness"},
        (
            "vusfa robustness runs/first changes/dimmer changes/noise",
            "vusfa robustness runs/robust changes/dimmer changes/noise name=augmented episodes=2",
        ),
    ),
}

#: End of ``vusfa --help``.
FIRST_STEPS = """
First steps:

    vusfa pretrained list
    vusfa film vusfa --scene kitchen
    vusfa train preset=replay_search scenes=[bathroom] total_frames=50000 evaluation=all folder=runs/first
    vusfa report runs/first

Settings and options are written name=value, options also --name value. Every --help has examples.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process.

    Exit codes: 0 done, 1 an error that the user can mend (one line ``error: ...`` on stderr), 2 a wrong
    command line, 130 Ctrl-C, 143 SIGTERM. Whatever ends a command, it leaves no half-written file.

    Args:
        arguments: without the program's name; those of the process by default.
    """
    # Raised as an exception, so that temporary files are removed.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        from vusfa.cli.app import app
    except ModuleNotFoundError as error:
        if error.name != "typer":
            raise
        sys.exit("error: the command line needs more packages: pip install 'vusfa[scenes]'")
    app(args=None if arguments is None else list(arguments), prog_name="vusfa")
