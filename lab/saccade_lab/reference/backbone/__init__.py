"""The vision-language backbones in plain torch: trainable, and what the Rust backbone is tested against.

``model`` puts a backbone together, ``siglip`` and ``qwen3_vl`` are its vision towers, ``qwen3`` its language
model.
"""

from saccade_lab.reference.backbone.model import Backbone, BackboneFeatures, PreparedInputs

__all__ = ["Backbone", "BackboneFeatures", "PreparedInputs"]
