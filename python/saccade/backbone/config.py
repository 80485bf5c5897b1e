"""The configuration of a backbone."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class BackboneConfig:
    """Sizes and switches of a vision-language backbone.

    If the name in a published ``config.json`` differs, it is given in parentheses.

    Attributes:
        version: Release of the architecture: ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``. The other fields determine
            what the backbone computes.
        feature_dim: Width of the features.
        project_to_dim: Width of the last linear layer, which projects the features; None without one.
        image_token_id: Placeholder token id in the prompt that is replaced by image tokens
            (``image_token_index``).
        width: Width of the language model (``hidden_size``).
        num_layers: Number of its layers that are used (``select_layer``).
        num_heads: Number of its attention heads (``num_attention_heads``).
        num_kv_heads: Number of its key and value heads (``num_key_value_heads``).
        head_dim: Width of an attention head.
        hidden_dim: Hidden width of its feed-forward layers (``intermediate_size``).
        vocab_size: Number of token ids.
        norm_eps: Epsilon of its RMS norms (``rms_norm_eps``).
        rope_theta: Base of the frequencies of its rotary positions.
        mrope_section: Number of rotary pairs of a head for time, height and width. None if all pairs rotate
            with the position in the prompt.
        has_final_norm: Whether the features are normalised.
        vision_width: Width of the vision tower (``hidden_size``).
        vision_num_layers: Number of its blocks (``num_hidden_layers``, ``depth``).
        vision_num_heads: Number of its attention heads.
        vision_head_dim: Width of an attention head of the tower.
        vision_hidden_dim: Hidden width of its feed-forward layers (``intermediate_size``).
        vision_norm_eps: Epsilon of its layer norms (``layer_norm_eps``).
        patch_size: Number of pixels on each side of a patch.
        image_size: Height and width of every view in pixels. None if views may have any number of whole
            tokens.
        num_positions: Number of rows of the table of positions, which is a square of patches
            (``num_patches``, ``num_position_embeddings``).
        merge: Number of patches on each side of the square that becomes one token (``spatial_merge_size``).
        connector_layers: Number of linear layers between tower and language model (``mlp_connector_layers``).
        deepstack: Blocks of the tower whose output is also added after the first layers of the language model
            (``deepstack_visual_indexes``).
    """

    version: str
    feature_dim: int
    project_to_dim: int | None
    image_token_id: int
    width: int
    num_layers: int
    num_heads: int
    num_kv_heads: int
    head_dim: int
    hidden_dim: int
    vocab_size: int
    norm_eps: float
    rope_theta: float
    mrope_section: tuple[int, int, int] | None
    has_final_norm: bool
    vision_width: int
    vision_num_layers: int
    vision_num_heads: int
    vision_head_dim: int
    vision_hidden_dim: int
    vision_norm_eps: float
    patch_size: int
    image_size: int | None
    num_positions: int
    merge: int
    connector_layers: int
    deepstack: tuple[int, ...]
