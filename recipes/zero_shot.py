"""Every state a goal: python recipes/zero_shot.py runs/.../checkpoint.pt

As the paper's Table 1: for every state of every scene as a goal, 10 episodes from random starts, 500 steps,
sampled actions. The same as ``vusfa evaluate``; read vusfa/experiments/zero_shot.py.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.experiments.zero_shot import zero_shot

if __name__ == "__main__":
    run_functions(zero_shot)
