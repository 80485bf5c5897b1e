"""Checkpoints without torch: describing them, reading tensors, writing changed copies.

`description` recognises layout and version, `rewriting` quantises, converts and resizes.
`inspection` examines every tensor; it needs `saccade.bench`, so it is imported
only on request: `from saccade.checkpoints.inspection import inspect`.
"""

from saccade.checkpoints.description import Description, describe, read_tensors
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
    "ConvertReport",
    "Description",
    "QuantizeReport",
    "ResizeReport",
    "Written",
    "convert",
    "describe",
    "quantize",
    "read_tensors",
    "resize",
]
