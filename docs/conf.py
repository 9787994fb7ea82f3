"""Settings of the documentation site, which `make docs` builds into docs/_build/html without a network."""

# Why Sphinx, myst-nb and the pydata theme: NumPy, pandas, SciPy and scikit-image have sites of this theme, so readers
# know its search and its two colour themes. myst-nb shows the outputs that are saved in a notebook, without a kernel.

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import click
from docutils import nodes
from sphinx.application import Sphinx

import epypes

DOCS = Path(__file__).parent

project = html_title = "EPypes"
author = "The EPypes developers"
copyright = author  # noqa: A001 - Sphinx reads this name
version = release = epypes.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "examples"]
templates_path = ["_templates"]
default_role = "code"
# Options keep their dashes (--out), and lines of files their quotes.
smartquotes = False

toc_object_entries_show_parents = "hide"

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
# References to public names must be right. Signatures also have types of inner modules and other libraries.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!epypes(_widgets|\.errors|\.wire)?\.[A-Za-z]\w*$).*")]
# A class and a message may have one name: epypes.Image and epypes.wire.Image.
suppress_warnings = ["ref.python"]

# Literal blocks of docstrings are trees, tables and shell lines as well as Python.
highlight_language = "none"

myst_enable_extensions = ["attrs_inline", "colon_fence"]
myst_heading_anchors = 3
# Tutorials are shown with the outputs that are saved in them. A panel needs a kernel: its saved picture is shown.
nb_execution_mode = "off"
nb_merge_streams = True
nb_mime_priority_overrides = [("html", "application/vnd.jupyter.widget-view+json", None)]

html_theme = "pydata_sphinx_theme"
html_theme_options = {
    "navbar_align": "left",
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"index": [], "quickstart": [], "glossary": []}
html_static_path = ["_static"]
html_css_files = ["epypes.css"]
html_copy_source = False

# What an earlier build has written below this folder, perhaps of files and names that are gone.
for folder in ("tutorials", "reference/generated"):
    shutil.rmtree(DOCS / folder, ignore_errors=True)

# Sphinx reads what is below this folder, so the tutorials are copied into it.
(DOCS / "tutorials").mkdir()
for pattern in ("*.ipynb", "lanes.py", "test_lanes.py"):
    for path in (DOCS.parent / "notebooks").glob(pattern):
        shutil.copy2(path, DOCS / "tutorials")


def link_tutorials(app: Sphinx, page: str, source: list[str]) -> None:
    """Turn links to and in notebooks, as they are right in the repository, into those between their pages."""
    to_notebooks = re.sub(r"\]\(((?:\.\./)*)\.\./notebooks/", r"](\1tutorials/", source[0])
    source[0] = to_notebooks.replace("](../docs/", "](../")


def add_examples(app: Sphinx, ctx: click.Context, lines: list[str]) -> None:
    """Write the examples of a command below its options."""
    if examples := getattr(ctx.command, "examples", ()):
        lines += [".. rubric:: Examples", "", ".. code-block:: sh", "", *(f"   {line}" for line in examples), ""]


def write_dashes(app: Sphinx, doctree: nodes.document) -> None:
    """Write a dash between a parameter and its description, as smartquotes would."""
    for text in [*doctree.findall(nodes.Text)]:
        if text == " -- ":
            text.parent.replace(text, nodes.Text(" \N{EN DASH} "))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register what this file adds to Sphinx."""
    app.connect("source-read", link_tutorials)
    app.connect("doctree-read", write_dashes)
    app.connect("sphinx-click-process-epilog", add_examples)
    return {"parallel_read_safe": True}
