"""The site: pages of this folder and the reference from the docstrings, without a request to the network.

``make docs`` builds it. Formulas become MathML, which browsers draw by themselves.
"""

from __future__ import annotations

import re
from importlib import metadata, util
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from pygments.lexers.special import TextLexer

HERE = Path(__file__).resolve().parent

project = "relay-autotune"
author = "the authors of relay-autotune"
release = version = metadata.version(project)

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.apidoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
source_suffix = [".md", ".rst"]
exclude_patterns = ["_build", "draw_figures.py"]

# a page for each package; what the commands do is in --help and on the pages
apidoc_modules = [
    {
        "path": str(HERE.parent / name),
        "destination": f"api/{name}",
        "exclude_patterns": [str(HERE.parent / "autotune" / "cli")],
    }
    for name in ("autotune", "drivers", "sim")
]
autodoc_mock_imports = ["fastapi", "nicegui", "starlette", "uvicorn"]  # the extra of the live page
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say shapes and units
autodoc_default_options = {"members": True, "undoc-members": False}
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_ivar = True

# a name without its module is often in several; references of a docstring need not be called from its text
suppress_warnings = ["ref.footnote", "ref.python"]

html_theme = "furo"
html_title = f"relay-autotune {version}"
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"


def _formula(translator: Any, node: nodes.Node, *, block: bool) -> None:
    translator.body.append(tex2mathml(node.astext(), as_block=block))
    raise nodes.SkipNode


def _plain(app: Any, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Let a bar in a docstring be a magnitude and an underscore an index; to the markup both are references."""
    lines[:] = [line if "`" in line else re.sub(r"(?<=\w)_(?!\w)", r"\_", line.replace("|", "\\|")) for line in lines]


def _has_its_own_page(app: Any, what: str, name: str, thing: object, skip: bool, options: object) -> bool | None:
    """Leave a function out of its package's page where its module has its name: both would be one target.

    It is described on its module's page, which the package's page leads to.
    """
    module = app.env.temp_data.get("autodoc:module") or ""
    if what == "module" and module and getattr(thing, "__module__", "") == f"{module}.{name}":
        return True if util.find_spec(f"{module}.{name}") else None
    return None


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer of formulas."""
    app.add_html_math_renderer(
        "mathml",
        inline_renderers=(lambda translator, node: _formula(translator, node, block=False), None),
        block_renderers=(lambda translator, node: _formula(translator, node, block=True), None),
    )
    app.add_lexer("st", TextLexer)  # Structured Text has none; by that name comes Smalltalk's
    app.connect("autodoc-process-docstring", _plain)
    app.connect("autodoc-skip-member", _has_its_own_page)
    return {"parallel_read_safe": True}
