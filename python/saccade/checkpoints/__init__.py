"""Checkpoints: what they contain, how their precisions differ, and changed copies. Needs no torch.

`description` recognises layout and version, and `inspection` examines every tensor. `rewriting` quantises,
converts and resizes. `precisions` compares the precisions of a whole checkpoint, and `comparison` the actions
of a checkpoint and its resized copy.
"""

from saccade.checkpoints.bundled import demo_checkpoint
from saccade.checkpoints.comparison import ActionChanges, action_changes
from saccade.checkpoints.description import Description, describe, read_tensors
from saccade.checkpoints.findings import Inspection
from saccade.checkpoints.inspection import inspect
from saccade.checkpoints.precisions import PrecisionCheck, check_precisions
from saccade.checkpoints.rewriting import (
    ConvertReport,
    QuantizeReport,
    ResizeReport,
    Written,
    convert,
    quantize,
    resize,
)

__all__ = [
    "ActionChanges",
    "ConvertReport",
    "Description",
    "Inspection",
    "PrecisionCheck",
    "QuantizeReport",
    "ResizeReport",
    "Written",
    "action_changes",
    "check_precisions",
    "convert",
    "demo_checkpoint",
    "describe",
    "inspect",
    "quantize",
    "read_tensors",
    "resize",
]
