"""Models whose weights are rounded to four bits in torch: what int4 computes but for its activations.

Weights that are whole multiples of their scales keep their values when they are rounded again. So the exact
model of them is compared with int4 of the original ones, and only the rounding of activations remains.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from benches.precision_groups import DIT, VL, int4_weight

#: Weights of the blocks of a backbone, and of a head.
BACKBONE_BLOCKS = re.compile(r".*\b(layers|blocks)\.\d+\.(?!.*norm).*weight")
HEAD_BLOCKS = re.compile(rf".*({VL}|{DIT})(attn1|ff)\..*weight")


def with_int4_weights(tensors: Mapping[str, Tensor], blocks: re.Pattern[str]) -> dict[str, Tensor]:
    """The tensors, those of the blocks rounded."""
    found = dict(tensors)
    rounded = [name for name, tensor in tensors.items() if tensor.ndim == 2 and blocks.fullmatch(name)]
    assert rounded
    with torch.no_grad():
        for name in rounded:
            found[name] = int4_weight(tensors[name].float()).to(tensors[name].dtype)
    return found
