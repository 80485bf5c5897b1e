"""Checks a built site: its links, its pictures, and that no page asks another machine for anything."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: Attributes that make a browser request something when it shows the page.
LOADED = {"img": "src", "script": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src"}


class Page(HTMLParser):
    """What a page refers to and what can be referred to in it.

    Attributes:
        ids: Its anchors.
        links: Targets of its links.
        loaded: What a browser loads to show it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the attributes of an element."""
        values = {name: value for name, value in attrs if value}
        self.ids |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag == "link" and "href" in values and values.get("rel") not in ("canonical", "author"):
            self.loaded.append(values["href"])
        if tag in LOADED and LOADED[tag] in values:
            self.loaded.append(values[LOADED[tag]])


def problems(html: Path) -> list[str]:
    """What is wrong, as lines for a reader; empty for a whole site.

    Args:
        html: The folder of the site.
    """
    pages = {path.resolve(): Page(path) for path in sorted(html.rglob("*.html"))}
    found = [] if pages else [f"{html}: no page"]
    for path, page in pages.items():
        name = path.relative_to(html.resolve()).as_posix()
        for url in page.loaded:
            if urlsplit(url).netloc or urlsplit(url).scheme in ("http", "https"):
                found.append(f"{name}: loads {url} from another machine")
        for url in [*page.links, *page.loaded]:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                found.append(f"{name}: {url} leads nowhere")
            elif parts.fragment and target in pages and not is_anchor(parts.fragment, pages[target]):
                found.append(f"{name}: {url} has no such place on its page")
    return found


def is_anchor(fragment: str, page: Page) -> bool:
    """Whether a page has this place; an empty one and what the search highlights are always there."""
    return not fragment or unquote(fragment) in page.ids


def missing(folder: Path, names: Sequence[str]) -> list[str]:
    """The names that have no place of their own on the pages of a folder, as lines for a reader."""
    ids = set[str]().union(*(Page(path).ids for path in folder.rglob("*.html")))
    return [f"{name}: is not documented" for name in names if name not in ids]


if __name__ == "__main__":
    lines = problems(Path(sys.argv[1]))
    print("\n".join(lines))
    sys.exit(1 if lines else 0)
