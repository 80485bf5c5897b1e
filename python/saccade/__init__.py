"""saccade: the action head of GR00T-style robot policies on CPUs, exact and fast."""

from saccade._saccade import __version__
from saccade.attention import CrossAttention, KeyValues
from saccade.chunking import Chunking
from saccade.config import HeadConfig
from saccade.environment import show_config
from saccade.errors import CheckpointError, DtypeError, InputError, SaccadeError, ShapeError
from saccade.head import ActionHead, Context
from saccade.intervention import Intervention
from saccade.normalizer import Normalizer
from saccade.policy import Policy
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
    "Normalizer",
    "Policy",
    "Record",
    "SaccadeError",
    "ShapeError",
    "Trace",
    "__version__",
    "show_config",
]
