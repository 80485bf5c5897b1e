"""The head's configuration."""

from __future__ import annotations

import dataclasses
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade.errors import CheckpointError

#: No config is longer; the same for one that is found beside the weights.
MOST_BYTES = 100_000_000


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """Sizes and switches of an action head.

    The names of a published ``config.json`` are in parentheses where they differ.

    Attributes:
        version: Release of the architecture, ``"n1"``, ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``. What the head
            computes is said by the other fields.
        width: Width of the diffusion transformer (``input_embedding_dim``).
        num_layers: Its blocks.
        num_heads: Its attention heads (``num_attention_heads``).
        head_dim: Width of one of them (``attention_head_dim``).
        context_dim: Width of the vision-language tokens (``backbone_embedding_dim``; N1:
            ``cross_attention_dim``).
        interleave_self_attention: Every second block is self-attention; otherwise all are cross-attention.
        mask_mode: What masks do in the cross-attention blocks: ``"none"``, they are ignored; ``"alternate"``,
            a block sees the attended positions of text, or those of images.
        attend_text_every_n_blocks: Of the alternating cross-attention blocks every so many see text, from the
            first one on, the others images; 0 with ``mask_mode`` ``"none"``.
        use_vlln: Whether the vision-language tokens pass a norm.
        vl_num_layers: Blocks of the VL self-attention, 0 without one.
        vl_num_heads: Its attention heads.
        vl_head_dim: Width of one of them.
        num_future_tokens: Learned query rows between state and actions (``num_target_vision_tokens``).
        future_key_bias: What is added to the logits of each future key in every self-attention block, the
            logarithms of how many tokens each stands for; None is zeros. Saccade's own
            (``{"saccade": {"future_key_bias": [...]}}``): no published program reads it.
        action_horizon: Actions in a chunk.
        action_dim: Width of an action as it is returned.
        encoder_action_dim: Width of an action as it is denoised (``pretrained_action_dim``); what it has
            beyond ``action_dim`` is held at zero.
        decoders: Module and width of each decoder, in the order in which their outputs stand side by side;
            together ``action_dim`` wide.
        state_dim: Width of the state vector (``max_state_dim``).
        state_history: State vectors that make the state row (``state_history_length``).
        hidden_dim: Hidden width of encoders and decoders (``hidden_size``).
        num_embodiments: Slices of the category-specific layers (``max_num_embodiments``).
        num_timestep_buckets: Buckets that the time 0..1 is cut into.
        num_steps: Euler steps unless a call says otherwise (``num_inference_timesteps``).
        max_positions: Rows of the position table (``max_seq_len``).
        add_pos_embed: Whether action rows get a position.
    """

    version: str
    width: int
    num_layers: int
    num_heads: int
    head_dim: int
    context_dim: int
    interleave_self_attention: bool
    mask_mode: str
    attend_text_every_n_blocks: int
    use_vlln: bool
    vl_num_layers: int
    vl_num_heads: int
    vl_head_dim: int
    num_future_tokens: int
    future_key_bias: tuple[float, ...] | None
    action_horizon: int
    action_dim: int
    encoder_action_dim: int
    decoders: tuple[tuple[str, int], ...]
    state_dim: int
    state_history: int
    hidden_dim: int
    num_embodiments: int
    num_timestep_buckets: int
    num_steps: int
    max_positions: int
    add_pos_embed: bool

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> HeadConfig:
        """Reads a published config: a whole checkpoint's (with ``action_head_cfg``, or flat as those of N1.6
        and N1.7 are) or the head's own. ``model_type`` says the version; without it the keys do.

        Raises:
            CheckpointError: with everything that is missing, of the wrong type or contradictory.
        """
        return cls(**_saccade.parse_config(to_json(config)))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> HeadConfig:
        """Reads ``path``, a ``config.json``; see :meth:`from_dict`.

        Raises:
            FileNotFoundError: there is no such file.
            CheckpointError: as :meth:`from_dict`.
        """
        return cls(**_saccade.parse_config(read_json(path)))


def to_json(config: Mapping[str, Any] | str | os.PathLike[str]) -> str:
    """The JSON text of a config given as a mapping or as the path of a file."""
    if isinstance(config, (str, os.PathLike)):
        return read_json(config)
    try:
        return json.dumps(dict(config), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"config: expected a mapping as JSON has it, or a path: {error}") from None


def read_json(path: str | os.PathLike[str]) -> str:
    """The text of a config file."""
    try:
        about = Path(path).stat()
        # A pipe would be waited for, a device read without end.
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("not a regular file")
        if about.st_size > MOST_BYTES:
            raise ValueError(f"more than {MOST_BYTES} bytes")
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(f"config: no such file: {os.fspath(path)}") from None
    except (OSError, TypeError, ValueError) as error:
        raise CheckpointError(f"config: {os.fspath(path)} cannot be read: {error}") from None
