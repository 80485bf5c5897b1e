"""The parts of the documentation site that need no Sphinx: where links lead, and what the check finds."""

from __future__ import annotations

import importlib
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
    ],
)
def test_what_leads_nowhere_or_asks_another_machine_is_found(
    load: object, tmp_path: Path, body: str, problem: str | None
) -> None:
    (tmp_path / "a.html").write_text(f"<html><body>{body}</body></html>")
    (tmp_path / "b.html").write_text('<html><body><p id="there">x</p></body></html>')
    check = module("check_site", load)
    assert check.problems(tmp_path) == ([] if problem is None else [problem])


def test_a_name_without_a_place_is_found_and_so_is_an_empty_site(load: object, tmp_path: Path) -> None:
    check = module("check_site", load)
    assert check.problems(tmp_path) == [f"{tmp_path}: no page"]
    (tmp_path / "a.html").write_text('<dt id="saccade.Policy">Policy</dt>')
    assert check.missing(tmp_path, ["saccade.Policy", "saccade.Head"]) == ["saccade.Head: is not documented"]
