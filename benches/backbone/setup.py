"""The inputs and the expected features that all sections share."""

from __future__ import annotations

import json
import multiprocessing
from pathlib import Path

import numpy as np

from saccade import BackboneInputs
from saccade._internal.arrays import Float32Array
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.random_checkpoint.tokenizer import FIRST_ADDED, WORDS, token_id

#: Words of the prompt around the views, as N1.5's template puts them; "Ċ" is a new line.
SYSTEM = (
    "<|im_start|>",
    "system",
    "Ċ",
    "You",
    "Ġare",
    "Ġa",
    "Ġhelpful",
    "Ġassistant",
    ".",
    "<|im_end|>",
    "Ċ",
)
USER = ("<|im_start|>", "user", "Ċ")
INSTRUCTION = ("['", "open", "Ġthe", "Ġdrawer", "']", "<|im_end|>", "Ċ", "<|im_start|>", "assistant", "Ċ")
INSTRUCTION_TEXT = "open the drawer"


def sizes_of(folder: Path) -> BackboneSizes:
    """The sizes of a checkpoint's backbone."""
    return BackboneSizes.from_config(json.loads((folder / "config.json").read_text()))


def inputs_of(sizes: BackboneSizes, views: int, seed: int = 0) -> BackboneInputs:
    """The inputs of one observation of an N1.5 backbone: noisy frames and the released prompt."""
    published = sizes.text.vocabulary > FIRST_ADDED
    num_tokens = sizes.vision.num_positions // sizes.merge**2
    words: list[str] = [*SYSTEM, *USER]
    for view in range(1, views + 1):
        words += ["<", "image", "Ġ", str(view), ">", "<img>", *["<IMG_CONTEXT>"] * num_tokens, "</img>"]
    words += INSTRUCTION
    ids = {word: token_id(word, published_ids=published) for word in dict.fromkeys(words)}
    assert published is False or all(ids[word] == WORDS[word] for word in ids if word in WORDS)
    return BackboneInputs(pixels(sizes, views, seed), [[ids[word] for word in words]])


def pixels(sizes: BackboneSizes, views: int, seed: int) -> Float32Array:
    """Normalised frames, `(views, 3, side, side)`: waves and noise, as bright as photographs."""
    side = round(sizes.vision.num_positions**0.5) * sizes.vision.patch_size
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:side, :side] / side
    frames = []
    for _ in range(views):
        waves = [np.sin(2 * np.pi * (a * x + b * y + c)) for a, b, c in rng.uniform(-4, 4, (3, 3))]
        frames.append(np.stack(waves) * 0.5 + 0.1 * rng.standard_normal((3, side, side)))
    levels = np.clip(np.round(127.5 + 127.5 * np.array(frames)), 0, 255)
    return ((levels - 127.5) / 127.5).astype(np.float32)


def expected(folder: Path, views: int, work: Path) -> Float32Array:
    """The features of `inputs_of` by the reference in float32, computed once in a process of its own."""
    path = work / f"expected-{folder.name}-{views}.npy"
    if not path.is_file():
        work.mkdir(parents=True, exist_ok=True)
        process = multiprocessing.get_context("spawn").Process(
            target=_write_expected, args=(folder, views, path)
        )
        process.start()
        process.join()
        if process.exitcode != 0:
            raise SystemExit("benches.backbone: the reference could not be computed")
    features: Float32Array = np.load(path)
    return features


def _write_expected(folder: Path, views: int, path: Path) -> None:
    import torch

    from saccade_lab.reference import Backbone

    with torch.inference_mode():
        features = Backbone.from_pretrained(folder)(inputs_of(sizes_of(folder), views)).backbone_features
    np.save(path, features.numpy())
