"""A report as Markdown, and the same Markdown as one HTML file that contains its pictures."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token

from saccade_lab.study.section import Section, templates
from saccade_lab.study.table import Provenance


@dataclass(frozen=True)
class SavedPicture:
    """A picture that is on disk.

    Attributes:
        caption: As in ``section.Figure``.
        file: Its path relative to the report, for the Markdown.
        data: The whole picture as a ``data:`` URI, for the HTML.
    """

    caption: str
    file: str
    data: str


@dataclass(frozen=True)
class Part:
    """A section as it appears in the report.

    Attributes:
        section: Its text and tables.
        pictures: Its figures, written to disk.
        measured: Whether there is anything to show.
        provenance: Where its table comes from, if it has one.
    """

    section: Section
    pictures: Sequence[SavedPicture] = ()
    measured: bool = True
    provenance: Provenance | None = None


def to_markdown(title: str, opening: Sequence[str], parts: Sequence[Part]) -> str:
    """The whole report; ``opening`` has its first paragraphs."""
    text = (
        templates()
        .get_template("report.md.jinja")
        .render(title=title, opening=opening, parts=parts, anchor=anchor)
    )
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def to_html(markdown: str, pictures: Mapping[str, str]) -> str:
    """The same report as one page.

    Args:
        markdown: The result of ``to_markdown``. HTML in it is shown as text.
        pictures: The ``data:`` URI of each file that the Markdown refers to.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    parser.add_render_rule("table_open", open_table)
    parser.add_render_rule("table_close", close_table)
    tokens = parser.parse(markdown)
    title = ""
    for token, following in itertools.pairwise(tokens):
        if token.type == "heading_open" and token.tag == "h1":
            title = following.content
        if token.type == "heading_open" and token.tag == "h2":
            token.attrSet("id", anchor(following.content))
        for child in token.children or ():
            if child.type == "image":
                source = str(child.attrs["src"])
                child.attrSet("src", pictures.get(unquote(source), source))
    body = parser.renderer.render(tokens, parser.options, {})
    return templates().get_template("report.html.jinja").render(title=title, body=body)


def open_table(self: Any, tokens: Sequence[Token], index: int, options: Any, env: Any) -> str:
    """Lets a wide table scroll by itself."""
    return '<div class="wide"><table>\n'


def close_table(self: Any, tokens: Sequence[Token], index: int, options: Any, env: Any) -> str:
    """Ends what ``open_table`` began."""
    return "</table></div>\n"


def anchor(heading: str) -> str:
    """The id of a heading, as GitHub makes it from Markdown.

    Example:
        >>> anchor("Fast modes: actions, success and time")
        'fast-modes-actions-success-and-time'
    """
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
