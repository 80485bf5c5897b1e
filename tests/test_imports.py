"""How modules of the package depend on each other: lazily at the top, and without circles."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import saccade

PACKAGE = Path(saccade.__file__).parent
LAZY = ("bench", "checkpoints", "comparison", "integrations", "maps", "observation", "reference", "robots",
        "serve", "sim", "study", "torch")  # fmt: skip


def python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize("name", LAZY)
def test_submodules_are_imported_when_they_are_used(name: str) -> None:
    code = f"import saccade; assert '{name}' in dir(saccade); print(saccade.{name}.__name__)"
    assert python(code) == f"saccade.{name}"


def test_other_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="module 'saccade' has no attribute 'no_such_name'"):
        saccade.no_such_name  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("name", ["reference", "torch", "integrations"])
@pytest.mark.parametrize("statement", ["import saccade.{}", "import saccade; saccade.{}"])
def test_without_torch_the_extra_is_named(name: str, statement: str) -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "try:\n"
        f"    {statement.format(name)}\n"
        "except ModuleNotFoundError as error:\n"
        "    import saccade\n"
        "    print(isinstance(error, saccade.SaccadeError), error.name, error)"
    )
    found = python(code)
    assert found.startswith("True torch torch is not installed. Install with: ")


def modules() -> dict[str, Path]:
    """Every module of the package, by name."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path, names: set[str]) -> Iterator[str]:
    """The modules of the package that a file imports anywhere, in functions and for type checkers too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom) and node.module in names:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in names else node.module


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
            if other in stack:
                low[node] = min(low[node], low[other])
        if low[node] == index[node]:
            component = []
            while True:
                component.append(stack.pop())
                if component[-1] == node:
                    break
            if len(component) > 1:
                found.append(sorted(component))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def imports() -> dict[str, set[str]]:
    """The modules that each module imports."""
    files = modules()
    return {name: set(imported(path, set(files))) for name, path in files.items()}


def test_no_circle_of_imports() -> None:
    assert circles(imports()) == []


def test_no_circle_of_packages() -> None:
    """A package counts as one with its modules: `cli` imports `study`, so `study` may not import `cli`."""

    def package(module: str) -> str:
        return ".".join(module.split(".")[:2])

    graph: dict[str, set[str]] = {}
    for module, others in imports().items():
        graph.setdefault(package(module), set()).update(map(package, others))
    assert circles({name: others - {name} for name, others in graph.items()}) == []
