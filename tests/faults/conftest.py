"""Modules that :mod:`worker` imports by their bare names are no tests."""

collect_ignore = ["mutate.py", "readers.py", "worker.py"]
