"""Random checkpoints of any size, to try installation, memory and speed without a download.

``python -m saccade_lab.random_checkpoint OUT`` writes one; ``--help`` lists its options.
"""

from saccade_lab.random_checkpoint.whole import small_backbone, small_head, write

__all__ = ["small_backbone", "small_head", "write"]
