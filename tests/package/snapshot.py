"""The public surface of saccade as text, read from the source by griffe.

    python -m tests.package.snapshot           prints what differs from public_api.txt
    python -m tests.package.snapshot --accept  writes public_api.txt anew

Public are the names of ``saccade.__all__``, the submodules that the package names, and what each lists in its
own ``__all__``; of a class all members whose names do not begin with an underscore, and those that Python
calls.
"""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Iterator
from pathlib import Path

import griffe

ROOT = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_name("public_api.txt")

#: The documented submodules.
SUBMODULES = (
    "checkpoints",
    "datasets",
    "diagnosis",
    "evaluation",
    "integrations",
    "linalg",
    "observations",
    "robots",
    "serve",
    "torch",
)

#: Special methods that are part of the surface.
CALLED = ("__init__", "__call__", "__enter__", "__exit__", "__len__", "__iter__", "__getitem__")


def load() -> griffe.Module:
    """The package, without importing it."""
    loaded = griffe.load(
        "saccade", search_paths=[ROOT / "python"], allow_inspection=False, resolve_aliases=True
    )
    assert isinstance(loaded, griffe.Module)
    return loaded


def public(package: griffe.Module) -> Iterator[tuple[str, griffe.Object]]:
    """Every public name with what it names: functions, classes, attributes, and members of classes once."""
    shown: set[str] = set()
    for module in (package, *(package.modules[name] for name in SUBMODULES)):
        for name in sorted(map(str, module.exports or ())):
            path = f"{module.path}.{name}"
            found = target(module.members[name])
            yield path, found
            if isinstance(found, griffe.Class) and found.path not in shown:
                shown.add(found.path)
                yield from members(path, found)


def members(path: str, of: griffe.Class) -> Iterator[tuple[str, griffe.Object]]:
    """The public members of a class, those that it inherits from other classes of saccade included."""
    for name, member in sorted(of.all_members.items()):
        found = target(member)
        if name.startswith("_") and (name not in CALLED or not isinstance(found, griffe.Function)):
            continue
        yield f"{path}.{name}", found


def target(member: griffe.Object | griffe.Alias) -> griffe.Object:
    """What a name stands for, through all imports."""
    return member.final_target if isinstance(member, griffe.Alias) else member


def line(path: str, of: griffe.Object) -> str:
    """One line of the snapshot."""
    if isinstance(of, griffe.Class):
        bases = ", ".join(map(str, of.bases))
        return f"class {path}({bases})"
    if isinstance(of, griffe.Function):
        return f"{path}({parameters(of)}) -> {of.returns}"
    if isinstance(of, griffe.Attribute):
        kind = " (property)" if "property" in of.labels else ""
        return f"{path}: {of.annotation}{kind}"
    return path


def parameters(function: griffe.Function) -> str:
    """The parameters of a function as they are written in Python."""
    shown: list[str] = []
    kinds = griffe.ParameterKind
    starred = False
    for number, each in enumerate(function.parameters):
        if number == 0 and each.name in ("self", "cls") and each.annotation is None:
            continue
        if each.kind is kinds.keyword_only and not starred:
            shown.append("*")
            starred = True
        prefix = {kinds.var_positional: "*", kinds.var_keyword: "**"}.get(each.kind or kinds.keyword_only, "")
        starred = starred or prefix == "*"
        annotation = "" if each.annotation is None else f": {each.annotation}"
        default = "" if each.default is None or prefix else f" = {each.default}"
        shown.append(f"{prefix}{each.name}{annotation}{default}")
    return ", ".join(shown)


def snapshot() -> list[str]:
    """The lines of the snapshot."""
    return [line(path, found) for path, found in public(load())]


def difference() -> str:
    """What differs from the file, as a unified diff; empty if nothing does."""
    accepted = FILE.read_text(encoding="utf-8").splitlines() if FILE.exists() else []
    return "\n".join(difflib.unified_diff(accepted, snapshot(), "accepted", "now", lineterm="", n=0))


def main(arguments: list[str] | None = None) -> int:
    """Prints or accepts the difference; the exit status is 1 if there is one that was not accepted."""
    parser = argparse.ArgumentParser(prog="python -m tests.package.snapshot", description=__doc__)
    parser.add_argument("--accept", action="store_true", help="write the file anew")
    if parser.parse_args(arguments).accept:
        FILE.write_text("\n".join(snapshot()) + "\n", encoding="utf-8")
        return 0
    found = difference()
    print(found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
