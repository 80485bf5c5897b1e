"""How modules of the Rust crates depend on each other: without circles."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.helpers.circles import circles

CRATES = Path(__file__).parents[2] / "crates"
#: Comments, literals and lifetimes: what is in them names no module.
NOT_CODE = re.compile(
    r'//[^\n]*|/\*.*?\*/|b?r(?P<hashes>#*)".*?"(?P=hashes)|b?"(?:\\.|[^"\\])*"|b?\'(?:\\.[^\']*|[^\\\'])\'|\'\w+',
    re.DOTALL,
)
TOKEN = re.compile(r"\w+|::|[{},*]")
USE = re.compile(r"(?P<visibility>pub(?:\([^)]*\))?\s+)?\buse\s+(?P<tree>[^;]+);")
TESTS = re.compile(r"#\[cfg\((?:all\()?test\b[^\]]*\]")
MOD = re.compile(r"\bmod\s+(\w+)\s*;")
PATH = re.compile(r"(?<![\w:])(?:r#)?\w+(?:\s*::\s*\w+)+")


@dataclass
class Module:
    """A file: the module that it is, its code, and what it says about others.

    Attributes:
        path: Its names from the crate on; empty for the crate itself.
        code: Its text without comments, literals, tests and `use` statements.
        children: The names of modules that are files of their own.
        names: What `use` statements bring in, by its name here.
        exported: Those names that are there for others.
        globs: Modules whose every name is brought in.
    """

    path: tuple[str, ...]
    code: str
    children: set[str] = field(default_factory=set)
    names: dict[str, tuple[str, ...]] = field(default_factory=dict)
    exported: set[str] = field(default_factory=set)
    globs: list[tuple[str, ...]] = field(default_factory=list)


def without_tests(code: str) -> str:
    """The code without what is compiled for tests only, after `#[cfg(test)]`: a statement, or a block."""
    kept = []
    while (found := TESTS.search(code)) is not None:
        kept.append(code[: found.start()])
        end, depth = found.end(), 0
        for end in range(found.end(), len(code)):
            depth += {"{": 1, "}": -1}.get(code[end], 0)
            if depth == 0 and code[end] in ";}":
                break
        code = code[end + 1 :]
    return "".join([*kept, code])


def leaves(tokens: list[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Name and path of everything in a `use` tree, whose tokens are taken; "*" is the name of all."""
    path: list[str] = []
    while tokens and tokens[0] not in (",", "}"):
        token = tokens.pop(0)
        if token == "{":
            while tokens and tokens[0] != "}":
                yield from ((name, (*path, *rest)) for name, rest in leaves(tokens))
                if tokens and tokens[0] == ",":
                    tokens.pop(0)
            tokens.pop(0)
            return
        if token == "as":
            yield tokens.pop(0), tuple(path)
            return
        if token != "::":
            path.append(token)
    if path[-1] == "self" and len(path) > 1:
        path.pop()
    yield path[-1], tuple(path)


def read(file: Path, path: tuple[str, ...]) -> Module:
    code = without_tests(NOT_CODE.sub(" ", file.read_text()))
    module = Module(path, "")
    module.children = set(MOD.findall(code))
    for found in USE.finditer(code):
        for name, target in leaves(TOKEN.findall(found["tree"])):
            if name == "*":
                module.globs.append(target[:-1])
                continue
            module.names[name] = target
            if found["visibility"]:
                module.exported.add(name)
    module.code = MOD.sub(" ", USE.sub(" ", code))
    return module


def modules(root: Path) -> dict[tuple[str, ...], Module]:
    """The modules of a crate, from `src/lib.rs` on along `mod` statements; those of tests are left out."""
    found: dict[tuple[str, ...], Module] = {}
    left: list[tuple[tuple[str, ...], Path, Path]] = [((), root / "lib.rs", root)]
    while left:
        path, file, folder = left.pop()
        module = found[path] = read(file, path)
        for name in module.children:
            flat = folder / f"{name}.rs"
            child = flat if flat.exists() else folder / name / "mod.rs"
            left.append(((*path, name), child, folder / name))
    return found


class Crate:
    """The modules of a crate, and which of them need which."""

    def __init__(self, root: Path) -> None:
        self.modules = modules(root)

    def absolute(self, path: tuple[str, ...], here: tuple[str, ...]) -> tuple[str, ...] | None:
        """A path in a module as one of the crate. None if it leads elsewhere, or to something within."""
        first, *rest = path
        if first == "crate":
            return tuple(rest)
        if first == "self":
            return (*here, *rest)
        if first == "super":
            above = here[:-1]
            while rest and rest[0] == "super":
                above, rest = above[:-1], rest[1:]
            return (*above, *rest)
        if first in self.modules[here].children:
            return (*here, *path)
        target = self.modules[here].names.get(first, (first,))
        return None if target[0] == first else self.absolute((*target, *rest), here)

    def owner(self, path: tuple[str, ...], seen: frozenset[tuple[str, ...]] = frozenset()) -> tuple[str, ...]:
        """The module that defines what is at a path of the crate, through any `use` on the way."""
        module: tuple[str, ...] = ()
        for index, name in enumerate(path):
            if (*module, name) in self.modules:
                module = (*module, name)
                continue
            target = self.modules[module].names.get(name)
            if target is None or path in seen:
                return module
            leads = self.absolute(target, module)
            if leads is None:
                return module
            return self.owner((*leads, *path[index + 1 :]), seen | {path})
        return module

    def needs(self, module: Module) -> set[tuple[str, ...]]:
        """The modules that a file needs. A name that it only hands on is none of its needs."""
        words = set(re.findall(r"\w+", module.code))
        paths = [path for name, path in module.names.items() if name not in module.exported or name in words]
        paths += [*module.globs]
        paths += [tuple(re.split(r"\s*::\s*", found)) for found in PATH.findall(module.code)]
        absolute = (self.absolute(path, module.path) for path in paths)
        return {self.owner(path) for path in absolute if path is not None} - {module.path}

    def graph(self) -> dict[str, set[str]]:
        def name(path: tuple[str, ...]) -> str:
            return "::".join(path) or "crate"

        return {name(path): set(map(name, self.needs(module))) for path, module in self.modules.items()}


@pytest.mark.parametrize("crate", sorted(path.parent.name for path in CRATES.glob("*/src")))
def test_no_circle_of_modules(crate: str) -> None:
    assert circles(Crate(CRATES / crate / "src").graph()) == []


def test_no_file_is_left_out() -> None:
    """Every file is one of a module, but for those of tests."""
    for root in CRATES.glob("*/src"):
        files = {path.relative_to(root).with_suffix("").parts for path in root.rglob("*.rs")}
        known = {path[:-1] if path[-1] in ("mod", "lib") else path for path in files}
        left = known - set(Crate(root).modules)
        # A release that tests add to the table, and the models of the pool that loom runs.
        assert {path[-1] for path in left} <= {"tests", "test_support", "made_up", "models"}, root


def planted(root: Path, low: str, high: str) -> list[list[str]]:
    """The circles of a crate in which `low` and `room::high` have this code."""
    files = {
        "lib.rs": "mod low;\npub mod room;\npub use low::Low;\npub use room::high::High;\n",
        "low.rs": low,
        "room/mod.rs": "//! Not `crate::low::Low`.\npub(crate) mod high;\npub use high::High;\n",
        "room/high.rs": high,
    }
    for name, code in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(code)
    return circles(Crate(root).graph())


DOWN = "use crate::low::Low;\npub struct High(Low);\n"


@pytest.mark.parametrize(
    "up",
    [
        "use crate::room::high::High;",
        "use crate::room::High;",  # handed on by the folder
        "use crate::High;",  # and by the crate
        "use super::room::{high::{self, High as Other}};",
        "use crate::{room::{self, high::*}};",
        "pub(crate) use crate::room::high::High;\nfn of(high: High) {}",
        "fn of(high: &crate::room::high::High) {}",
        "fn of() { super::room::high::High::new(); }",
        "use crate::room;\nfn of(high: room::High) {}",
        "mod inner { fn of(high: crate::High) {} }",
    ],
)
def test_a_planted_circle_is_found(up: str, tmp_path: Path) -> None:
    assert planted(tmp_path, f"{up}\npub struct Low;\n", DOWN) == [["low", "room::high"]]


@pytest.mark.parametrize(
    "no_use",
    [
        "",
        "//! As [`High`](crate::room::high::High).",
        "/* crate::room::high */ /// crate::High",
        'const NAME: &str = "crate::room::high::High";',
        'const QUOTE: char = \'"\'; const RAW: &str = r#"crate::High "quoted""#;',
        "#[cfg(test)]\nmod tests {\n    use crate::room::High;\n    fn f() { if true {} }\n}",
        "pub use crate::room::high::High;",  # handed on, not used
        "fn longest<'a>(one: &'a str) -> &'a str { one }",
    ],
)
def test_what_is_no_use_is_no_circle(no_use: str, tmp_path: Path) -> None:
    assert planted(tmp_path, f"{no_use}\npub struct Low;\n", DOWN) == []
