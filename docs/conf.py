"""How Sphinx builds the site from these pages: ``make docs``."""

from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

from sb3_esad import __version__

project = "sb3_esad"
author = project_copyright = "The sb3_esad authors"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_heading_anchors = 3  # as GitHub names them, so that links work there, too

html_theme = "furo"
html_title = f"sb3_esad {release}"

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True


def find_short_names(app: Sphinx, doctree: nodes.document) -> None:
    """Let a docstring say :class:`ESADLEND` wherever the class lives."""
    for reference in doctree.findall(pending_xref):
        if reference.get("refdomain") == "py":
            reference["refspecific"] = True


def skip_fields(app: Sphinx, what: str, name: str, member: object, skip: bool, options: object) -> bool | None:
    """Leave out the fields of records, which their docstrings describe as parameters."""
    return True if type(member).__name__ == "_tuplegetter" else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Add what the extensions above do not do."""
    app.connect("doctree-read", find_short_names)
    app.connect("autodoc-skip-member", skip_fields)
    return {"parallel_read_safe": True}
