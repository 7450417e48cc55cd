"""A report's page, read as a browser would: whole, and closed in itself."""

from __future__ import annotations

from html.parser import HTMLParser

VOID = {"meta", "img", "br"}
LOADS = {"src", "href", "xlink:href", "action", "data", "srcset"}


class Page(HTMLParser):
    """Every element is closed in its turn; what is loaded, linked and named is kept."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.ids: list[str] = []
        self.text: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []
        assert "http" not in html.replace("http-equiv", "")
        assert not {"script", "link", "iframe", "object"} & set(self.tags)
        assert all(address.startswith(("#", "data:")) for address in self.loads)
        assert "url(" not in html
        assert len(set(self.ids)) == len(self.ids)
        assert {a[1:] for a in self.loads if a.startswith("#")} <= set(self.ids)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for key, value in attrs if key in LOADS]
        self.ids += [value or "" for key, value in attrs if key == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())
