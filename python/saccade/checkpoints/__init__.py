"""Checkpoints: what they contain, how their precisions differ, and changed copies. Needs no torch.

`description` recognises layout and version, and `inspection` examines every tensor. `rewriting` quantises,
converts and resizes; `calibration` rounds weights for what their layers are given. `precisions` compares the
precisions of a whole checkpoint, and `comparison` the actions of a checkpoint and its resized copy.
`verification` checks all of a checkpoint and runs it.
"""

from pathlib import Path

from saccade.checkpoints.calibration import Calibration
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
from saccade.checkpoints.verification import Verification, verify

__all__ = [
    "ActionChanges",
    "Calibration",
    "ConvertReport",
    "Description",
    "Inspection",
    "PrecisionCheck",
    "QuantizeReport",
    "ResizeReport",
    "Verification",
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
    "verify",
]


def demo_checkpoint() -> Path:
    """The directory of the bundled policy, a small whole GR00T N1.5 checkpoint.

    It drives a simulated arm in five tasks from camera images and an instruction. ``make rollout`` runs it.

    Example:
        >>> import saccade
        >>> policy = saccade.Policy.from_pretrained(saccade.demo_checkpoint())
        >>> policy.act(policy.example_observation(), seed=0)["hand"].shape
        (1, 16, 3)
    """
    return Path(__file__).parent / "demo"
