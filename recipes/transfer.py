"""The paper's Figure 2: python recipes/transfer.py run, then python recipes/transfer.py show

Each trained model of Table 1 is fine-tuned towards new goals: 1, 2 and 4 steps from trained ones, and
anywhere; five sets of goals per kind, the same for all models, with training from scratch beside it. The same
as ``vusfa transfer``; read vusfa/experiments/run_transfer.py and fine_tune.py.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.experiments.run_transfer import run_transfer as run
from vusfa.report.transfer_figure import show_transfer as show

if __name__ == "__main__":
    run_functions(run=run, show=show)
