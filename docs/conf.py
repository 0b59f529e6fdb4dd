"""Settings of the documentation site: ``make docs``.

The theme is pydata-sphinx-theme: PyTorch and TorchRL build their sites on it, so readers who come from there
find the sections, the search and the reference where they expect them. It brings its fonts and scripts along.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_ext")]
# The kernels of the tutorials read the package from this checkout too, and share the cores with the build.
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])
os.environ.setdefault("OMP_NUM_THREADS", "2")

import vusfa  # noqa: E402

project = "vusfa"
author = "the vusfa maintainers"
copyright = "the vusfa maintainers, MIT license"
version = release = vusfa.__version__

extensions = [
    "docstrings",
    "included",
    "mathml",
    "pages",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_design",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "generated", "README.md", "jupyter_execute"]
html_static_path = ["_static"]

# Pages
highlight_language = "none"
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = os.environ.get("VUSFA_DOCS_EXECUTE", "cache")
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_render_markdown_format = "myst"
# Annotations are short, and two modules have a class Comparison.
suppress_warnings = ["mystnb.unknown_mime_type", "ref.python"]

# API reference: one page for each name in the __all__ of the modules that api.md lists.
autosummary_generate = True
autosummary_ignore_module_all = False
autosummary_imported_members = True
autosummary_context = {"folders": {"vusfa.sources", "vusfa.experiments"}}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_inherit_docstrings = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88

# Theme
html_theme = "pydata_sphinx_theme"
html_math_renderer = "mathml"
html_title = f"vusfa {release}"
html_css_files = ["site.css"]
html_theme_options: dict[str, Any] = {
    "navbar_align": "left",
    "show_toc_level": 2,
    "header_links_before_dropdown": 7,
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
}
html_show_sourcelink = False
# Pages without pages below them need no tree of their section.
html_sidebars = {"start": [], "results": []}
