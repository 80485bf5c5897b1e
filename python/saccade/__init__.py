"""saccade: the action head of GR00T-style robot policies on CPUs, exact and fast.

The public names below need NumPy only. Submodules such as `saccade.reference` are imported when they are
first used; some of them need optional packages.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from saccade._saccade import __version__
from saccade.attention import CrossAttention, KeyValues
from saccade.backbone import Backbone
from saccade.backbone_config import BackboneConfig
from saccade.backbone_features import BackboneFeatures, BackboneRecord
from saccade.backbone_inputs import BackboneInputs
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
from saccade.policy_context import PolicyContext
from saccade.processor import Processor
from saccade.robots.normalizer import Normalizer
from saccade.trace import Record, Trace

__all__ = [
    "ActionHead",
    "Backbone",
    "BackboneConfig",
    "BackboneFeatures",
    "BackboneInputs",
    "BackboneRecord",
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
    "PolicyContext",
    "Processor",
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
    "dialects",
    "integrations",
    "maps",
    "observation",
    "reference",
    "robots",
    "serve",
    "sim",
    "study",
    "torch",
)

# Hidden from type checkers, so that they report names that do not exist; they need `import saccade.sim`.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in _SUBMODULES:
            return importlib.import_module(f"saccade.{name}")
        raise AttributeError(f"module 'saccade' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_SUBMODULES})
