"""Random checkpoints of any size, to try installation, memory and speed without a download.

``python -m saccade.checkpoints.random_checkpoint OUT`` writes one; ``--help`` lists its options.
"""

from saccade.checkpoints.random_checkpoint.head import write_head
from saccade.checkpoints.random_checkpoint.whole import small_backbone, small_head, write

__all__ = ["small_backbone", "small_head", "write", "write_head"]
