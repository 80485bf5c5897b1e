"""The same action head in plain torch: the oracle of the Rust head, and the module that is trained.

Slow and plain on purpose: nothing is cached, every row is computed in every block. `model.py` reads from top
to bottom; `intervene.py` says what an intervention does in each block. Needs torch and safetensors (`pip
install saccade[torch]`).
"""

from saccade.reference.model import ActionHead, TimeDistribution

__all__ = ["ActionHead", "TimeDistribution"]
