"""The page as one HTML file with its style, scripts, Plotly, numbers and pictures."""

from __future__ import annotations

import html
import json
import math
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

from vusfa.errors import ConfigError
from vusfa.files import replacing, write_csv

__all__ = ["as_json", "even", "make_page", "page_weight", "write_page", "write_tables"]

_SCRIPTS = ("core.js", "charts.js", "floors.js", "chain.js", "explorer.js", "guide.js", "main.js")


def as_json(content: Any) -> str:
    """JSON for a ``<script>`` element; NaN and infinities become null.

    >>> as_json({"a": [math.nan, 0.5], "b": "</script>"})
    '{"a":[null,0.5],"b":"<\\\\/script>"}'
    """
    text = json.dumps(_finite(content), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("</", "<\\/").replace("<!--", "<\\u0021--")


def make_page(content: Mapping[str, Any]) -> str:
    """The page's text.

    Args:
        content: of :func:`vusfa.report.content.gather`, with pictures.

    Raises:
        ConfigError: Plotly is not installed.
    """
    plotly, script = _plotly(), "\n".join(_asset(name) for name in _SCRIPTS)
    # Plotly adds an empty style sheet, which it fills rule by rule, and those of its maps.
    styles = [_asset("page.css"), "", *re.findall(r"\.textContent='([^'\\]*)'", plotly)]
    parts = {
        "hashes": " ".join(map(_hash, (plotly, script))),
        "styles": " ".join(map(_hash, styles)),
        "title": html.escape(content["title"]),
        "css": _asset("page.css"),
        "plotly": plotly,
        "data": as_json(content),
        "script": script,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _asset("page.html"))


def page_weight(content: Mapping[str, Any]) -> int:
    """Bytes of the page that ``content`` makes."""
    return len(make_page(content).encode("utf-8"))


def write_page(path: str | Path, content: Mapping[str, Any]) -> Path:
    """Write the page, atomically."""
    text = make_page(content)
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return Path(path)


def write_tables(folder: str | Path, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Path]:
    """Write each table with rows as ``NAME.csv``, atomically.

    Returns:
        the paths.
    """
    written = []
    for name, rows in tables.items():
        if rows:
            written.append(write_csv(Path(folder) / f"{name}.csv", even(rows)))
    return written


def even(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same rows, each with the columns of all, filled with NaN.

    >>> even([{"a": 1}, {"b": 2}])
    [{'a': 1, 'b': nan}, {'a': nan, 'b': 2}]
    """
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return [{key: row.get(key, math.nan) for key in columns} for row in rows]


def _hash(text: str) -> str:
    """Hash of a script or style sheet for the page's Content-Security-Policy, which blocks all others."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"


def _asset(name: str) -> str:
    return (files("vusfa.report") / "assets" / name).read_text(encoding="utf-8")


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ConfigError("a report's charts need plotly; pip install 'vusfa[report]'") from error
    return get_plotlyjs()


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
