"""JSON as RFC 8259 defines it: numbers that are not finite become ``null``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any


def dumps(
    value: Any,
    *,
    indent: int | None = None,
    ensure_ascii: bool = True,
    default: Callable[[Any], Any] | None = None,
) -> str:
    """`json.dumps`, with ``null`` in place of ``NaN`` and ``Infinity``, which are not JSON.

    Example:
        >>> dumps({"mean": float("nan"), "count": 2})
        '{"mean": null, "count": 2}'
    """

    def encode(given: Any) -> str:
        return json.dumps(given, indent=indent, ensure_ascii=ensure_ascii, default=default, allow_nan=False)

    try:
        return encode(value)
    except ValueError:  # at least one number is not finite
        return encode(_finite(value))


def _finite(value: Any) -> Any:
    """A copy in which numbers that are not finite are None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {_finite_key(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def _finite_key(key: Any) -> Any:
    """A key is a string in JSON: a number that is not finite keeps its name."""
    return str(key) if isinstance(key, float) and not math.isfinite(key) else key
