"""How Sphinx makes the site of the pages that `build.py` has staged."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from sphinx.application import Sphinx

import saccade

SITE = Path(__file__).resolve().parent
sys.path.insert(0, str(SITE))
FONT = Path(str(find_spec("ziamath").origin)).parent / "fonts" / "STIXTwoMath-Regular.ttf"

project = "saccade"
author = "The saccade developers"
project_copyright = "2026, the saccade developers; MIT or Apache-2.0"
version = release = saccade.__version__
root_doc = "index"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "mathml",
]

# Markdown as on the page of the repository: formulas between dollars and in fences, anchors of headings.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
myst_dmath_double_inline = False

autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 90
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# A type without its module may be one of several classes, such as saccade's and the lab's `Policy`.
suppress_warnings = ["ref.python"]
# Packages that no environment of the repository has beside the others.
autodoc_mock_imports = ["ray", "libero", "robosuite", "bddl"]

html_theme = "furo"
html_title = f"saccade {release}"
html_static_path = [str(SITE / "static")]
html_css_files = ["site.css"]
# Not every reader has a font with the tables that MathML needs; this one is free, and comes with ziamath.
html_extra_path = [str(FONT)]
html_copy_source = False
html_show_sourcelink = False
# Light and dark have styles of their own.
pygments_style = "friendly"
pygments_dark_style = "github-dark"
highlight_language = "text"

# Python's is the published one; NumPy's has the types that signatures of saccade name.
intersphinx_mapping = {
    "python": ("https://docs.python.org/3", str(SITE / "inventories" / "python.inv")),
    "numpy": ("https://numpy.org/doc/stable", str(SITE / "inventories" / "numpy.inv")),
}


def literal_types(app: Sphinx, what: str, name: str, of: object, options: object, lines: list[str]) -> None:
    """Types of attributes are Python, which reStructuredText would read as markup."""
    for place, line in enumerate(lines):
        field, _, kind = line.partition(": ")
        if field.startswith(":vartype ") and kind and not kind.startswith(("`", ":")):
            lines[place] = f"{field}: ``{kind}``"


def setup(app: Sphinx) -> None:
    """Runs after Napoleon, which writes the fields."""
    app.connect("autodoc-process-docstring", literal_types, priority=900)
