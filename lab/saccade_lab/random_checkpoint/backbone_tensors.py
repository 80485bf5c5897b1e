"""The name and shape of each tensor of a vision-language backbone, as published checkpoints store them."""

from __future__ import annotations

from collections.abc import Iterator

from saccade_lab.backbone_sizes import BackboneSizes

Shapes = Iterator[tuple[str, tuple[int, ...]]]


def tensor_shapes(sizes: BackboneSizes) -> Shapes:
    """Name below ``backbone.`` and shape of each tensor that is read, in the order of the computation."""
    if sizes.version == "n1.7":
        yield from _qwen3_vl_tower("model.model.visual", sizes)
        yield from _language_model("model.model.language_model", sizes)
        return
    root = "eagle_model" if sizes.version == "n1.5" else "model"
    yield from _siglip(f"{root}.vision_model.vision_model", sizes)
    yield from _mlp1(f"{root}.mlp1", sizes)
    yield from _language_model(f"{root}.language_model.model", sizes)
    yield f"{root}.language_model.model.norm.weight", (sizes.text.width,)
    if sizes.project_to_dim is not None:
        yield from _linear("eagle_linear", sizes.text.width, sizes.project_to_dim)


def unread_tensor_shapes(sizes: BackboneSizes) -> Shapes:
    """Name and shape of tensors that are published but not read: SigLIP's pooling head, N1.7's last norm."""
    if sizes.version == "n1.7":
        yield "model.model.language_model.norm.weight", (sizes.text.width,)
        return
    root = "eagle_model" if sizes.version == "n1.5" else "model"
    head, width = f"{root}.vision_model.vision_model.head", sizes.vision.width
    yield f"{head}.probe", (1, 1, width)
    yield f"{head}.attention.in_proj_weight", (3 * width, width)
    yield f"{head}.attention.in_proj_bias", (3 * width,)
    yield from _linear(f"{head}.attention.out_proj", width, width)
    yield from _norm(f"{head}.layernorm", width)
    yield from _linear(f"{head}.mlp.fc1", width, sizes.vision.mlp_width)
    yield from _linear(f"{head}.mlp.fc2", sizes.vision.mlp_width, width)


def _linear(name: str, inputs: int, outputs: int) -> Shapes:
    yield f"{name}.weight", (outputs, inputs)
    yield f"{name}.bias", (outputs,)


def _norm(name: str, width: int) -> Shapes:
    yield f"{name}.weight", (width,)
    yield f"{name}.bias", (width,)


def _siglip(root: str, sizes: BackboneSizes) -> Shapes:
    vision = sizes.vision
    width, side = vision.width, vision.patch_size
    patch = (3, side, side) if sizes.version == "n1.5" else (3 * side * side,)
    yield f"{root}.embeddings.patch_embedding.weight", (width, *patch)
    yield f"{root}.embeddings.patch_embedding.bias", (width,)
    yield f"{root}.embeddings.position_embedding.weight", (vision.num_positions, width)
    for index in range(vision.num_layers):
        layer = f"{root}.encoder.layers.{index}"
        yield from _norm(f"{layer}.layer_norm1", width)
        for name in ("q_proj", "k_proj", "v_proj", "out_proj"):
            yield from _linear(f"{layer}.self_attn.{name}", width, width)
        yield from _norm(f"{layer}.layer_norm2", width)
        yield from _linear(f"{layer}.mlp.fc1", width, vision.mlp_width)
        yield from _linear(f"{layer}.mlp.fc2", vision.mlp_width, width)
    yield from _norm(f"{root}.post_layernorm", width)


def _mlp1(root: str, sizes: BackboneSizes) -> Shapes:
    inputs, width = sizes.vision.width * sizes.merge**2, sizes.text.width
    if sizes.connector_layers == 1:
        yield from _linear(f"{root}.0", inputs, width)
        return
    yield from _norm(f"{root}.0", inputs)
    yield from _linear(f"{root}.1", inputs, width)
    yield from _linear(f"{root}.3", width, width)


def _qwen3_vl_tower(root: str, sizes: BackboneSizes) -> Shapes:
    vision = sizes.vision
    width, side = vision.width, vision.patch_size
    yield f"{root}.patch_embed.proj.weight", (width, 3, vision.temporal_patch_size, side, side)
    yield f"{root}.patch_embed.proj.bias", (width,)
    yield f"{root}.pos_embed.weight", (vision.num_positions, width)
    for index in range(vision.num_layers):
        block = f"{root}.blocks.{index}"
        yield from _norm(f"{block}.norm1", width)
        yield from _linear(f"{block}.attn.qkv", width, 3 * width)
        yield from _linear(f"{block}.attn.proj", width, width)
        yield from _norm(f"{block}.norm2", width)
        yield from _linear(f"{block}.mlp.linear_fc1", width, vision.mlp_width)
        yield from _linear(f"{block}.mlp.linear_fc2", vision.mlp_width, width)
    merged = width * sizes.merge**2
    mergers = [("merger", width)]
    mergers += [(f"deepstack_merger_list.{index}", merged) for index in range(len(vision.deepstack))]
    for name, normed in mergers:
        yield from _norm(f"{root}.{name}.norm", normed)
        yield from _linear(f"{root}.{name}.linear_fc1", merged, merged)
        yield from _linear(f"{root}.{name}.linear_fc2", merged, sizes.text.width)


def _language_model(root: str, sizes: BackboneSizes) -> Shapes:
    text = sizes.text
    queries, keys = text.num_heads * text.head_dim, text.num_key_heads * text.head_dim
    yield f"{root}.embed_tokens.weight", (text.vocabulary, text.width)
    for index in range(sizes.num_layers):
        layer = f"{root}.layers.{index}"
        yield f"{layer}.input_layernorm.weight", (text.width,)
        yield f"{layer}.self_attn.q_proj.weight", (queries, text.width)
        yield f"{layer}.self_attn.k_proj.weight", (keys, text.width)
        yield f"{layer}.self_attn.v_proj.weight", (keys, text.width)
        yield f"{layer}.self_attn.q_norm.weight", (text.head_dim,)
        yield f"{layer}.self_attn.k_norm.weight", (text.head_dim,)
        yield f"{layer}.self_attn.o_proj.weight", (text.width, queries)
        yield f"{layer}.post_attention_layernorm.weight", (text.width,)
        yield f"{layer}.mlp.gate_proj.weight", (text.mlp_width, text.width)
        yield f"{layer}.mlp.up_proj.weight", (text.mlp_width, text.width)
        yield f"{layer}.mlp.down_proj.weight", (text.width, text.mlp_width)
