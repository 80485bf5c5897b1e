"""Error from rounding one group of layers: the action chunk of the torch reference with that group in int8,
int4 or bfloat16 and everything else in float32.

Needs the package and torch. Prints the Markdown table of docs/precision.md:

    python benches/precision_groups.py CHECKPOINT [--embodiment-id 0]
    python benches/precision_groups.py --full               N1.5's size, seeded random weights; 4 GB of memory
    python benches/precision_groups.py --full --outliers    the same with a few channels 2.5 times as large
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from saccade_lab.reference import ActionHead, random_weights
from saccade_lab.reference.layers import CategoryLinear

VL, DIT = r"vl_self_attention\.transformer_blocks\.\d+\.", r"model\.transformer_blocks\.\d+\."
EVEN, ODD = r"model\.transformer_blocks\.\d*[02468]\.", r"model\.transformer_blocks\.\d*[13579]\."
INT8_GROUPS = {
    "VL self-attention: q, k, v": VL + r"attn1\.to_[qkv]",
    "VL self-attention: out": VL + r"attn1\.to_out\.0",
    "VL feed-forward: first": VL + r"ff\.net\.0\.proj",
    "VL feed-forward: second": VL + r"ff\.net\.2",
    "cross-attention: q": EVEN + r"attn1\.to_q",
    "cross-attention: k, v": EVEN + r"attn1\.to_[kv]",
    "self-attention: q, k, v": ODD + r"attn1\.to_[qkv]",
    "cross- and self-attention: out": DIT + r"attn1\.to_out\.0",
    "feed-forward: first": DIT + r"ff\.net\.0\.proj",
    "feed-forward: second": DIT + r"ff\.net\.2",
    "all of the blocks (what int8 runs in int8)": rf"({VL}|{DIT})(attn1|ff)\..*",
    "the last projection": r"model\.proj_out_2",
    "state encoder": r"state_encoder\..*",
    "action encoder: its last layer": r"action_encoder\.W3",
    "action decoder": r"action_decoder\..*",
    "modulations and timestep": rf"{DIT}norm1\.linear|model\.proj_out_1|model\.timestep_encoder\..*",
}


def int8_weight(weight: Tensor) -> Tensor:
    """Rows `(out, in)` rounded to 255 steps of their largest magnitude."""
    scale = weight.abs().amax(dim=-1, keepdim=True).clamp_min(1e-30) / 127
    return (weight / scale).round() * scale


def int4_weight(weight: Tensor) -> Tensor:
    """Rows `(out, in)` rounded to 15 steps: of eight scales the one with the least squared error."""
    full = weight.abs().amax(dim=-1, keepdim=True).clamp_min(1e-30) / 7
    best, least = torch.zeros_like(weight), torch.full_like(full, torch.inf)
    for twelfths in range(12, 4, -1):
        scale = full * (twelfths / 12)
        rounded = (weight / scale).round().clamp(-7, 7) * scale
        error = (rounded - weight).square().sum(dim=-1, keepdim=True)
        best = torch.where(error < least, rounded, best)
        least = torch.minimum(error, least)
    return best


def int8_rows(x: Tensor) -> Tensor:
    """Rows rounded to 256 steps between their minimum and maximum, where zero is one of the steps."""
    low, high = x.amin(dim=-1, keepdim=True).clamp_max(0), x.amax(dim=-1, keepdim=True).clamp_min(0)
    scale = ((high - low) / 255).clamp_min(1e-30)
    zero = (-low / scale).round()
    return (((x / scale).round() + zero).clamp(0, 255) - zero) * scale


def bfloat16(x: Tensor) -> Tensor:
    """`x` rounded to bfloat16."""
    return x.bfloat16().to(x.dtype)


def round_group(
    head: ActionHead, pattern: str, weights: Callable[[Tensor], Tensor], rows: Callable[[Tensor], Tensor]
) -> dict[Tensor, Tensor]:
    """Rounds the weights and inputs of the matching layers; returns the original weights."""
    before: dict[Tensor, Tensor] = {}
    for name, module in head.named_modules():
        if not isinstance(module, nn.Linear | CategoryLinear) or not re.fullmatch(pattern, name):
            continue
        weight = module.weight if isinstance(module, nn.Linear) else module.W
        before[weight] = weight.detach().clone()
        with torch.no_grad():
            if isinstance(module, nn.Linear):
                weight.copy_(weights(weight))
            else:
                weight.copy_(weights(weight.transpose(1, 2)).transpose(1, 2))
        module.register_forward_pre_hook(lambda _, args: (rows(args[0]), *args[1:]))
    return before


def add_outliers(head: ActionHead) -> None:
    """Scales one input column and one output row in 64 of every linear layer of the blocks."""
    for name, module in head.named_modules():
        if isinstance(module, nn.Linear) and re.fullmatch(rf"({VL}|{DIT})(attn1|ff)\..*", name):
            with torch.no_grad():
                module.weight[:, ::64] *= 2.5
                module.weight[::64] *= 2


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("checkpoint", nargs="?", type=Path)
    parser.add_argument("--full", action="store_true", help="random weights of N1.5's size")
    parser.add_argument("--outliers", action="store_true", help="scale a few input channels and outputs")
    parser.add_argument("--embodiment-id", type=int, default=0)
    parser.add_argument("--num-vl-tokens", type=int, default=296)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.checkpoint is not None:
        head = ActionHead.from_pretrained(args.checkpoint)
    else:
        config = (
            random_weights.sized_config("n1.5", num_embodiments=1)
            if args.full
            else random_weights.small_config()
        )
        head = random_weights.random_head(config, args.seed)
    if args.outliers:
        add_outliers(head)
    inputs = random_weights.random_inputs(
        head.config, args.seed + 1, batch=1, num_vl_tokens=args.num_vl_tokens
    )
    inputs["embodiment_id"] = torch.tensor([args.embodiment_id])

    def chunk() -> Tensor:
        with torch.no_grad():
            actions: Tensor = head(**inputs)
            return actions.double()

    exact = chunk()
    columns = [f"{kind}: {size}" for kind in ("int4", "int8", "bfloat16") for size in ("largest", "rms")]
    print(f"| rounded | {' | '.join(columns)} |\n{'|---' * (len(columns) + 1)}|")
    for group, pattern in INT8_GROUPS.items():
        cells = []
        for weights, rows in ((int4_weight, int8_rows), (int8_weight, int8_rows), (bfloat16, bfloat16)):
            before = round_group(head, pattern, weights, rows)
            if not before:
                cells += ["", ""]
                continue
            error = chunk() - exact
            cells += [
                f"{float(error.abs().max() / exact.abs().max()):.1e}",
                f"{float(error.square().mean().sqrt() / exact.square().mean().sqrt()):.1e}",
            ]
            with torch.no_grad():
                for weight, values in before.items():
                    weight.copy_(values)
            for module in head.modules():
                module._forward_pre_hooks.clear()
        print(f"| {group} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
