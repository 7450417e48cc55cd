"""Sphinx's settings for the site of these pages: ``sphinx-build -W docs site``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import latex2mathml.converter
import mermaidx
from docutils import nodes
from sphinx.util.docutils import SphinxDirective

import perchctl

project = "perchctl"
author = "The perchctl contributors"
copyright = author
version = release = perchctl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
root_doc = "index"
myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid", "math"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
html_math_renderer = "mathml"
html_copy_source = False  # the sources of two pages are not what they show
html_theme = "furo"
html_title = f"perchctl {release}"
html_static_path = ["site.css"]
html_css_files = ["site.css"]

ROOT = Path(__file__).resolve().parents[1]
FROM_THE_ROOT = {"index": "README.md", "contributing": "CONTRIBUTING.md"}
"""Pages of the site that are files of the repository's root: name on the site, and file."""
LIST_OF_PAGES = Path(__file__).with_name("README.md")

GROUP = re.compile(r"^## (.+)\n\n((?:- .+\n)+)", re.MULTILINE)
PAGE = re.compile(r"^- \[[^\]]*\]\(([\w-]+)\.md\): ", re.MULTILINE)
EXAMPLE = re.compile(r"\]\(\.\./examples/(\w+)\.py\)")
OUTSIDE = re.compile(r"(?<!!)\[([^\]]*)\]\(\.\./[^)]*\)")


class Diagram(SphinxDirective):
    """A Mermaid diagram as an SVG in the page, drawn here: readers need neither a script nor a
    network."""

    has_content = True
    drawn = 0

    def run(self) -> list[nodes.Node]:
        Diagram.drawn += 1
        svg = mermaidx.render("\n".join(self.content)).svg()
        # Two diagrams on a page must not share the names that their styles and arrowheads have.
        svg = svg.replace("my-svg", f"diagram-{Diagram.drawn}")
        return [nodes.raw("", f'<div class="diagram">{svg}</div>', format="html")]


def write_inline_equation(translator: Any, node: nodes.math) -> None:
    """Write an equation in a sentence as MathML, which browsers draw without a script or a
    network."""
    translator.body.append(latex2mathml.converter.convert(node.astext()))
    raise nodes.SkipNode


def write_display_equation(translator: Any, node: nodes.math_block) -> None:
    """Write an equation on its own line as MathML."""
    translator.body.append(latex2mathml.converter.convert(node.astext(), display="block"))
    raise nodes.SkipNode


def adapt(app: Any, name: str, source: list[str]) -> None:
    """Fill the pages that come from the root, the sidebar and the examples behind the API, and
    unlink what is not on the site.

    The pages are written to be read in the repository, too, where they link to the code.
    """
    if name in FROM_THE_ROOT:
        text = (ROOT / FROM_THE_ROOT[name]).read_text(encoding="utf-8")
        # As a page in docs would link to it.
        links = re.sub(r"\]\((?!https?:|#)", "](../", text)
        source[0] = links.replace("](../docs/", "](")
    if name == "api":
        for path in sorted(ROOT.glob("examples/*.py")):
            source[0] += f"\n({path.stem})=\n## {path.name}\n\n"
            source[0] += f"```{{literalinclude}} ../examples/{path.name}\n```\n"
    source[0] = to_site(source[0])
    if name == root_doc:
        source[0] += sidebar()


def to_site(text: str) -> str:
    """The text of a page in docs with its links as the site has them."""
    for page, file in FROM_THE_ROOT.items():
        text = text.replace(f"](../{file}", f"]({page}.md")
    return OUTSIDE.sub(r"\1", EXAMPLE.sub(r"](#\1)", text))


def sidebar() -> str:
    """The groups of the list of pages, as the site's tables of contents."""
    groups = GROUP.findall(to_site(LIST_OF_PAGES.read_text(encoding="utf-8")))
    tables = [f"\n```{{toctree}}\n:hidden:\n\n{LIST_OF_PAGES.stem}\n```\n"]
    for title, lines in groups:
        pages = "\n".join(PAGE.findall(lines))
        tables.append(f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{pages}\n```\n")
    return "".join(tables)


def setup(app: Any) -> None:
    """Register the parts above; Sphinx calls this."""
    app.add_directive("mermaid", Diagram)
    inline, display = (write_inline_equation, None), (write_display_equation, None)
    app.add_html_math_renderer("mathml", inline, display)
    app.connect("source-read", adapt)
