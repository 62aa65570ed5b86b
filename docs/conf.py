"""Settings of Sphinx, and the pages that are written from the program itself."""

# ruff: noqa: E402
import os
import sys
import typing
from pathlib import Path
from typing import Any

# The width of help texts on the page, whatever the terminal.
os.environ["COLUMNS"] = "100"
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
sys.path.insert(0, str(Path(__file__).parent))

import generate

from fpcal_bayes.core.version import __version__

project = "fpcal_bayes"
author = "fpcal_bayes developers"
copyright = "fpcal_bayes developers"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "numpydoc"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"fpcal_bayes {__version__}"
# A text in single quotes of a docstring is code.
default_role = "literal"
numpydoc_show_class_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": False}
# Drawn from the network by a reader's browser if formulas are there; the pages themselves need nothing.
nitpicky = False
suppress_warnings = ["config.cache"]

# Pages without the modules of the package build in seconds: what a test checks.
_brief = os.environ.get("FPCAL_DOCS") == "brief"
if _brief:
    exclude_patterns.append("reference/api")


def escape_bars(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Keep bars around a quantity, |x|, from being read as a substitution."""
    for i, line in enumerate(lines):
        parts = line.split("`")
        lines[i] = "`".join(part if number % 2 else part.replace("|", "\\|") for number, part in enumerate(parts))


def skip_aliases(app: object, what: str, name: str, thing: object, skip: bool, options: object) -> bool:
    """Leave out names of types, which have no signature."""
    return skip or typing.get_origin(thing) is not None


def setup(app: Any) -> None:
    """Write the generated pages before anything is read."""
    app.connect("autodoc-process-docstring", escape_bars)
    app.connect("autodoc-skip-member", skip_aliases)
    generate.write_pages(Path(__file__).parent, api=not _brief)
