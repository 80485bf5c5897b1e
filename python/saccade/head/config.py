"""The configuration of a head."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import integer
from saccade._internal.small_files import read_small
from saccade.errors import CheckpointError


@dataclasses.dataclass(frozen=True)
class HeadConfig:
    """Sizes and switches of an action head.

    If the name in a published ``config.json`` differs, it is given in parentheses.

    Attributes:
        version: Release of the architecture: ``"n1"``, ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``. The other fields
            determine what the head computes.
        width: Width of the diffusion transformer (``input_embedding_dim``).
        num_layers: Number of its blocks.
        num_heads: Number of its attention heads (``num_attention_heads``).
        head_dim: Width of an attention head (``attention_head_dim``).
        context_dim: Width of the vision-language tokens (``backbone_embedding_dim``; N1:
            ``cross_attention_dim``).
        interleave_self_attention: Whether every second block is a self-attention block. Otherwise all blocks
            are cross-attention.
        mask_mode: How cross-attention blocks use masks. ``"none"``: not at all. ``"alternate"``: a block
            attends to the attended positions of text, or to those of images.
        attend_text_every_n_blocks: With ``mask_mode`` ``"alternate"``, every n-th cross-attention block,
            starting with the first, attends to text; the others to images. 0 with ``"none"``.
        use_vlln: Whether the vision-language tokens are normalised first.
        vl_num_layers: Number of blocks of the VL self-attention; 0 without one.
        vl_num_heads: Number of its attention heads.
        vl_head_dim: Width of one of its attention heads.
        num_future_tokens: Number of learned rows between state and actions (``num_target_vision_tokens``).
        future_key_bias: A number for each future token, added to the logits of its key in every
            self-attention block: the logarithm of the number of tokens that it represents. None means zeros.
            This is an extension by saccade (``{"saccade": {"future_key_bias": [...]}}``), which no other
            program reads.
        action_horizon: Number of actions in a chunk.
        action_dim: Width of a returned action.
        encoder_action_dim: Width of an action during sampling (``pretrained_action_dim``). Dimensions beyond
            ``action_dim`` are kept at zero.
        decoders: Module name and width of each decoder in the order of their outputs, which are concatenated.
            The widths add up to ``action_dim``.
        state_dim: Width of the state vector (``max_state_dim``).
        state_history: Number of state vectors in a state row (``state_history_length``).
        num_states: Number of state vectors in an observation. N1.7 makes one row of all of them, so this is
            ``state_history``. The other versions make a row of each: one, or as many as
            :meth:`saccade.ActionHead.from_pretrained` was given.
        hidden_dim: Hidden width of encoders and decoders (``hidden_size``).
        num_embodiments: Number of embodiments of the category-specific layers (``max_num_embodiments``).
        num_timestep_buckets: Number of buckets of the time from 0 to 1.
        num_steps: Default number of Euler steps (``num_inference_timesteps``).
        max_positions: Number of rows of the position table (``max_seq_len``).
        add_pos_embed: Whether positions are added to the action rows.
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
    num_states: int
    hidden_dim: int
    num_embodiments: int
    num_timestep_buckets: int
    num_steps: int
    max_positions: int
    add_pos_embed: bool

    @property
    def num_state_rows(self) -> int:
        """Number of state rows, the first rows of the query sequence."""
        return self.num_states // self.state_history

    @property
    def num_rows(self) -> int:
        """Number of rows of the query sequence: state, future, action."""
        return self.num_state_rows + self.num_future_tokens + self.action_horizon

    @classmethod
    def from_dict(cls, config: Mapping[str, Any], *, num_states: int | None = None) -> HeadConfig:
        """Reads a published config.

        Args:
            config: The config of a whole checkpoint (with ``action_head_cfg``, or flat as those of N1.6 and
                N1.7) or of the head alone. The version is that of ``model_type``. Without this key, it is
                recognised by the other keys.
            num_states: As for :meth:`saccade.ActionHead.from_pretrained`.

        Raises:
            CheckpointError: Values are missing, of the wrong type or contradictory. The message lists all of
                them.
            InputError: ``num_states`` is out of range.
        """
        states = None if num_states is None else integer("num_states", num_states)
        return cls(**_saccade.parse_config(to_json(config), states))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> HeadConfig:
        """Reads a ``config.json`` file; see :meth:`from_dict`.

        Raises:
            FileNotFoundError, CheckpointError: The file does not exist; or as :meth:`from_dict`.
        """
        return cls(**_saccade.parse_config(read_text(path)))


def to_json(config: Mapping[str, Any] | str | os.PathLike[str]) -> str:
    """The JSON text of a config.

    Args:
        config: A mapping, or the path of a JSON file.

    Raises:
        FileNotFoundError: The file does not exist.
        CheckpointError: The mapping contains values that JSON cannot represent, or the file cannot be read.
    """
    if isinstance(config, (str, os.PathLike)):
        return read_text(config)
    try:
        return json.dumps(dict(config), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"config: expected a mapping of JSON values, or a path: {error}") from None


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a config file.

    Raises:
        FileNotFoundError, CheckpointError: As :func:`to_json`.
    """
    try:
        return read_small(Path(path)).decode("utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(f"config: no such file: {os.fspath(path)}") from None
    except (OSError, TypeError, ValueError) as error:
        raise CheckpointError(f"config: {os.fspath(path)} cannot be read: {error}") from None
