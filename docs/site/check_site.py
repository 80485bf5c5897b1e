"""Checks a built site: its links, its pictures, and that no page or style asks another machine for anything.

What a script would ask for when it runs is not found here.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: Attributes that make a browser request something when it shows the page.
LOADED = {
    **dict.fromkeys(("img", "script", "iframe", "source", "video", "audio", "embed", "input"), ("src",)),
    **dict.fromkeys(("use", "image"), ("href", "xlink:href")),
    "object": ("data",),
}
#: What a style loads, in quotes or without: fonts, pictures, other styles.
OF_STYLE = re.compile(
    r"""url\(\s*(?:"([^"]*)"|'([^']*)'|([^\s)"']*))\s*\)|@import\s+(?:"([^"]*)"|'([^']*)')"""
)
COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)


def of_style(text: str) -> list[str]:
    """The addresses that a style sheet, or the style of an element, loads."""
    return ["".join(parts) for parts in OF_STYLE.findall(COMMENT.sub("", text))]


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
        self._in_style = False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the attributes of an element."""
        values = {name: value for name, value in attrs if value}
        self.ids |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag == "link" and "href" in values and values.get("rel") not in ("canonical", "author"):
            self.loaded.append(values["href"])
        self.loaded += [values[name] for name in LOADED.get(tag, ()) if name in values]
        if tag in ("img", "source") and "srcset" in values:
            self.loaded += [part.split()[0] for part in values["srcset"].split(",") if part.strip()]
        self.loaded += of_style(values.get("style", ""))
        self._in_style = tag == "style"

    def handle_endtag(self, tag: str) -> None:
        """Notes the end of a style."""
        self._in_style = False

    def handle_data(self, data: str) -> None:
        """Notes what a style loads."""
        if self._in_style:
            self.loaded += of_style(data)


def problems(html: Path) -> list[str]:
    """What is wrong, as lines for a reader; empty for a whole site.

    Args:
        html: The folder of the site.
    """
    pages = {path.resolve(): Page(path) for path in sorted(html.rglob("*.html"))}
    found = [] if pages else [f"{html}: no page"]
    styles = {path.resolve(): of_style(path.read_text(encoding="utf-8")) for path in html.rglob("*.css")}
    loads = {path: page.loaded for path, page in pages.items()} | styles
    for path, loaded in loads.items():
        name = path.relative_to(html.resolve()).as_posix()
        for url in loaded:
            if urlsplit(url).netloc or urlsplit(url).scheme in ("http", "https"):
                found.append(f"{name}: loads {url} from another machine")
        for url in [*(pages[path].links if path in pages else ()), *loaded]:
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
