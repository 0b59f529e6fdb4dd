"""All tables from results/: python recipes/tables.py table1

The same as ``vusfa tables``; read vusfa/report/print_tables.py, and result_tables.py beside it.
"""

from __future__ import annotations

from vusfa.cli.functions import run_functions
from vusfa.report.print_tables import print_tables as tables

if __name__ == "__main__":
    run_functions(tables)
