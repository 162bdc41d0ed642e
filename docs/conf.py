"""Sphinx configuration of the documentation site: `sphinx-build -W -c docs . build/site`.

The source is the whole repository, so that links between README, docs and config lead to the same places as in the
files themselves.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from pygments.lexers.special import TextLexer

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

project = "pHRI Real2Sim"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "config/README.md",
    "examples/**.md",
    "resources/**/README.md",
]
html_theme = "furo"
html_title = project
html_show_copyright = False
html_copy_source = False

myst_heading_anchors = 4
myst_enable_extensions = ["deflist", "dollarmath"]
# a link to a file that is no page (code, a table of settings) offers that file
suppress_warnings = ["myst.header"]

# docstrings name arguments and classes of the library in single backticks
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = False

_LINK = re.compile(r"\[([^\]\[]+)\]\(([^)#:]+)\)")


def _without_folders(app, name: str, source: list[str]) -> None:
    """Turn links to folders, which a site cannot show, into code."""
    here = (ROOT / name).parent

    def shown(match: re.Match[str]) -> str:
        return f"`{match[2]}`" if (here / match[2]).is_dir() else match[0]

    source[0] = _LINK.sub(shown, source[0])


def setup(app) -> None:
    """Called by Sphinx."""
    # drawn where the file itself is read; the site needs no script from elsewhere
    app.add_lexer("mermaid", TextLexer)
    app.connect("source-read", _without_folders)
