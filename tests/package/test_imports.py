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

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "saccade": ROOT / "python/saccade",
    "lab": ROOT / "lab/saccade_lab",
    "plugin": ROOT / "plugins/lerobot/lerobot_policy_saccade",
}
LAZY = ("checkpoints", "integrations", "linalg", "observations", "robots", "serve", "torch")


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


@pytest.mark.parametrize("name", ["torch", "integrations"])
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


def imports(*packages: Path) -> dict[str, set[str]]:
    """The modules that each module imports, with the packages that contain them, which Python imports first.

    A package and its own modules do not count as that: a module may use the one beside it. Nor does the root
    of the package that a module belongs to: no module names it, which another test checks.
    """
    files = {name: path for package in packages for name, path in modules(package).items()}
    graph = {}
    for name, path in files.items():
        found = set(imported(name, path, set(files)))
        above = {parent for other in found for parent in parents(other)}
        graph[name] = found | {each for each in above & set(files) if not f"{name}.".startswith(f"{each}.")}
    return graph


def parents(name: str) -> set[str]:
    """The packages that contain a module, but for the root.

    Example:
        >>> sorted(parents("saccade.a.b.c"))
        ['saccade.a', 'saccade.a.b']
    """
    parts = name.split(".")
    return {".".join(parts[:end]) for end in range(2, len(parts))}


def test_no_circle_of_imports() -> None:
    """Neither inside a package nor through another one, counted with imports in functions and by strings."""
    assert circles(imports(*PACKAGES.values())) == []


def test_no_module_imports_the_root() -> None:
    """So what the root imports when it is first used, by `__getattr__`, can close no circle."""
    found = [
        f"{name}:{node.lineno}"
        for name, path in modules(PACKAGES["saccade"]).items()
        for node in ast.walk(ast.parse(path.read_text()))
        if (isinstance(node, ast.ImportFrom) and node.level == 0 and node.module == "saccade")
        or (isinstance(node, ast.Import) and any(alias.name == "saccade" for alias in node.names))
    ]
    assert found == []


def test_packages_depend_downwards() -> None:
    """The lab and the plugin import saccade, and saccade imports neither."""
    for name, others in imports(*PACKAGES.values()).items():
        if name.partition(".")[0] == "saccade":
            assert {other.partition(".")[0] for other in others} <= {"saccade"}, name


@pytest.mark.parametrize("package", PACKAGES.values(), ids=PACKAGES)
def test_no_circle_of_packages(package: Path) -> None:
    """A package counts as one with its modules: `cli` imports `head`, so `head` may not import `cli`."""

    def room(module: str) -> str:
        return ".".join(module.split(".")[:2])

    graph: dict[str, set[str]] = {}
    for module, others in imports(package).items():
        graph.setdefault(room(module), set()).update(map(room, others))
    assert circles({name: others - {name} for name, others in graph.items()}) == []


#: Modules that import by a name that is not written there. It comes from a table or from the user, and leads
#: down to what was asked for; anywhere else it could hide a circle.
REGISTRIES = {
    "saccade",  # its submodules, when they are first used
    "saccade.cli",  # the command that was given
    "lerobot_policy_saccade.environment_saccade",  # the package of a robot's environment
    "saccade_lab.reference.lerobot_head",  # a module of lerobot
    "saccade_lab.study.study",  # the study that was given, which may be the user's
}


def test_only_registries_import_by_a_name_that_is_not_written_there() -> None:
    found = {
        name
        for package in PACKAGES.values()
        for name, path in modules(package).items()
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
