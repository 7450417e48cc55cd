"""HTML out of values: what is text is escaped, always; only what this module made is not."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

from perchctl.report.words import kept_together

_VOID = frozenset({"img", "meta", "br"})


class Markup(str):
    """HTML that is safe as it is. A plain string is text, and is escaped."""

    __slots__ = ()


Content = str | Iterable[str] | None


def text(content: Content) -> Markup:
    """Text escaped, markup as it is, several one after the other."""
    if content is None:
        return Markup("")
    if isinstance(content, Markup):
        return content
    if isinstance(content, str):
        return Markup(html.escape(content))
    return Markup("".join(text(part) for part in content))


def tag(name: str, content: Content = None, /, **attributes: str | None) -> Markup:
    """One element. An attribute's trailing underscore is dropped (`class_`), None leaves it out."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{text(content)}</{name}>")


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers_from: int = 1,
    caption: str | None = None,
) -> Markup:
    """A table in a box of its own, which scrolls where the window is narrower. From the column
    `numbers_from` on cells stand right."""

    def cells(name: str, row: Sequence[str]) -> Markup:
        return tag(
            "tr",
            [tag(name, c, class_="n" if i >= numbers_from else None) for i, c in enumerate(row)],
        )

    parts = [tag("caption", caption)] if caption else []
    if head:
        parts.append(tag("thead", cells("th", head)))
    parts.append(tag("tbody", [cells("td", row) for row in rows]))
    return tag("div", tag("table", parts), class_="wide")


def pairs(rows: Iterable[tuple[str, str]]) -> Markup:
    """Names and values beneath each other."""
    return tag(
        "dl",
        [tag("div", [tag("dt", name), tag("dd", kept_together(value))]) for name, value in rows],
    )
