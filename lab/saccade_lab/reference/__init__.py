"""The same action head and backbone in plain torch: they are trained, and the Rust ones tested against them.

They favour clarity over speed: nothing is cached, and every row is computed in every block. ``head`` is the
sampler and the loss, ``velocity`` the network that both evaluate, ``guidance`` the sampler's second context,
``layers`` the modules, ``intervene`` the effect of an intervention in each block; ``backbone`` is what turns
images and an instruction into features. Needs torch and safetensors.
"""

from saccade_lab.extras import LAB

LAB.require("torch", "safetensors")

from saccade_lab.reference.backbone import Backbone, BackboneFeatures  # noqa: E402
from saccade_lab.reference.guidance import Guidance  # noqa: E402
from saccade_lab.reference.head import ActionHead  # noqa: E402
from saccade_lab.reference.training import TimeDistribution  # noqa: E402

__all__ = ["ActionHead", "Backbone", "BackboneFeatures", "Guidance", "TimeDistribution"]
