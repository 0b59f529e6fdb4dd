"""One page of what runs learned: python recipes/report.py runs/A results/table1 --out report.html

The same as ``vusfa report``; read vusfa/report.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.report.command import report_runs as report

if __name__ == "__main__":
    run_functions(report)
