"""Sphinx: `make docs`. Warnings are errors."""

import importlib.metadata

project = "lampopt"
author = "the lampopt developers"
copyright = f"2026 {author}"
release = importlib.metadata.version("lampopt")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
default_role = "code"  # docstrings write `name`

html_theme = "furo"
html_title = f"lampopt {release}"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
add_module_names = False
napoleon_google_docstring = False


def setup(app):
    app.connect("autodoc-process-docstring", bars_are_bars)


def bars_are_bars(app, what, name, obj, options, lines):
    """|x| is a magnitude in our docstrings, not a substitution."""
    lines[:] = [line if "``" in line else line.replace("|", "\\|") for line in lines]
