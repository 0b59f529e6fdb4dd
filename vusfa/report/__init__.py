"""One self-contained page of what runs learned: tables, curves, floor maps, an explorer.

>>> from vusfa.report import Options, read_source, write_report
"""

from vusfa.report.build import write_report
from vusfa.report.cells import read_source
from vusfa.report.content import Options
from vusfa.report.runs import Run, read_run

__all__ = ["Options", "Run", "read_run", "read_source", "write_report"]
