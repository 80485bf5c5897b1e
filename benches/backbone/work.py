"""The work of one call of a backbone by part, computed from its sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benches.cost import ELEMENT_BYTES
from benches.work import Work, Works, add_linear
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.timing import Machine

#: Parts whose operands are keys, values and probabilities rather than weights.
ATTENTION = ("vision_attention", "language_attention")


def backbone_work(sizes: BackboneSizes, grids: Sequence[tuple[int, int]], num_tokens: int) -> Works:
    """The work of one observation: every view once, causal attention as half a square.

    Args:
        sizes: Of the backbone.
        grids: Rows and columns of patches of each view.
        num_tokens: Tokens of the prompt, image tokens included.

    Returns:
        The parts `vision`, `vision_attention`, `connector`, `language` and `language_attention`. Embedding
        tokens, norms and activation functions are no products.

    Example:
        >>> sizes = BackboneSizes.from_config({"kind": "n1.5 backbone"})
        >>> works = backbone_work(sizes, [(16, 16)], 287)
        >>> round(sum(work.multiply_adds for work in works.values()) / 1e9, 1)
        285.5
    """
    vision, text = sizes.vision, sizes.text
    patches = [rows * columns for rows, columns in grids]
    rows, width = sum(patches), vision.width
    works: Works = {}
    add_linear(works, "vision", rows, 3 * vision.temporal_patch_size * vision.patch_size**2, width)
    for _ in range(vision.num_layers):
        for outputs in (width, width, width, width):
            add_linear(works, "vision", rows, width, outputs)
        add_linear(works, "vision", rows, width, vision.mlp_width)
        add_linear(works, "vision", rows, vision.mlp_width, width)
        for each in patches:
            _add(works, "vision_attention", Work(2 * each * each * width, 2 * each * width, each))
    tokens, merged = rows // sizes.merge**2, width * sizes.merge**2
    if sizes.version == "n1.7":
        for _ in range(1 + len(vision.deepstack)):
            add_linear(works, "connector", tokens, merged, merged)
            add_linear(works, "connector", tokens, merged, text.width)
    else:
        add_linear(works, "connector", tokens, merged, text.width)
        if sizes.connector_layers == 2:
            add_linear(works, "connector", tokens, text.width, text.width)
    queries, keys = text.num_heads * text.head_dim, text.num_key_heads * text.head_dim
    pairs = num_tokens * (num_tokens + 1) // 2
    for _ in range(sizes.num_layers):
        add_linear(works, "language", num_tokens, text.width, queries + 2 * keys)
        add_linear(works, "language", num_tokens, queries, text.width)
        add_linear(works, "language", num_tokens, text.width, 2 * text.mlp_width)
        add_linear(works, "language", num_tokens, text.mlp_width, text.width)
        _add(works, "language_attention", Work(2 * pairs * queries, 2 * num_tokens * keys, num_tokens))
    if sizes.project_to_dim is not None:
        add_linear(works, "language", num_tokens, text.width, sizes.project_to_dim)
    return works


def floor_seconds(works: Works, machine: Machine, precision: str) -> float:
    """The least time of a call: the longer of its multiply-adds at the CPU's peak and its bytes at the
    memory's bandwidth. Attention of int8 models is bfloat16.

    Args:
        works: As from `backbone_work`.
        machine: Measured peaks.
        precision: ``"float32"``, ``"bfloat16"`` or ``"int8"``.
    """
    rates: Mapping[str, float] = machine.macs_per_second
    arithmetic = {
        part: "bfloat16" if part in ATTENTION and precision == "int8" else precision for part in works
    }
    computing = sum(work.multiply_adds / rates[arithmetic[part]] for part, work in works.items())
    weights = sum(work.elements for part, work in works.items() if part not in ATTENTION)
    return max(computing, weights * ELEMENT_BYTES[precision] / machine.read_bytes_per_second)


def _add(works: Works, part: str, work: Work) -> None:
    works[part] = works.get(part, Work()) + work
