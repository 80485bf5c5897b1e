"""Errors from rounding the weights of one group of layers to four bits, all others exact."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from benches.int4.accuracy import Model, Note, error, results_of
from saccade.checkpoints import describe, read_tensors

VISION = r".*(vision_model|visual)\..*"
LANGUAGE = r".*language_model\..*"
VL, DIT = r".*vl_self_attention\..*", r".*action_head\.model\.transformer_blocks\.\d+\."
EVEN, ODD = (rf".*action_head\.model\.transformer_blocks\.\d*[{digits}]\." for digits in ("02468", "13579"))
#: Patterns of the names of weights.
GROUPS = {
    "vision tower: q, k, v": VISION + r"(q_proj|k_proj|v_proj|attn\.qkv)\.weight",
    "vision tower: out": VISION + r"(out_proj|attn\.proj)\.weight",
    "vision tower: first of the feed-forward": VISION + r"(fc1|linear_fc1)\.weight",
    "vision tower: second": VISION + r"(fc2|linear_fc2)\.weight",
    "language model: q, k, v": LANGUAGE + r"(q_proj|k_proj|v_proj)\.weight",
    "language model: out": LANGUAGE + r"o_proj\.weight",
    "language model: gate, up": LANGUAGE + r"(gate_proj|up_proj)\.weight",
    "language model: down": LANGUAGE + r"down_proj\.weight",
    "VL self-attention: attention": VL + r"attn1\..*weight",
    "VL self-attention: feed-forward": VL + r"ff\..*weight",
    "cross-attention: q": EVEN + r"attn1\.to_q\.weight",
    "cross-attention: k, v": EVEN + r"attn1\.to_[kv]\.weight",
    "self-attention: q, k, v": ODD + r"attn1\.to_[qkv]\.weight",
    "head: out of both": DIT + r"attn1\.to_out\.0\.weight",
    "head: first of the feed-forward": DIT + r"ff\.net\.0\.proj\.weight",
    "head: second": DIT + r"ff\.net\.2\.weight",
    "all weights of the backbone": r"(?!.*action_head\.).*weight",
    "all weights of the head": r".*action_head\..*weight",
    "all": r".*",
}


def measure(model: Model, folders: dict[str, Path], work: Path, note: Note) -> dict[str, dict[str, float]]:
    """The error of actions by group and way to round. Inputs of layers stay exact."""
    exact = read_tensors(model.checkpoint)
    actions, _ = results_of(model.policy(), model.measured)
    found: dict[str, dict[str, float]] = {}
    for kind, folder in folders.items():
        rounded = read_tensors(folder)
        names = [tensor.name for tensor in describe(folder).tensors if tensor.dtype == "U8"]
        for group, pattern in GROUPS.items():
            of_group = [name for name in names if re.fullmatch(pattern, name)]
            if not of_group:
                continue
            # An odd number of weights is followed by a zero that fills the last byte.
            changed = {name: rounded[name][:, : exact[name].shape[1]] for name in of_group}
            mixed = _written(model.checkpoint, work / "mixed", exact | changed)
            errors = found.setdefault(group, {})
            errors[kind] = error(results_of(model.policy(mixed), model.measured)[0], actions)
            note(f"{model.name}: {group}, {len(of_group)} weights, {kind} {errors[kind]:.2e}")
    shutil.rmtree(work / "mixed", ignore_errors=True)
    return found


def _written(
    source: Path, folder: Path, tensors: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]]
) -> Path:
    """A copy of a checkpoint with other values."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("*.safetensors*"))
    save_file(
        {name: np.ascontiguousarray(values) for name, values in tensors.items()}, folder / "model.safetensors"
    )
    return folder
