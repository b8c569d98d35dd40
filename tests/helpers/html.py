"""What a browser would fetch, run or show of a page."""

import json
from html.parser import HTMLParser
from typing import Any

#: Elements that have no end.
VOID = ("meta", "img", "br", "input")
#: What a page may be large (bytes).
MOST = 2_000_000


class Page(HTMLParser):
    """What a browser would fetch, run or show."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.references: list[str] = []
        self.pictures: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.ids: list[str] = []
        self.data = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        told = dict(attrs)
        keys = ("href", "src", "srcset", "action", "data", "poster")
        self.references += [v or "" for k, v in attrs if k in keys]
        self.pictures += [v or "" for k, v in attrs if k in ("src", "srcset")]
        self.ids += [told["id"] or ""] if "id" in told else []
        if tag == "img":
            assert told["alt"]
        if tag == "svg":
            assert told["aria-label"]
        if tag == "input":
            assert told["aria-label"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"] and data.startswith("{"):
            self.data = data
        if self.open[-1:] not in (["style"], ["script"]):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    @property
    def motion(self) -> dict[str, Any]:
        """What the moving picture draws."""
        return json.loads(self.data)


def stands_alone(html: str, pictures: int, links: tuple[str, ...] = ()) -> None:
    """A page fetches nothing, is small, and has what readers of all kinds need.

    It leads to nothing but these files beside it.
    """
    got = Page(html)
    assert not got.open
    assert not {"link", "iframe", "object", "embed"} & set(got.tags)
    assert set(links) <= set(got.references)
    for reference in [each for each in got.references if each not in links]:
        assert reference.startswith(("data:image/png;base64,", "#"))
        assert not reference.startswith("#") or reference[1:] in got.ids
    assert len(got.ids) == len(set(got.ids))
    assert "url(" not in html and "@import" not in html
    assert "://" not in html.replace("http://www.w3.org/2000/svg", "")  # a name, not a place
    assert "default-src 'none'" in html
    assert got.tags.count("title") == got.tags.count("h1") == got.tags.count("main") == 1
    assert '<html lang="en">' in html and 'name="viewport"' in html
    assert "prefers-color-scheme: dark" in html and "prefers-reduced-motion" in html
    assert got.tags.count("img") == pictures
    assert len(html.encode()) < MOST
