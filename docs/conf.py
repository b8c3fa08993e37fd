"""The documentation site: ``make docs``.

The source is the whole repository, so that pages link to each other, to README.md and to benchmarks/results
by the same relative links here and on a repository page. Tutorials run while the site is built.
"""

import os
import sys
from pathlib import Path

import numpy as np
from pygments.lexers.special import TextLexer

sys.path.insert(0, str(Path(__file__).parents[1]))  # for docs.extensions

from rtof_kin import __version__

np.set_printoptions(legacy="1.25")  # defaults as 0.1, not np.float64(0.1)

project = "rtof_kin"
author = "The rtof_kin authors"
copyright = "The rtof_kin authors, BSD-3-Clause"
version = release = __version__
language = "en"
smartquotes = False

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "docs.extensions.commands",
    "docs.extensions.docstrings",
    "docs.extensions.mathml",
]
root_doc = "docs/index"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "docs/**.md",
    "benchmarks/README.md",
    "benchmarks/results/*.md",
    "models/lifter.md",
]
exclude_patterns = ["docs/_build"]

html_theme = "furo"
html_title = "rtof_kin"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_extra_path = ["_static/index.html"]  # the address without a page leads to docs/index.html

autoclass_content = "both"
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("Array", "Mask", "Index", "ArrayLike")}
toc_object_entries = False
default_role = "py:obj"
html_math_renderer = "mathml"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

linkcheck_ignore = [r"https?://(127\.0\.0\.1|localhost|HEAD)"]
linkcheck_timeout, linkcheck_retries = 20, 2
linkcheck_anchors = False

nb_execution_mode = os.environ.get("DOCS_EXECUTION", "cache")  # "off": the tutorials stay without results
suppress_warnings = ["myst-nb.lexer"] if nb_execution_mode == "off" else []  # the language is known by running
nb_execution_cache_path = "docs/_build/notebooks"
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_show_tb = True
nb_merge_streams = True


def _printed_tables(app, docname, source):
    """Give what benchmarks print a title, and headings that follow it; list them on one page."""
    if docname.startswith("benchmarks/results/"):
        text = source[0] if source[0].startswith("# ") else f"# {docname.split('/')[-1]}\n\n{source[0]}"
        text = text if "\n## " in text else text.replace("\n### ", "\n## ")
        source[0] = f"---\norphan: true\n---\n{text}"
    elif docname == "docs/measurements":
        names = sorted(path.stem for path in (Path(__file__).parents[1] / "benchmarks/results").glob("*.md"))
        source[0] += "\n".join(f"- [{name}](../benchmarks/results/{name}.md)" for name in names)


def _decisions(app, docname, source):
    """Put the records of decisions below their list."""
    if docname == "docs/decisions/index":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n[0-9]*\n```\n"


def _pages_that_exist(app, docname, source):
    """Take patterns that match nothing out of the table of contents."""
    if docname == root_doc:
        folder = Path(__file__).parent
        kept = [line for line in source[0].splitlines() if "*" not in line or " " in line or any(folder.glob(line))]
        source[0] = "\n".join(kept)


def setup(app):
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", _printed_tables)
    app.connect("source-read", _decisions)
    app.connect("source-read", _pages_that_exist)
