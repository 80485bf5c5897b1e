"""The parts of the documentation site that need no Sphinx: where links lead, and what the check finds."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from types import ModuleType

import pytest

from tests.helpers.paths import ROOT

SITE = ROOT / "docs" / "site"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> object:
    """Imports modules of the site, which stand beside each other."""
    monkeypatch.syspath_prepend(SITE)
    return importlib.import_module


def module(name: str, load: object) -> ModuleType:
    """One of them."""
    assert callable(load)
    found = load(name)
    assert isinstance(found, ModuleType)
    return found


def test_links_of_a_page_lead_to_the_same_thing_on_the_site(load: object) -> None:
    moved = {"README.md": "index.md", "docs/a.md": "docs/a.md", "crates/x.rs": "source/crates/x.rs.md"}
    text = (
        "[home](../README.md#status) [self](#there) [next](a.md) [code](../crates/x.rs)\n"
        "[web](https://example.org/x.rs)\n"
        "```text\n[in a fence](../crates/x.rs)\n```\n"
    )
    found = module("staging", load).retarget(text, "docs/a.md", lambda path: moved.get(path, path))
    assert found == (
        "[home](../index.md#status) [self](#there) [next](a.md) [code](../source/crates/x.rs.md)\n"
        "[web](https://example.org/x.rs)\n"
        "```text\n[in a fence](../crates/x.rs)\n```\n"
    )


def test_every_guide_is_a_chapter_and_in_the_contents(load: object) -> None:
    staging = module("staging", load)
    shown = staging.chapters(staging.tracked())
    assert len(shown) == len(set(shown))
    assert {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")} <= set(shown)
    contents = (SITE / "contents.md").read_text()
    guides = [name for name in shown if name.startswith("docs/") and name.count("/") == 1]
    assert [name for name in guides if name.removesuffix(".md") not in contents.splitlines()] == []


def test_a_page_of_code_shows_all_of_a_file(load: object) -> None:
    staging = module("staging", load)
    name = "crates/saccade-vla/src/head/dit.rs"
    page = staging.source_page(name)
    assert page.startswith("---\norphan: true\nnosearch: true\n---\n")
    assert (ROOT / name).read_text().rstrip() in page
    assert page.count("\n```rust\n") == 1


def test_help_of_commands_is_what_they_print(load: object) -> None:
    pages = module("command_pages", load)
    assert pages.help_of("act").startswith("usage: saccade act")
    assert "examples:" in pages.help_of("act")


def test_types_of_numpy_have_a_place_in_its_documentation() -> None:
    lines = (SITE / "inventories" / "numpy.inv").read_text().splitlines()
    assert lines[0] == "# Sphinx inventory version 1"
    places = {name: place for name, kind, place in (line.split() for line in lines[3:])}
    for name, place in places.items():
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name
        assert place.startswith("reference/")
        assert place.endswith(".html")
    folders = ("python/saccade", "lab/saccade_lab")
    files = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    used = set(re.findall(r"\bnpt?\.(?:random\.)?(\w+)", "\n".join(path.read_text() for path in files)))
    assert {name.rpartition(".")[2] for name in places} - {"bool"} <= used


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ('<a href="b.html#there">b</a>', None),
        ('<a href="https://example.org">b</a>', None),
        ('<a href="c.html">b</a>', "a.html: c.html leads nowhere"),
        ('<a href="b.html#gone">b</a>', "a.html: b.html#gone has no such place on its page"),
        ('<img src="c.png">', "a.html: c.png leads nowhere"),
        (
            '<script src="https://example.org/x.js"></script>',
            "a.html: loads https://example.org/x.js from another machine",
        ),
        (
            '<link rel="stylesheet" href="//example.org/x.css">',
            "a.html: loads //example.org/x.css from another machine",
        ),
        (
            "<style>p { background: url('https://example.org/x.png') }</style>",
            "a.html: loads https://example.org/x.png from another machine",
        ),
        ('<p style="background: url(x.png)">b</p>', "a.html: x.png leads nowhere"),
        ('<img src="b.html" srcset="c.png 2x">', "a.html: c.png leads nowhere"),
        ("<p>url(https://example.org/x.png)</p>", None),
    ],
)
def test_what_leads_nowhere_or_asks_another_machine_is_found(
    load: object, tmp_path: Path, body: str, problem: str | None
) -> None:
    (tmp_path / "a.html").write_text(f"<html><body>{body}</body></html>")
    (tmp_path / "b.html").write_text('<html><body><p id="there">x</p></body></html>')
    check = module("check_site", load)
    assert check.problems(tmp_path) == ([] if problem is None else [problem])


@pytest.mark.parametrize(
    ("style", "problem"),
    [
        ("@font-face { src: url(font.ttf) format('truetype') }", None),
        ('p { background: url("data:image/png;base64,AAAA") }', None),
        ("/* url(gone.png) */", None),
        ("p { background: url( 'gone.png' ) }", "styles/site.css: gone.png leads nowhere"),
        (
            "@font-face { src: url(https://example.org/f.ttf) }",
            "styles/site.css: loads https://example.org/f.ttf from another machine",
        ),
        (
            '@import "https://example.org/x.css";',
            "styles/site.css: loads https://example.org/x.css from another machine",
        ),
    ],
)
def test_what_a_style_loads_is_found(load: object, tmp_path: Path, style: str, problem: str | None) -> None:
    (tmp_path / "a.html").write_text("<p>x</p>")
    (tmp_path / "styles").mkdir()
    (tmp_path / "styles" / "font.ttf").touch()
    (tmp_path / "styles" / "site.css").write_text(style)
    check = module("check_site", load)
    assert check.problems(tmp_path) == ([] if problem is None else [problem])


def test_a_name_without_a_place_is_found_and_so_is_an_empty_site(load: object, tmp_path: Path) -> None:
    check = module("check_site", load)
    assert check.problems(tmp_path) == [f"{tmp_path}: no page"]
    (tmp_path / "a.html").write_text('<dt id="saccade.Policy">Policy</dt>')
    assert check.missing(tmp_path, ["saccade.Policy", "saccade.Head"]) == ["saccade.Head: is not documented"]
