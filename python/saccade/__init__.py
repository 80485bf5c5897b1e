"""saccade runs GR00T robot policies on CPUs: camera images and an instruction in, actions out.

Public are the names of ``__all__``, the submodules in ``_SUBMODULES``, and what each of them lists. All needs
NumPy only, but :func:`accelerate` and :mod:`saccade.torch`, which work on torch's policies, and
:mod:`saccade.datasets` and :mod:`saccade.serve`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from saccade._internal.environment import show_config
from saccade._saccade import __version__
from saccade.backbone.backbone import Backbone
from saccade.backbone.config import BackboneConfig
from saccade.backbone.features import BackboneFeatures, BackboneRecord
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import (
    CheckpointError,
    DatasetError,
    DtypeError,
    InputError,
    MissingExtraError,
    SaccadeError,
    ShapeError,
)
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade.head.context import Context
from saccade.head.cross_attention import CrossAttention, KeyValues
from saccade.head.head import ActionHead
from saccade.head.intervention import Intervention
from saccade.head.trace import Record, Trace
from saccade.policy.encoding import PolicyContext
from saccade.policy.policy import Policy
from saccade.processor import Processor
from saccade.robots.normalizer import Normalizer

if TYPE_CHECKING:
    from saccade.checkpoints import convert, demo_checkpoint, inspect, quantize, resize
    from saccade.diagnosis import diagnose
    from saccade.evaluation import evaluate
    from saccade.integrations import accelerate

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
    "DatasetError",
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
    "accelerate",
    "convert",
    "demo_checkpoint",
    "diagnose",
    "evaluate",
    "inspect",
    "quantize",
    "resize",
    "show_config",
]

#: Functions whose modules are imported when they are first used: a robot needs none of them, one needs torch.
_FUNCTIONS = {
    **dict.fromkeys(("convert", "demo_checkpoint", "inspect", "quantize", "resize"), "saccade.checkpoints"),
    "accelerate": "saccade.integrations",
    "diagnose": "saccade.diagnosis",
    "evaluate": "saccade.evaluation",
}
#: Public submodules, likewise.
_SUBMODULES = (
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

# Hidden from type checkers, so that they report names that do not exist; they need `import saccade.serve`.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in _FUNCTIONS:
            return getattr(importlib.import_module(_FUNCTIONS[name]), name)
        if name in _SUBMODULES:
            return importlib.import_module(f"saccade.{name}")
        raise AttributeError(f"module 'saccade' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_SUBMODULES})
