"""The same action head in plain torch: the oracle that the Rust head is tested against, and the module that is trained.

Slow and plain on purpose: no caching, no fused kernels, every row computed in every block. Read `model.py` from top to bottom.
Needs torch and safetensors (`pip install saccade[torch]`).
"""

from saccade.reference.model import ActionHead, TimeDistribution

__all__ = ["ActionHead", "TimeDistribution"]
