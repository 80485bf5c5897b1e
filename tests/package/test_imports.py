"""How modules of the package depend on each other: lazily at the top, and without circles."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import saccade
from tests.helpers.circles import circles

PACKAGE = Path(saccade.__file__).parent
PLUGIN = Path(__file__).parents[2] / "plugins/lerobot/lerobot_policy_saccade"
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


def modules(package: Path) -> dict[str, Path]:
    """Every module of a package, by name."""
    found = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name: str, path: Path, names: set[str]) -> Iterator[str]:
    """The modules of the package that a file imports anywhere: in functions, for types, by a string."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom):
            module = from_where(node, name, path)
            if module in names:
                for alias in node.names:
                    full = f"{module}.{alias.name}"
                    yield full if full in names else module
        elif (given := import_by_string(node)) is not None and isinstance(given, ast.Constant):
            parts = str(given.value).split(".")
            known = (".".join(parts[:end]) for end in range(len(parts), 0, -1))
            yield from [module for module in known if module in names][:1]


def from_where(node: ast.ImportFrom, name: str, path: Path) -> str:
    """The module that a statement imports from, with its dots resolved."""
    if node.level == 0:
        return node.module or ""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    above = package[: len(package) - (node.level - 1)]
    return ".".join([*above, *([node.module] if node.module else [])])


def import_by_string(node: ast.AST) -> ast.expr | None:
    """The name that `import_module` or `__import__` is called with. None for anything else."""
    if not isinstance(node, ast.Call):
        return None
    called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
    if called not in ("import_module", "__import__"):
        return None
    return node.args[0] if node.args else node.keywords[0].value


def imports(package: Path) -> dict[str, set[str]]:
    """The modules that each module imports."""
    files = modules(package)
    return {name: set(imported(name, path, set(files))) for name, path in files.items()}


@pytest.mark.parametrize("package", [PACKAGE, PLUGIN], ids=["saccade", "plugin"])
def test_no_circle_of_imports(package: Path) -> None:
    assert circles(imports(package)) == []


def test_no_circle_of_packages() -> None:
    """A package counts as one with its modules: `cli` imports `study`, so `study` may not import `cli`."""

    def package(module: str) -> str:
        return ".".join(module.split(".")[:2])

    graph: dict[str, set[str]] = {}
    for module, others in imports(PACKAGE).items():
        graph.setdefault(package(module), set()).update(map(package, others))
    assert circles({name: others - {name} for name, others in graph.items()}) == []


#: Modules that import by a name that is not written there. It comes from a table or from the user, and leads
#: down to what was asked for; anywhere else it could hide a circle.
REGISTRIES = {
    "saccade",  # its submodules, when they are first used
    "saccade.cli",  # the command that was given
    "saccade_lab.reference.lerobot_head",  # a module of lerobot
    "saccade.serve",  # its classes, which need optional packages
    "saccade_lab.study.study",  # the study that was given, which may be the user's
}


def test_only_registries_import_by_a_name_that_is_not_written_there() -> None:
    found = {
        name
        for name, path in modules(PACKAGE).items()
        for node in ast.walk(ast.parse(path.read_text()))
        if (given := import_by_string(node)) is not None and not isinstance(given, ast.Constant)
    }
    assert found == REGISTRIES


@pytest.mark.parametrize(
    "statement",
    [
        "import planted.low",
        "from planted import low",
        "from planted.low import name",
        "from . import low",
        "from .low import name",
        "def call():\n    from planted.low import name",
        "def call():\n    importlib.import_module('planted.low').name()",
        "def call():\n    import_module(name='planted.low')",
        "if TYPE_CHECKING:\n    from planted.low import name",
        "__import__('planted.low.name')",
    ],
)
def test_a_planted_circle_is_found(statement: str, tmp_path: Path) -> None:
    package = tmp_path / "planted"
    package.mkdir()
    for name, code in (("__init__", ""), ("low", ""), ("middle", "import planted.low"), ("high", statement)):
        (package / f"{name}.py").write_text(code)
    assert circles(imports(package)) == []
    (package / "low.py").write_text("import planted.middle, planted.high")
    assert circles(imports(package)) == [["planted.high", "planted.low", "planted.middle"]]
