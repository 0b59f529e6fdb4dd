"""The live pages of the site: ``vusfa report`` of results/, and of one agent that is trained for it.

They are made while the other pages are built, and again only where the package or the results have changed.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging

__all__ = ["commands", "setup"]

ROOT = Path(__file__).parents[2]
RESULTS = ["results/table1", "results/hindsight", "results/replay-search"]
SOURCES = {".py", ".js", ".css", ".html", ".yaml"}
TRAINING = (
    "preset=replay_search scenes=[bathroom] total_frames=40000"
    " agent.hidden_size=128 agent.embedding_size=64 evaluation=all"
)


def commands(folder: Path) -> list[list[str]]:
    """The commands that write results.html and explorer.html into a folder."""
    vusfa = [sys.executable, "-m", "vusfa.cli"]
    run = folder / "run"
    title = ["--title", "Table 1 and every goal"]
    return [
        [*vusfa, "report", *RESULTS, "--megabytes", "25", *title, "--out", str(folder / "results.html")],
        [*vusfa, "train", *TRAINING.split(), f"folder={run}", "overwrite=true"],
        [
            *vusfa,
            "report",
            f"VUSFA + replay search={run}",
            *("--title", "One agent in the bathroom", "--out", str(folder / "explorer.html")),
        ],
    ]


def fingerprint() -> str:
    """A hash of everything that the pages depend on."""
    found = hashlib.sha256(TRAINING.encode())
    files = [path for folder in RESULTS for path in (ROOT / folder).rglob("*") if path.is_file()]
    files += [path for path in (ROOT / "vusfa").rglob("*") if path.suffix in SOURCES]
    for path in sorted(files):
        found.update(path.read_bytes())
    return found.hexdigest()


def start(app: Sphinx) -> None:
    """Start the commands, one after the other, beside the build."""
    if app.builder.name != "html":
        return
    folder = Path(app.outdir) / "pages"
    stamp = folder / ".made-of"
    if stamp.exists() and stamp.read_text() == fingerprint():
        return
    folder.mkdir(parents=True, exist_ok=True)
    shell = " && ".join(shlex.join(command) for command in commands(folder))
    with (folder / ".log").open("w") as log:
        app.pages_process = subprocess.Popen(  # type: ignore[attr-defined]
            ["sh", "-c", shell], cwd=ROOT, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )


def finish(app: Sphinx, error: Exception | None) -> None:
    """Wait for the commands; a failure fails the build."""
    process = getattr(app, "pages_process", None)
    if process is None:
        return
    if error is not None:
        process.terminate()
        return
    logging.getLogger(__name__).info("waiting for the live pages...")
    folder = Path(app.outdir) / "pages"
    if process.wait():
        raise ExtensionError(f"the live pages failed:\n{(folder / '.log').read_text()[-2000:]}")
    (folder / ".made-of").write_text(fingerprint())


def setup(app: Sphinx) -> dict[str, Any]:
    """Register start and end."""
    app.connect("builder-inited", start)
    app.connect("build-finished", finish)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
