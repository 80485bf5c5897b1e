"""docs/equations.md names files and functions that exist, and comments cite equations that exist."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "equations.md"
#: The heading of an equation, the formulas below it, its source and its code.
EQUATION = re.compile(r"^### (\d+)\. (.+?)\n(.*?)(?=^##|\Z)", re.MULTILINE | re.DOTALL)
#: A file and what of it computes the equation.
ROOM = re.compile(r"\[([^\]]+)\]\(\.\./(crates/[^)]+)\) ((?:`\w+`(?:, )?)+)")
#: "equation 3 of docs/equations.md", "equations 3 and 5 to 7 of docs/equations.md".
CITATION = re.compile(r"\b[Ee]quations? ((?:\d+|, | and | to |\s)+?) of\s+docs/equations\.md")
#: In the page itself.
REFERENCE = re.compile(r"\bequations? ((?:\d+)(?:(?:, | and | or | to )\d+)*)")
#: The first lines of a paragraph of comments in Rust and Python.
COMMENT = re.compile(r"\n\s*(?://[/!]?|#:?) ?")


def equations() -> dict[int, tuple[str, str]]:
    """The title and the text of each equation."""
    return {int(number): (title, text) for number, title, text in EQUATION.findall(PAGE.read_text("utf-8"))}


def sources() -> list[Path]:
    """The tracked files of Rust and Python."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("not a git repository")
    paths = [ROOT / name for name in listed.stdout.split("\0") if name.endswith((".rs", ".py"))]
    return [path for path in paths if path.is_file() and path != Path(__file__)]


def is_defined(name: str, code: str) -> bool:
    """Whether code of Rust defines a function, a type or a constant with this name."""
    return re.search(rf"\b(?:fn|struct|enum|trait|type|const|static) {name}\b", code) is not None


def test_equations_are_numbered_in_order() -> None:
    assert list(equations()) == list(range(1, len(equations()) + 1))
    assert len(equations()) > 50


@pytest.mark.parametrize("number", equations())
def test_an_equation_has_a_formula_a_source_and_code_that_exists(number: int) -> None:
    title, text = equations()[number]
    assert "```math\n" in text, title
    assert re.search(r"^- Source: \S", text, re.MULTILINE), title
    code = re.search(r"^- Code: .*\.$", text, re.MULTILINE)
    assert code is not None, title
    rooms = ROOM.findall(code[0])
    assert len(rooms) == code[0].count("]("), f"{title}: {code[0]}"
    for shown, path, names in rooms:
        assert path.endswith(f"/src/{shown}"), f"{title}: {path} is shown as {shown}"
        assert (ROOT / path).is_file(), f"{title}: no file {path}"
        found = (ROOT / path).read_text(encoding="utf-8")
        for name in re.findall(r"`(\w+)`", names):
            assert is_defined(name, found), f"{title}: {path} does not define {name}"


def test_references_within_the_page_exist() -> None:
    text = re.sub(r"^- Source: .*$", "", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    numbers = {int(number) for cited in REFERENCE.findall(text) for number in re.findall(r"\d+", cited)}
    assert numbers
    assert numbers <= set(equations())


def test_comments_cite_equations_that_exist() -> None:
    known, cited = set(equations()), 0
    for path in sources():
        text = COMMENT.sub(" ", path.read_text(encoding="utf-8"))
        for numbers in CITATION.findall(text):
            cited += 1
            unknown = {int(number) for number in re.findall(r"\d+", numbers)} - known
            assert not unknown, f"{path.relative_to(ROOT)}: equation {unknown}"
        # A specification that is not in the repository.
        if path.suffix == ".rs":
            assert not re.search(r"\bspec \d|\bspec I\d", text), path.relative_to(ROOT)
    assert cited >= 10


def test_citations_are_found_across_lines() -> None:
    text = COMMENT.sub(
        " ", "//! Sampling (equations 14,\n    //! 15 and 17 of\n//! docs/equations.md): steps."
    )
    assert [re.findall(r"\d+", numbers) for numbers in CITATION.findall(text)] == [["14", "15", "17"]]
    assert is_defined("layer_norm", "pub fn layer_norm(")
    assert not is_defined("layer", "pub fn layer_norm(")
