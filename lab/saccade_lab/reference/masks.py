"""Which vision-language tokens the blocks of a head attend to.

Shapes in comments: B is the batch, S the vision-language tokens.
"""

from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from saccade._internal.arrays import boolean
from saccade.errors import InputError
from saccade.head.config import HeadConfig
from saccade_lab.reference.checks import can_be_read, check_shape

Mask: TypeAlias = "Tensor | np.ndarray | None"


def is_cross(config: HeadConfig, block: int) -> bool:
    """Whether this is a cross-attention block. The others are self-attention."""
    return block % 2 == 0 or not config.interleave_self_attention


def reads_images(config: HeadConfig, block: int) -> bool:
    """Whether this cross-attention block of a head with alternate masks attends to image tokens.

    The others attend to text.
    """
    return block % (2 * config.attend_text_every_n_blocks) != 0


def forbidden_tokens(
    config: HeadConfig, tokens: Tensor, *, drop_vl: Mask, attention_mask: Mask, image_mask: Mask
) -> list[Tensor | None]:
    """The vision-language tokens that no row attends to, for each block.

    Args:
        config: Config of the head.
        tokens: ``(B, S, context_dim)``.
        drop_vl: Bool ``(B, S)``, True for tokens that are removed.
        attention_mask: Bool ``(B, S)``, True where a token is attended; None for all.
        image_mask: Bool ``(B, S)``, True for image tokens. Required with alternate masks.

    Returns:
        For every block bool ``(B, S)``, or None if it attends to all tokens.

    Raises:
        DtypeError, ShapeError: A mask has the wrong dtype or shape.
        InputError: Padding is given to a head that ignores it, a mask is missing, or a block has no token to
            attend to in an observation. Values of masks are not checked while a CUDA graph is recorded.
    """
    removed = token_mask("drop_vl", drop_vl, tokens)
    attended = token_mask("attention_mask", attention_mask, tokens)
    image = token_mask("image_mask", image_mask, tokens)
    if config.mask_mode == "none":
        if attended is not None and can_be_read(attended) and not attended.all():
            raise InputError(
                "attention_mask: expected all true, because the released head ignores padding, got a false "
                "entry; drop_vl removes tokens"
            )
        return [removed] * config.num_layers
    if image is None:
        raise InputError(
            "image_mask: expected bool (batch, T_vl), because blocks of this head attend to either text or "
            "images, got None"
        )
    permitted = torch.ones_like(image) if attended is None else attended
    if removed is not None:
        permitted = permitted & ~removed
    forbidden: list[Tensor | None] = []
    for block in range(config.num_layers):
        if not is_cross(config, block):
            forbidden.append(None)
            continue
        kind, chosen = ("image", image) if reads_images(config, block) else ("text", ~image)
        read = permitted & chosen  # (B, S)
        if can_be_read(read) and not read.any(dim=1).all():
            row = int(read.any(dim=1).int().argmin())
            raise InputError(
                f"image_mask: observation {row} has no {kind} token that block {block} can attend to"
            )
        forbidden.append(~read)
    return forbidden


def token_mask(name: str, given: Mask, tokens: Tensor) -> Tensor | None:
    """A mask for ``tokens (B, S, context_dim)`` as a bool tensor ``(B, S)``, or None.

    Raises:
        DtypeError: The mask is not boolean.
        ShapeError: The mask has another shape.
    """
    if not isinstance(given, Tensor) or given.dtype != torch.bool:
        array = boolean(name, given.cpu() if isinstance(given, Tensor) else given)
        if array is None:
            return None
        given = torch.tensor(array)
    mask = given.to(tokens.device)
    check_shape(name, mask, tuple(tokens.shape[:2]))
    return mask


def removal_bias(removed: Tensor, dtype: torch.dtype) -> Tensor:
    """Minus infinity on removed keys, ``(B, 1, 1, S)``, from ``(B, S)`` bool."""
    bias = torch.zeros(removed.shape, dtype=dtype, device=removed.device).masked_fill(removed, -torch.inf)
    return bias[:, None, None]
