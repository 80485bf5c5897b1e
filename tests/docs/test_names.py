"""Names of saccade in prose are names that exist: in docstrings, comments, pages and templates."""

from __future__ import annotations

import ast
import importlib
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tests.helpers.paths import ROOT

#: The changelog also names what is gone.
CHANGELOG = ROOT / "CHANGELOG.md"
#: A dotted name that begins with ``saccade`` or ``saccade_lab`` and is not in a path or a longer name.
NAME = re.compile(r"(?<![\w./@\\-])saccade(?:_lab)?(?:\.[A-Za-z_]\w*)+(?![\w/-])")
#: What reads like such a name and is none: a group of entry points, a file, and names that a test makes up.
OTHERS = {"saccade.commands", "saccade.json", "saccade.a", "saccade.a.b", "saccade.a.b.c"}
SUFFIXES = (".py", ".pyi", ".md", ".jinja")


def tracked() -> list[Path]:
    """The tracked files with prose."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("not a git repository")
    paths = [ROOT / name for name in listed.stdout.split("\0") if name.endswith(SUFFIXES)]
    return [path for path in paths if path.is_file() and path != CHANGELOG]


def prose(path: Path) -> str:
    """The text of a page; of Python, its docstrings and comments."""
    text = path.read_text(encoding="utf-8")
    return "\n".join(python_prose(text)) if path.suffix in (".py", ".pyi") else text


def python_prose(source: str) -> Iterator[str]:
    """The docstrings and comments of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield ast.get_docstring(node) or ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute or field of one."""
    first, *rest = name.split(".")
    found: object = importlib.import_module(first)
    for part in rest:
        if isinstance(found, ModuleType) and not hasattr(found, part):
            try:
                found = importlib.import_module(f"{found.__name__}.{part}")
            except ModuleNotFoundError as error:
                # A package that a module needs may be missing. Then the module exists all the same.
                return error.name is not None and error.name.partition(".")[0] != first
        elif isinstance(found, type) and any(
            part in vars(base).get("__annotations__", {}) for base in found.__mro__
        ):
            return True
        elif hasattr(found, part):
            found = getattr(found, part)
        else:
            return False
    return True


def test_every_name_of_saccade_in_prose_exists() -> None:
    named = {(name, path) for path in tracked() for name in NAME.findall(prose(path))}
    assert len(named) > 100
    known = {name: exists(name) for name in {name for name, _ in named} - OTHERS}
    unknown = [f"{path.relative_to(ROOT)}: {name}" for name, path in named if not known.get(name, True)]
    assert not unknown, "\n".join(sorted(unknown))


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("saccade.Policy.from_pretrained", True),
        ("saccade.policy.interfaces.Head", True),
        ("saccade_lab.study.table.Provenance.settings", True),
        ("saccade.policy.head.Head", False),
        ("saccade.Policy.look", False),
        ("saccade_lab.nowhere", False),
    ],
)
def test_a_name_is_looked_up(name: str, there: bool) -> None:
    assert exists(name) is there


def test_prose_is_docstrings_and_comments() -> None:
    source = '"""About saccade.Policy."""\nNAME = "saccade.nothing"  # see saccade.errors\n'
    assert NAME.findall("\n".join(python_prose(source))) == ["saccade.Policy", "saccade.errors"]
    assert NAME.findall("out/saccade.json, saccade.json/x, a.saccade.b and saccade.") == []
