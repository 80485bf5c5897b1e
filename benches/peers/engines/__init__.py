"""The engines: one file each, and what they have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benches.peers.cases import Case


@dataclass(frozen=True)
class Task:
    """The task of an engine's process.

    Attributes:
        case: Piece and sizes.
        options: The contender's, as `CONTENDERS` has them.
        source: A checkpoint of the piece's head.
        arrays: Inputs, and as `expected` the reference's result.
        graphs: A folder for exported graphs.
        shared: What the contenders of one process share, such as weights. Empty for the first.
    """

    case: Case
    options: dict[str, Any]
    source: Path
    arrays: dict[str, NDArray[Any]]
    graphs: Path
    shared: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Built:
    """The result of an engine's `build`.

    Attributes:
        works: By name, what can be timed.
        result: What is compared with the reference's.
        calls: How many layers one call of a work goes through, where the time of one is wanted.
        notes: Settings worth a line in the report.
        is_warm: Whether `result` calls every work. They are then not called again before they are timed.
    """

    works: dict[str, Callable[[], Any]]
    result: Callable[[], NDArray[np.float32]]
    calls: dict[str, int] = field(default_factory=dict)
    notes: str = ""
    is_warm: bool = False
