"""One self-contained page of what runs learned: tables, curves, floor maps, an explorer.

>>> from vusfa.report import read_run
"""

from vusfa.report.runs import Run, read_run

__all__ = ["Run", "read_run"]
