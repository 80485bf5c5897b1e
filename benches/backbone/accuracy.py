"""The error of the features at N1.5's width against the reference in float64, with and without outliers.

The vocabulary is small, because a row of the table is copied and not multiplied, so that float64 needs 8 GB.
"""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import Any

import numpy as np

from benches.backbone import setup
from benches.checkpoints import written
from saccade._internal.arrays import Float32Array
from saccade_lab import random_checkpoint
from saccade_lab.published import CONFIGS, RELEASED

MODELS = {"plain": False, "outliers": True}

#: What computes: the reference in float32, saccade's precisions, transformers in bfloat16.
RUNS = ("reference-float32", "saccade-float32", "saccade-bfloat16", "saccade-int8", "transformers-bfloat16")


def checkpoint(work: Path, *, outliers: bool, layers: tuple[int, int] | None, small: bool) -> Path:
    """A checkpoint at full width, written if it is not there.

    Args:
        work: folder of the checkpoints.
        outliers: plants them.
        layers: of the vision tower and of the language model. Default: the published ones.
        small: small sizes, for a quick trial.
    """
    config = random_checkpoint.small_backbone("n1.5")
    head = random_checkpoint.small_head("n1.5")
    if not small:
        released = RELEASED["n1.5"]
        vocabulary = config["text_config"]["vocab_size"]
        config["text_config"] = {**released["text_config"], "vocab_size": vocabulary}
        config |= {"vision_config": released["vision_config"], "select_layer": released["select_layer"]}
        full = CONFIGS["n1.5"]
        for key in ("backbone_embedding_dim", "vl_self_attention_cfg"):
            head[key] = full[key]
        head["vl_self_attention_cfg"] = {**head["vl_self_attention_cfg"], "num_layers": 1}
        head["diffusion_model_cfg"]["cross_attention_dim"] = full["backbone_embedding_dim"]
    name = f"accuracy-{'outliers' if outliers else 'plain'}{'-small' * small}"
    if layers is not None:
        config["vision_config"] = {**config["vision_config"], "num_hidden_layers": layers[0]}
        config["select_layer"] = layers[1]
        name += f"-{layers[0]}-{layers[1]}"
    return written(work / name, backbone=config, head=head, outliers=outliers)


def measure(folder: Path, views: int, note: Any) -> dict[str, Any]:
    """The errors of each run: `largest` over the largest feature, `rms` over that of the features, `worst`:
    the largest over the tokens of the rms error over the rms of the token.
    """
    exact = features_of(folder, "reference-float64", views)
    found: dict[str, Any] = {}
    for run in RUNS:
        note(f"{folder.name}: {run}")
        try:
            error = features_of(folder, run, views).astype(np.float64) - exact
        except Exception as problem:
            found[run] = {"failed": f"{type(problem).__name__}: {problem}"}
            continue
        found[run] = {
            "largest": float(np.abs(error).max() / np.abs(exact).max()),
            "rms": rms(error) / rms(exact),
            "worst": float((rms(error, axis=-1) / rms(exact, axis=-1)).max()),
        }
    return found


def rms(values: Any, axis: int | None = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.square(values).mean(axis=axis))


def features_of(folder: Path, run: str, views: int) -> Float32Array:
    """The features of one run, in a process of its own, whose memory is free again behind it."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        features: Float32Array = pool.apply(_features, (folder, run, views))
    return features


def _features(folder: Path, run: str, views: int) -> Any:
    sizes = setup.sizes_of(folder)
    inputs = setup.inputs_of(sizes, views)
    engine, precision = run.split("-")
    if engine == "saccade":
        import saccade

        return np.asarray(
            saccade.Backbone.from_pretrained(folder, precision=precision)(inputs).backbone_features
        )
    import torch

    dtype = getattr(torch, precision)
    with torch.inference_mode():
        if engine == "reference":
            from saccade_lab.reference import Backbone

            return Backbone.from_pretrained(folder, dtype=dtype)(inputs).backbone_features.numpy()
        from benches.backbone import peer

        return peer.Peer.load(folder, sizes, dtype)(*peer.arguments(inputs, dtype)).float().numpy()
