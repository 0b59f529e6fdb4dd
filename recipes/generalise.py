"""Rooms never seen: python recipes/generalise.py rooms/unseen

Trains one agent in most of a folder of rooms, and sends it to every goal of the others. The same as ``vusfa
generalise``; read vusfa/experiments/generalise.py.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.experiments.generalise import generalise

if __name__ == "__main__":
    run_functions(generalise)
