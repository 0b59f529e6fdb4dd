"""What two pictures tell about the way from one to the other: python recipes/recognition.py rooms/unseen

Trains probes on pairs of states of some rooms, from features pooled over the picture and from maps of them,
and tests them in other rooms. Read vusfa/experiments/recognition.py.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.experiments.recognition import recognition

if __name__ == "__main__":
    run_functions(recognition)
