"""Equations as MathML, which browsers draw themselves: no script, no font and no server is needed."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

__all__ = ["setup"]


#: What docutils does not know of LaTeX, in what it knows; brackets grow by themselves.
_KNOWN = {r"\dots": r"\ldots", r"\big": "", r"\Big": ""}


def _write(translator: Any, node: nodes.Element, block: bool) -> None:
    text = node.astext().strip()
    if block and "\\\\" in text and "\\begin" not in text:
        text = f"\\begin{{aligned}}{text}\\end{{aligned}}"
    text = re.sub(r"\\(?:dots|[bB]ig)(?![a-zA-Z])", lambda name: _KNOWN[name[0]], text)
    try:
        equation = tex2mathml(text, as_block=block)
    except MathError as error:
        logging.getLogger(__name__).warning("equation %r: %s", text, error, location=node)
        equation = translator.encode(text)
    translator.body.append(f'<div class="equation">{equation}</div>' if block else equation)
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer."""
    app.add_html_math_renderer(
        "mathml",
        (lambda translator, node: _write(translator, node, False), None),
        (lambda translator, node: _write(translator, node, True), None),
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}
