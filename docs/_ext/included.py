"""Files that a page includes: a line that is nothing but a link to one becomes the file's text.

On a plain view of the Markdown, as on GitHub, it stays the link. This holds for the tables in docs/generated,
for the examples, and for the Markdown files beside docs, whose links are then those of a page in docs.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

__all__ = ["include_files", "setup"]

_LINK = re.compile(
    r"^\[[^\]\n]+\]\((generated/[\w-]+\.md|\.\./[A-Z]+\.md|\.\./examples/[\w/]+\.(?:py|yaml))\)$",
    flags=re.MULTILINE,
)
_BESIDE = re.compile(r"\]\(([A-Z]+)\.md\)")


def include_files(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the links of one page, in place."""

    def text(link: re.Match[str]) -> str:
        path = Path(app.srcdir, link[1]).resolve()
        app.env.note_dependency(str(path))
        found = path.read_text(encoding="utf-8").replace("](docs/", "](")
        language = {".py": "python", ".yaml": "yaml"}.get(path.suffix)
        if language:
            return f"```{language}\n{found}```"
        if link[1].startswith("generated/"):
            return f":::{{div}} numbers\n{found}\n:::"
        return _BESIDE.sub(lambda name: f"]({name[1].lower()}.md)", found)

    source[0] = _LINK.sub(text, source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the replacing."""
    app.connect("source-read", include_files)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
