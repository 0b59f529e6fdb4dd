"""The paper's Table 1, one run per model and seed: python recipes/table1.py --models vusfa --seeds 0

Every run trains a model, chooses a checkpoint by the validation goals, and evaluates it on the episodes of
the manifest that all runs share. The same as ``vusfa table1``; read vusfa/experiments/table1.py.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.experiments.table1 import table1

if __name__ == "__main__":
    run_functions(table1)
