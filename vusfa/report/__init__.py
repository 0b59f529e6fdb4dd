"""Reports of results: tables, figures, and one self-contained page with curves, floor maps and an explorer.

>>> from vusfa.report import Options, read_source, write_report
"""

from vusfa.deprecated import moved_names
from vusfa.report.build import write_report
from vusfa.report.cells import read_source
from vusfa.report.content import Options
from vusfa.report.runs import LoggedRun, read_run

__all__ = ["LoggedRun", "Options", "read_run", "read_source", "write_report"]

__getattr__ = moved_names(__name__, {"Run": "vusfa.report.runs.LoggedRun"})
