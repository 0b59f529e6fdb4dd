"""The command line: ``vusfa train ...``, ``vusfa scenes ...``.

One module for each group of commands. Every one has a function ``register(scenes)`` that adds its commands
to ``vusfa scenes``, and imports what computes (torch, matplotlib, a renderer) only inside them, so that
``--help`` answers at once.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

from vusfa.cli.interrupts import quiet_interrupts

__all__ = ["COMMANDS", "TRAINING_COMMANDS", "main"]
quiet_interrupts()  # here: the modules of this package import what takes seconds

#: Modules that add commands, in the order in which ``--help`` shows them. A new command is a module with a
#: function ``register(scenes)``, and a line here.
COMMANDS = [
    "vusfa.cli.inspect",
    "vusfa.cli.photos",
    "vusfa.cli.thor",
    "vusfa.cli.encode",
    "vusfa.cli.fetch",
    "vusfa.cli.render",
    "vusfa.cli.compact",
]

#: Modules that add a command to ``vusfa`` itself, with a function ``register(app)``.
TRAINING_COMMANDS = ["vusfa.cli.train", "vusfa.cli.deploy", "vusfa.cli.pretrained"]


#: Commands beside ``vusfa scenes``: name, help, and the functions that they run.
FUNCTIONS: dict[str, tuple[str, dict[str, str]]] = {
    "evaluate": (
        "Evaluate a checkpoint: every state of every scene a goal.",
        {"": "vusfa.experiments.zero_shot.zero_shot"},
    ),
    "table1": (
        "The paper's Table 1: train and evaluate, per model and seed.",
        {"": "vusfa.experiments.table1.table1"},
    ),
    "tables": (
        "All tables of results, with intervals; Markdown and CSV.",
        {"": "vusfa.report.print_tables.print_tables"},
    ),
    "transfer": (
        "The paper's Figure 2: run the fine-tuning towards new goals, show its figure.",
        {
            "run": "vusfa.experiments.run_transfer.run_transfer",
            "show": "vusfa.report.transfer_figure.show_transfer",
        },
    ),
    "generalise": (
        "Train in some rooms, test in others.",
        {"": "vusfa.experiments.generalise.generalise"},
    ),
    "report": ("One HTML page of runs and results.", {"": "vusfa.report.command.report_runs"}),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process.

    Exit codes: 0 done, 1 an error that the user can mend (one line ``error: ...`` on stderr), 2 a wrong
    command line, 130 Ctrl-C, 143 SIGTERM. Whatever ends a command, it leaves no half-written file.

    Args:
        arguments: without the program's name; the process's own by default.
    """
    # As an exception, so that temporary files are removed on the way out.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        from vusfa.cli.app import app
    except ModuleNotFoundError as error:
        if error.name != "typer":
            raise
        sys.exit("error: the command line needs some more packages: pip install 'vusfa[scenes]'")
    app(args=None if arguments is None else list(arguments), prog_name="vusfa")
