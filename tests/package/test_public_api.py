"""The public surface: what it was when it was last accepted, with signatures that say everything."""

from __future__ import annotations

import griffe
import pytest

import saccade
from tests.package import snapshot


@pytest.fixture(scope="module")
def surface() -> list[tuple[str, griffe.Object]]:
    return list(snapshot.public(snapshot.load()))


def test_the_surface_is_the_one_that_was_accepted() -> None:
    found = snapshot.difference()
    assert not found, (
        f"the public surface changed:\n{found}\naccept with: python -m tests.package.snapshot --accept"
    )


def test_the_list_is_that_of_the_package() -> None:
    assert set(dir(saccade)) == {*saccade.__all__, *snapshot.SUBMODULES}


def test_no_signature_hides_its_arguments(surface: list[tuple[str, griffe.Object]]) -> None:
    hidden = [
        path
        for path, found in surface
        if isinstance(found, griffe.Function)
        and any(each.kind is griffe.ParameterKind.var_keyword for each in found.parameters)
    ]
    assert hidden == []


def test_all_is_documented(surface: list[tuple[str, griffe.Object]]) -> None:
    special = (f".{name}" for name in snapshot.CALLED)
    documented = tuple(special)
    missing = [
        path
        for path, found in surface
        if isinstance(found, griffe.Class | griffe.Function)
        and not path.endswith(documented)
        and not found.has_docstring
    ]
    assert missing == []
