"""Modules that :mod:`worker` imports by their bare names are no tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
collect_ignore = ["endings.py", "long.py", "mutate.py", "readers.py", "worker.py"]
