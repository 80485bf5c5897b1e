"""saccade: the action head of GR00T-style robot policies on CPUs, exact and fast.

The public names below need NumPy only. Submodules such as `saccade.reference` are imported when they are
first used; some of them need optional packages.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from saccade._saccade import __version__
from saccade.attention import CrossAttention, KeyValues
from saccade.chunking import Chunking
from saccade.config import HeadConfig
from saccade.context import Context
from saccade.environment import show_config
from saccade.errors import (
    CheckpointError,
    DtypeError,
    InputError,
    MissingExtraError,
    SaccadeError,
    ShapeError,
)
from saccade.head import ActionHead
from saccade.intervention import Intervention
from saccade.policy import Policy
from saccade.robots.normalizer import Normalizer
from saccade.trace import Record, Trace

__all__ = [
    "ActionHead",
    "CheckpointError",
    "Chunking",
    "Context",
    "CrossAttention",
    "DtypeError",
    "HeadConfig",
    "InputError",
    "Intervention",
    "KeyValues",
    "MissingExtraError",
    "Normalizer",
    "Policy",
    "Record",
    "SaccadeError",
    "ShapeError",
    "Trace",
    "__version__",
    "show_config",
]

#: Submodules that are imported when they are first used.
_SUBMODULES = (
    "bench",
    "checkpoints",
    "cli",
    "comparison",
    "integrations",
    "maps",
    "observation",
    "reference",
    "robots",
    "sim",
    "study",
    "torch",
)

if TYPE_CHECKING:
    from saccade import (
        bench as bench,
    )
    from saccade import (
        checkpoints as checkpoints,
    )
    from saccade import (
        comparison as comparison,
    )
    from saccade import (
        integrations as integrations,
    )
    from saccade import (
        maps as maps,
    )
    from saccade import (
        observation as observation,
    )
    from saccade import (
        reference as reference,
    )
    from saccade import (
        robots as robots,
    )
    from saccade import (
        sim as sim,
    )
    from saccade import (
        study as study,
    )
    from saccade import (
        torch as torch,
    )
else:  # so that a type checker still reports names that do not exist

    def __getattr__(name: str) -> Any:
        if name in _SUBMODULES:
            return importlib.import_module(f"saccade.{name}")
        raise AttributeError(f"module 'saccade' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_SUBMODULES})
