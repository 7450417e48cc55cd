"""Sphinx's settings for the site of these pages: ``sphinx-build -W docs site``."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import perchctl

project = "perchctl"
author = "The perchctl contributors"
copyright = author
version = release = perchctl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinxcontrib.mermaid"]
source_suffix = {".md": "markdown"}
root_doc = "README"
myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid", "math"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
html_theme = "furo"
html_title = f"perchctl {release}"

PAGE = re.compile(r"^- \[[^\]]*\]\(([\w-]+)\.md\): ", re.MULTILINE)
EXAMPLE = re.compile(r"\]\(\.\./examples/(\w+)\.py\)")
OUTSIDE = re.compile(r"(?<!!)\[([^\]]*)\]\(\.\./[^)]*\)")


def adapt(app: Any, name: str, source: list[str]) -> None:
    """Read the order of the pages from the index, put the examples behind the API, and unlink what
    is not on the site.

    The pages are written to be read in the repository, too, where they link to the code.
    """
    if name == root_doc:
        pages = "\n".join([*PAGE.findall(source[0]), "api"])
        source[0] += f"\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"
    if name == "api":
        for path in sorted(Path(app.srcdir).parent.glob("examples/*.py")):
            source[0] += f"\n({path.stem})=\n## {path.name}\n\n"
            source[0] += f"```{{literalinclude}} ../examples/{path.name}\n```\n"
    source[0] = OUTSIDE.sub(r"\1", EXAMPLE.sub(r"](#\1)", source[0]))


def write_start_page(app: Any, error: Exception | None) -> None:
    """Copy the index to where web servers look for it."""
    if error is None and app.builder.name == "html":
        shutil.copyfile(Path(app.outdir) / f"{root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: Any) -> None:
    """Register the functions above; Sphinx calls this."""
    app.connect("source-read", adapt)
    app.connect("build-finished", write_start_page)
