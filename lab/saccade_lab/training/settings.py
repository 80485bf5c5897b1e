"""What a training run depends on besides the demonstrations; needs no torch."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from saccade.errors import InputError

#: What ``saccade train`` writes only to continue a run.
STATE_FILE = "training.pt"


def features_name(start_sha256: str, recording_sha256: str, samples: str) -> str:
    """The name of a file with the features of a frozen backbone, next to the runs that share it.

    Args:
        start_sha256: Hash of the backbone's tensors.
        recording_sha256: Hash of the demonstrations.
        samples: Which of their frames, and how they are shown.
    """
    return f"features-{start_sha256[:16]}-{recording_sha256[:16]}-{samples}.npy"


CATEGORY_STD = 0.02  # of the released code: `saccade_lab.reference.layers.TABLE_STD`, which needs torch
RELEASED_WIDTH = 1536  # of GR00T N1.5
#: Settings that were added after the first runs; see ``TrainingSettings.to_dict``.
ADDED = ("category_std", "dtype", "language_dropout", "shift", "version", "view_size")


def released_std(width: int) -> float:
    """The ``category_std`` with which a layer whose input has this width begins on the scale of GR00T N1.5.

    What a linear layer returns grows with the square root of the width of its input. With the released 0.02,
    the encoded actions of a head of width 64 begin much smaller than their positions, which they do not in
    GR00T N1.5 (``studies/why-32/initial_scale.py``).

    Example:
        >>> released_std(1536), round(released_std(64), 3)
        (0.02, 0.098)
    """
    return CATEGORY_STD * math.sqrt(RELEASED_WIDTH / width)


@dataclass(frozen=True)
class TrainingSettings:
    """The settings of a training run. The defaults are those of the bundled policy.

    Attributes:
        only: What is trained. ``""`` is the whole policy. ``"backbone"`` is the backbone without a head,
            which learns to locate object and goal from the image tokens. ``"head"`` is the head alone, from
            random weights, on the frozen backbone of the policy that the run starts from; each frame then has
            one of the wordings of its instruction.
        steps: Optimiser steps; the learning rate falls to zero over them.
        batch_size: Frames per step. Many small steps are better than fewer large ones of the same total time.
        learning_rate: Learning rate of AdamW after the warm-up.
        ema_decay: Decay of the averaged weights, which are those that are saved.
        target_weight: Weight of the loss that locates object and goal.
        alignment_weight: Weight of the loss that aligns the hidden rows of the future tokens with the
            averaged backbone's features of the observation one horizon later, as in FLARE, which used 0.2.
        alignment_block: Block of the head after which those rows are taken. None for the middle one: as many
            blocks for the rows to attend to the images as for the actions to attend to the rows.
        absent_share: Share of frames that get the instruction of a task whose object is absent, with standing
            still as the action. Without them the images alone distinguish most tasks, and the policy ignores
            the words.
        language_dropout: Share of the other frames that get the released default for a missing instruction,
            as ``language_dropout_prob`` of Isaac-GR00T N1.5's training. Guidance needs a policy that knows
            it.
        shift: Pixels by which each frame is shifted at random along each axis, at most, while the policy is
            trained; edges are repeated. With few demonstrations it keeps a policy from learning the pixels
            of each by heart.
        start_sha256: Hash of the tensors that the run starts from; empty for random ones. ``train`` sets it.
        seed: Seed of initial weights, order and noise.
        category_std: Standard deviation of the initial category-specific weights, those of the state encoder
            and of the encoder and the decoder of the actions. 0.02 is that of the released code, which is
            used at a width of 1536; see ``released_std``.
        blind: Whether all pictures are black, for a policy that shows what can be done without them.
        width, num_layers, num_heads: Sizes of the head; the language model has as many heads.
        language_width: Width of the language model, and of the head's VL self-attention on its features; 0
            for that of the head.
        language_layers: Layers of the language model.
        vision_width, vision_layers, vision_heads: Sizes of the vision tower.
        vl_num_layers: Blocks of the head's VL self-attention.
        num_future_tokens: N.
        horizon: Actions per chunk.
        execute_steps: Actions of a chunk that are executed before the next observation.
        num_steps: Euler steps at run time.
        patch_size: Pixels along each side of the patch behind an image token, an even number.
        dtype: ``"float32"``, or ``"bfloat16"`` for training under torch's autocast, on a CPU: products and
            most of what is between them are computed in bfloat16. Weights, their gradients and averages, the
            attention of the head and losses stay in float32, and so does everything of held-out frames.
        version: ``"n1.5"`` or ``"n1.7"``, of which only policies of LIBERO can be.
        view_size: Pixels along each side of a frame as the tower of a LIBERO policy sees it, a multiple of
            ``patch_size``; 0 for policies of Meta-World, which see the recorded size.
    """

    only: Literal["", "backbone", "head"] = ""
    steps: int = 8000
    batch_size: int = 16
    learning_rate: float = 6e-4
    ema_decay: float = 0.999
    target_weight: float = 1.0
    alignment_weight: float = 0.0
    alignment_block: int | None = None
    absent_share: float = 0.1
    language_dropout: float = 0.0
    shift: int = 0
    start_sha256: str = ""
    seed: int = 0
    category_std: float = CATEGORY_STD
    blind: bool = False
    width: int = 128
    num_layers: int = 4
    num_heads: int = 4
    language_width: int = 0
    language_layers: int = 2
    vision_width: int = 96
    vision_layers: int = 3
    vision_heads: int = 3
    vl_num_layers: int = 1
    num_future_tokens: int = 32
    horizon: int = 16
    execute_steps: int = 4
    num_steps: int = 4
    patch_size: int = 16
    dtype: Literal["float32", "bfloat16"] = "float32"
    version: str = "n1.5"
    view_size: int = 0

    def __post_init__(self) -> None:
        if self.only not in ("", "backbone", "head"):
            raise InputError(f"only: given {self.only!r}, expected '', 'backbone' or 'head'")
        if self.dtype not in ("float32", "bfloat16"):
            raise InputError(f"dtype: given {self.dtype!r}, expected 'float32' or 'bfloat16'")
        for name, share in (
            ("absent_share", self.absent_share),
            ("language_dropout", self.language_dropout),
            ("shift", self.shift),
        ):
            if self.only == "head" and share:
                raise InputError(
                    f"{name}: given {share}, expected 0 where only the head is trained: the features of a "
                    "frame are computed once, with an instruction of its own task"
                )
        if self.shift < 0:
            raise InputError(f"shift: given {self.shift}, expected at least 0")
        for name, width in (("width", self.width), ("language_width", self.language_width)):
            if width % (2 * self.num_heads):
                raise InputError(
                    f"{name}: given {width}, expected a multiple of {2 * self.num_heads}, an even number for "
                    f"each of num_heads {self.num_heads}"
                )
        if self.language_width < 0:
            raise InputError(f"language_width: given {self.language_width}, expected at least 0")
        if self.num_heads > 1 and self.num_heads % 2:
            raise InputError(f"num_heads: given {self.num_heads}, expected 1 or an even number")
        if not 0 < self.category_std < math.inf:
            raise InputError(f"category_std: given {self.category_std}, expected a positive number")
        if self.vision_width % self.vision_heads:
            raise InputError(
                f"vision_width: given {self.vision_width}, expected a multiple of vision_heads "
                f"{self.vision_heads}"
            )
        if self.patch_size < 2 or self.patch_size % 2:
            raise InputError(f"patch_size: given {self.patch_size}, expected an even number, at least 2")
        if not 0 <= self.alignment_weight < math.inf:
            raise InputError(f"alignment_weight: given {self.alignment_weight}, expected at least 0")
        if self.alignment_weight and self.num_future_tokens == 0:
            raise InputError(
                f"alignment_weight: given {self.alignment_weight}, expected 0 with num_future_tokens 0: "
                "there is no row to align"
            )
        if self.alignment_block is not None and not 0 <= self.alignment_block < self.num_layers:
            raise InputError(
                f"alignment_block: given {self.alignment_block}, expected 0 to {self.num_layers - 1}"
            )

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON values.

        Without settings that were added after the first runs, where they have their defaults: so these runs
        can be continued and compared with later ones.
        """
        left_out = {
            one.name for one in fields(self) if one.name in ADDED and getattr(self, one.name) == one.default
        }
        return {name: value for name, value in asdict(self).items() if name not in left_out}

    @property
    def features_width(self) -> int:
        """The width of the language model, whose features the head reads."""
        return self.language_width or self.width

    @property
    def aligned_block(self) -> int | None:
        """The block after which future rows are aligned; None without alignment."""
        if self.alignment_weight == 0:
            return None
        return (self.num_layers - 1) // 2 if self.alignment_block is None else self.alignment_block


#: The settings of ``saccade train`` on demonstrations of LIBERO. Its scenes have seven objects that look
#: alike, for which frames are larger than Meta-World's, and of no two of its tasks it is known that the words
#: of one make no sense in the scene of the other. On two demonstrations, a head of N1.7 of width 64 reached a
#: loss of 0.36 in 700 steps from the scale of ``released_std``, and 0.89 from 0.02. In 5,800 steps of 128
#: frames of 380 demonstrations, the loss of held-out ones fell to 0.052 with shifts of 8 pixels, and to 0.063
#: without, where it rose again. The steps are meant for two hours of two cores, by 30 ms of CPU time a frame.
LIBERO_SETTINGS = TrainingSettings(
    version="n1.7",
    steps=14_000,
    batch_size=32,
    learning_rate=8e-4,
    absent_share=0.0,
    shift=8,
    num_layers=8,
    execute_steps=8,
    category_std=released_std(TrainingSettings.width),
    patch_size=32,
    view_size=192,
)
