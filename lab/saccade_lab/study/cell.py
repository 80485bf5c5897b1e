"""A cell, the unit of work of a study, and the name of its file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

Key: TypeAlias = tuple["str | int | float", ...]
Rows: TypeAlias = list[dict[str, Any]]


@dataclass(frozen=True)
class Cell:
    """One unit of work.

    Attributes:
        key: Identifies it within its study, for example task, seed and arm. The table is sorted by it.
        settings: Further JSON values that its result depends on. A cell with other settings is another cell.

    Example:
        >>> Cell(("reach", 3, "none"), {"engine": "rust"}).name
        'reach 3 none'
    """

    key: Key
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The key as text."""
        return " ".join(str(part) for part in self.key)

    @property
    def digest(self) -> str:
        """Hash of key and settings, which is the name of the cell's file."""
        return digest({"key": list(self.key), "settings": self.settings})


def digest(value: Any) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of a value's JSON.

    Example:
        >>> digest({"a": 1, "b": (2, 3)}) == digest({"b": [2, 3], "a": 1})
        True
    """
    text = json.dumps(plain(value), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


def plain(value: Any) -> Any:
    """The value as JSON would return it: NumPy numbers become Python numbers, tuples lists, and NaN None.

    Raises:
        TypeError: The value cannot be written as JSON.

    Example:
        >>> plain({"steps": np.int64(3), "rate": np.float32("nan"), "blocks": (0, 1)})
        {'steps': 3, 'rate': None, 'blocks': [0, 1]}
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        if math.isnan(value):
            return None
        raise TypeError(f"{value} cannot be written as JSON")
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise TypeError(f"{type(value).__name__} cannot be written as JSON: {value!r}")


def sortable(key: Sequence[str | int | float]) -> list[tuple[bool, float, str]]:
    """A key in a form that compares: numbers by size before text by letters.

    Example:
        >>> sorted([["reach", 10], ["push", 9], ["reach", 9]], key=sortable)
        [['push', 9], ['reach', 9], ['reach', 10]]
    """
    return [(True, 0.0, part) if isinstance(part, str) else (False, float(part), "") for part in key]
