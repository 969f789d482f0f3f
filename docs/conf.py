"""How Sphinx builds these pages; ``make docs`` runs it with warnings as errors, into ``docs/_build``."""

from __future__ import annotations

import re
from pathlib import Path

project = "persist"
author = "the authors of persist"
copyright = author
release = version = re.findall(r'__version__ = "(.+)"', Path("../persist_cli/__init__.py").read_text(encoding="utf-8"))[
    0
]

extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_build"]
nitpicky = True

myst_heading_anchors = 3  # links to headings are checked


html_theme = "furo"  # its fonts and scripts are local; nothing is asked of another server
html_title = "persist"
html_static_path = ["_static"]
html_css_files = ["persist.css"]
html_show_sourcelink = False
html_copy_source = False
pygments_style = "friendly"
copybutton_prompt_text = "$ "
