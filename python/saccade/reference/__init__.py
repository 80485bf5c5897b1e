"""The same action head in plain torch: it is trained, and the Rust head is tested against it.

It favours clarity over speed: nothing is cached, and every row is computed in every block. `head` is the
sampler and the loss, `layers` the modules, `intervene` the effect of an intervention in each block. Needs
torch and safetensors.
"""

from saccade._extras import require

require("torch", "safetensors")

from saccade.reference.head import ActionHead  # noqa: E402
from saccade.reference.training import TimeDistribution  # noqa: E402

__all__ = ["ActionHead", "TimeDistribution"]
