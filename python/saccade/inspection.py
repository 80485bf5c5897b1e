"""What is in a checkpoint: sizes, parts, memory, expected time, embodiments, future tokens, what is odd.

One tensor, or one embodiment's slice of it, is in memory at a time.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from saccade import _saccade
from saccade._arrays import Float32Array, integer
from saccade.bench.cost import PRECISIONS, Machine, predict
from saccade.bench.work import Call
from saccade.checkpoints import Config, Source, facts, open_published
from saccade.config import HeadConfig
from saccade.errors import InputError, SaccadeError
from saccade.initialisation import NORMAL_STD, Draw, distance, draw, is_as_drawn, is_norm, sample
from saccade.robot_statistics import EMBODIMENTS, read_json

#: Parts of a head in the order of the specification's table, with what their tensors' names begin with.
PARTS = {
    "DiT blocks": "model.transformer_blocks.",
    "timestep encoder": "model.timestep_encoder.",
    "output projections": "model.proj_out_",
    "VL self-attention": "vl_self_attention.",
    "vlln": "vlln.",
    "state encoder": "state_encoder.",
    "action encoder": "action_encoder.",
    "action decoders": "action_",
    "future tokens": "future_tokens.",
    "positions": "position_embedding.",
}
#: Tensors that only training uses.
UNUSED = "training only"

#: Embodiments of N1.7, as lerobot and Isaac-GR00T number them.
N17_EMBODIMENTS = {
    "simpler_env_google": 0,
    "simpler_env_widowx": 1,
    "libero_sim": 2,
    "new_embodiment": 10,
    "oxe_droid_relative_eef_relative_joint": 24,
    "real_g1_relative_eef_relative_joints": 25,
    "real_r1_pro_sharpa_relative_eef": 26,
    "xdof_relative_eef_relative_joint": 27,
}
#: Of N1.5, those that NVIDIA's published checkpoint was trained with.
PRETRAINED = ("gr1", "agibot_genie1", "oxe_droid")

#: Groups of equal tokens that are named one by one.
SHOWN = 4

#: A median absolute deviation times this is the standard deviation of normal numbers.
MAD_TO_STD = 1.4826

#: Cosines of a checkpoint's tensors and of those that they were trained from are far above, of unrelated ones
#: far below.
RELATED = 0.5


def part_of(name: str) -> str:
    """The part that a tensor belongs to, by its name without prefix."""
    found = (part for part, start in PARTS.items() if name.startswith(start))
    return next(found, UNUSED)


def parameters(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, dict[str, int]]:
    """Tensors and parameters by part; those that are not there are left out.

    Args:
        shapes: of a head's tensors, by their names without prefix.

    Returns:
        ``{"DiT blocks": {"tensors": 224, "parameters": 541335552}, ...}``.
    """
    counted = {part: {"tensors": 0, "parameters": 0} for part in (*PARTS, UNUSED)}
    for name, shape in shapes.items():
        counted[part_of(name)]["tensors"] += 1
        counted[part_of(name)]["parameters"] += math.prod(shape)
    return {part: counts for part, counts in counted.items() if counts["tensors"]}


def inspect(
    source: Source,
    *,
    config: Config = None,
    reference: Source | None = None,
    num_vl_tokens: int = 296,
    time: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> dict[str, Any]:
    """Everything that ``saccade inspect`` shows.

    Args:
        source: As for :meth:`saccade.ActionHead.load`.
        config: As there.
        reference: A checkpoint to compare with, tensor by tensor; say, the one that ``source`` was trained
            from.
        num_vl_tokens: T_vl of the expected times; 296 is what one camera makes in N1.5.
        time: Whether to expect times; measuring what this CPU can do takes about a second.
        progress: Called with bytes done and bytes in all.

    Returns:
        Numbers, strings, lists and dicts as JSON has them. Beside what
        :func:`saccade.checkpoints.describe` returns:

        - ``parts``: as :func:`parameters`, with ``nbytes`` and ``dtypes`` (tensors by type) in the file, and
          ``as_drawn``, how many of its ``judged`` tensors are distributed as before any training
          (:mod:`saccade.initialisation`). ``parameters`` of the whole head; ``outside``, what is beside it.
        - ``memory``: by precision, ``all`` and ``one``: bytes of weights with every embodiment and with one.
        - ``seconds``: by precision, ``encode`` and ``sample``, expected on the ``machine`` that was measured;
          None without ``time``.
        - ``embodiments``: for each ``id`` its ``names``, ``norm`` of its layers' weights and biases,
          ``robust_z`` of that against all ids (distance from the median in units of 1.4826 median absolute
          deviations; None where these do not differ), and ``looks``: ``"zero"``, ``"as initialised"`` (biases
          zero, weights as drawn) or ``"trained"``.
        - ``future_tokens``: see :func:`token_statistics`; None without tokens.
        - ``reference``: by part, how alike the two are; None without.
        - ``odd``: sentences about what is unusual.
        - ``from_noise``: ``for``, ``against`` and ``neither``: sentences that speak for or against "this
          checkpoint was trained from a random start, although it was meant to start from a pretrained one".
          Not a verdict.

    Raises:
        FileNotFoundError, CheckpointError: as :meth:`saccade.ActionHead.load`.
        InputError: ``num_vl_tokens`` is not an integer of at least 1; ``reference`` is of another version.
    """
    num_vl_tokens = integer("num_vl_tokens", num_vl_tokens)
    published = open_published(source, config)
    published.check()
    report = facts(published, source)
    head = HeadConfig(**report["config"])
    other = None if reference is None else Other(reference)
    if other is not None and other.version != head.version:
        raise InputError(
            f"reference: {os.fspath(other.source)} is of GR00T {other.version.upper()}, expected "
            f"{head.version.upper()} as the source: no training leads from one to the other"
        )
    survey = Survey(published, head, other, progress)
    report["parts"] = survey.parts()
    report["parameters"] = sum(part["parameters"] for part in report["parts"].values())
    report["outside"] = outside(report)
    report["memory"] = {
        precision: {
            "all": published.nbytes(precision, head.num_embodiments),
            "one": published.nbytes(precision, 1),
        }
        for precision in PRECISIONS
    }
    report["num_vl_tokens"] = num_vl_tokens
    report["machine"], report["seconds"] = expected_times(head, num_vl_tokens) if time else (None, None)
    report["embodiments"] = survey.embodiments(embodiment_names(report))
    report["future_tokens"] = survey.future_tokens()
    report["reference"] = None if other is None else {"source": os.fspath(other.source), **other.summary()}
    report["odd"] = survey.odd + odd_of_tokens(report) + odd_of_embodiments(report)
    report["from_noise"] = from_noise(report)
    return report


def outside(report: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Tensors and bytes of what is beside the head, by the first word of the name."""
    counted: dict[str, dict[str, int]] = {}
    for tensor in report["tensors"]:
        if tensor["name"].startswith(report["prefix"]):
            continue
        module = tensor["name"].removeprefix("_groot_model.").partition(".")[0]
        counts = counted.setdefault(module, {"tensors": 0, "nbytes": 0})
        counts["tensors"] += 1
        counts["nbytes"] += tensor["nbytes"]
    return counted


def expected_times(head: HeadConfig, num_vl_tokens: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """What this CPU can do, measured now, and what `saccade.bench.cost` expects of a chunk on it."""
    machine = Machine.measured(_saccade.selected_isa(), _saccade.default_num_threads())
    call = Call.of(head, num_vl_tokens)
    seconds = {precision: predict(head, call, precision, machine) for precision in PRECISIONS}
    measured = {
        "isa": machine.isa,
        "num_threads": machine.num_threads,
        "macs_per_second": dict(machine.macs_per_second),
        "read_bytes_per_second": machine.read_bytes_per_second,
    }
    return measured, seconds


def embodiment_names(report: Mapping[str, Any]) -> dict[int, list[str]]:
    """What each id is called, by the files beside the weights and by the code bases."""
    path = Path(report["source"])
    first = report["files"][0]["path"] if report["files"] else path
    folder = path if path.is_dir() else Path(first).parent
    known = {"n1.7": N17_EMBODIMENTS, "n1.6": {}}.get(report["version"], EMBODIMENTS)
    names: dict[int, list[str]] = {}
    for name, index in (_mapping(folder) or known).items():  # what the checkpoint says of itself holds
        names.setdefault(index, []).append(name)
    return names


def _mapping(folder: Path) -> dict[str, int]:
    """Names and ids in `embodiment_id.json`, or in lerobot's processors; empty without."""
    for name in ("embodiment_id.json", "policy_preprocessor.json"):
        try:
            values: Any = read_json(folder / name)
        except (OSError, SaccadeError):
            continue
        if name == "policy_preprocessor.json":
            steps = values.get("steps")
            configs = [step.get("config") for step in steps or () if isinstance(step, dict)]
            mappings = [config.get("embodiment_mapping") for config in configs if isinstance(config, dict)]
            values = next(filter(None, mappings), {})
        if isinstance(values, dict):
            return {tag: index for tag, index in values.items() if isinstance(index, int)}
    return {}


@dataclass
class Piece:
    """A tensor, or one embodiment's slice of it, while it is in memory."""

    name: str
    embodiment: int | None
    values: Float32Array
    drawn: Draw | None
    """None where its distribution is not compared: what only training uses, and int8."""


@dataclass
class Part:
    """What is counted of a part."""

    tensors: int = 0
    parameters: int = 0
    nbytes: int = 0
    dtypes: dict[str, int] = field(default_factory=dict)
    judged: int = 0
    as_drawn: int = 0


class Survey:
    """One pass over the head's tensors."""

    def __init__(
        self,
        published: _saccade.Published,
        head: HeadConfig,
        other: Other | None,
        progress: Callable[[int, int], object] | None,
    ) -> None:
        self._published = published
        self._head = head
        self._prefix = published.prefix
        self._parts: dict[str, Part] = {}
        self._squares = np.zeros(head.num_embodiments)
        self._biases_zero = np.ones(head.num_embodiments, bool)
        self._weights_drawn = np.ones(head.num_embodiments, bool)
        self._tokens: Float32Array | None = None
        self.odd: list[str] = []
        tensors = [tensor for tensor in published.tensors() if tensor[0].startswith(self._prefix)]
        done, total = 0, sum(nbytes for *_, nbytes in tensors)
        self._shapes = {name.removeprefix(self._prefix): tuple(shape) for name, _, shape, _ in tensors}
        for full_name, dtype, shape, nbytes in tensors:
            name = full_name.removeprefix(self._prefix)
            part = self._parts.setdefault(part_of(name), Part())
            part.tensors += 1
            part.parameters += math.prod(shape)
            part.nbytes += nbytes
            part.dtypes[dtype] = part.dtypes.get(dtype, 0) + 1
            judged = [self._look(piece) for piece in self._pieces(name, dtype, tuple(shape), other)]
            if judged and None not in judged:
                part.judged += 1
                part.as_drawn += all(judged)
            done += nbytes
            if progress is not None:
                progress(done, total)

    def _pieces(self, name: str, dtype: str, shape: tuple[int, ...], other: Other | None) -> Iterator[Piece]:
        full_name = self._prefix + name
        drawn = None if dtype == "I8" or part_of(name) == UNUSED else draw(name, self._inputs(name, shape))
        if name.endswith("_scale"):
            drawn = None
        is_category = name.endswith((".W", ".b"))
        indices: list[int | None] = list(range(shape[0])) if is_category else [None]
        for index in indices:
            piece = Piece(name, index, self._published.read(full_name, index), drawn)
            if other is not None:
                other.compare(piece)
            yield piece

    def _inputs(self, name: str, shape: tuple[int, ...]) -> int:
        """Inputs of the linear layer that a weight or bias belongs to."""
        module, _, kind = name.rpartition(".")
        if kind == "bias" and not is_norm(name):
            return self._shapes[f"{module}.weight"][1]
        return shape[1] if len(shape) == 2 else 1

    def _look(self, piece: Piece) -> bool | None:
        """Takes what is to be known of a piece; whether it is as drawn, None where that is not told."""
        values, name = piece.values, piece.name
        where = name if piece.embodiment is None else f"{name}[{piece.embodiment}]"
        squares = sum_of_squares(values)
        if not math.isfinite(squares):
            count = int(np.sum(~np.isfinite(values)))
            self.odd.append(f"{where} holds {count} numbers that are NaN or infinite")
            return False
        is_weight = not name.endswith((".b", ".bias")) and piece.drawn is not None
        if piece.embodiment is None and is_weight and values.size > 1 and not is_norm(name):
            low, high = float(values.min()), float(values.max())
            if low == high:
                self.odd.append(f"{where} is {low:g} throughout")
        if name == "future_tokens.weight":
            self._tokens = values
        as_drawn = None if piece.drawn is None else is_as_drawn(sample(values), piece.drawn)
        if piece.embodiment is not None:
            self._squares[piece.embodiment] += squares
            if name.endswith(".b"):
                self._biases_zero[piece.embodiment] &= squares == 0.0
            else:
                self._weights_drawn[piece.embodiment] &= as_drawn is not False
        return as_drawn

    def parts(self) -> dict[str, dict[str, Any]]:
        """By part, in the order of `PARTS`."""
        return {name: vars(self._parts[name]) for name in (*PARTS, UNUSED) if name in self._parts}

    def embodiments(self, names: Mapping[int, list[str]]) -> list[dict[str, Any]]:
        """One entry an id."""
        norms = np.sqrt(self._squares)
        scores = robust_z(norms)
        return [
            {
                "id": index,
                "names": names.get(index, []),
                "norm": float(norms[index]),
                "robust_z": None if scores is None else float(scores[index]),
                "looks": (
                    "zero"
                    if norms[index] == 0.0
                    else "as initialised"
                    if self._biases_zero[index] and self._weights_drawn[index]
                    else "trained"
                ),
            }
            for index in range(self._head.num_embodiments)
        ]

    def future_tokens(self) -> dict[str, Any] | None:
        """Their statistics; None where there are none."""
        if self._tokens is None or self._tokens.shape[0] == 0:
            return None
        bias = self._head.future_key_bias
        return {**token_statistics(self._tokens), "key_bias": None if bias is None else list(bias)}


def sum_of_squares(values: Float32Array) -> float:
    """In float64."""
    return dot(values, values)


def robust_z(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
    """Distances from the median in units of 1.4826 median absolute deviations; None where that is zero."""
    centre = np.median(values)
    spread = MAD_TO_STD * float(np.median(np.abs(values - centre)))
    return None if spread == 0.0 else (values - centre) / spread


def token_statistics(tokens: Float32Array) -> dict[str, Any]:
    """Whether future tokens are distinct, and how far they are from how they are drawn.

    Args:
        tokens: ``(N, width)``.

    Returns:
        ``count``; ``norm`` and ``cosine`` of pairs (``mean``, ``min``, ``max``); ``effective_rank``, the
        exponential of the entropy of the singular values' shares (Roy and Vetterli, 2007), from 1 to N;
        ``std`` of all numbers; ``distance`` from N(0, 0.02) (:func:`saccade.initialisation.distance`) and
        ``as_drawn``; ``identical``: lists of tokens that are equal; ``zero``: tokens that are zero. Then
        ``drawn``: norm, cosine and effective rank of one seeded draw of this shape, to compare with.
    """
    drawn = NORMAL_STD * np.random.default_rng(0).standard_normal(tokens.shape, np.float32)
    values, fresh = sample(tokens), Draw("normal", NORMAL_STD)
    _, index, counts = np.unique(tokens, axis=0, return_inverse=True, return_counts=True)
    groups = [np.flatnonzero(index.reshape(-1) == group).tolist() for group in np.flatnonzero(counts > 1)]
    groups.sort()
    return {
        "count": tokens.shape[0],
        **shape_of_tokens(tokens),
        "std": float(np.std(tokens, dtype=np.float64)),
        "distance": distance(values, fresh),
        "as_drawn": is_as_drawn(values, fresh),
        "identical": groups,
        "zero": np.flatnonzero(~tokens.any(axis=1)).tolist(),
        "drawn": shape_of_tokens(drawn),
    }


def shape_of_tokens(tokens: Float32Array) -> dict[str, Any]:
    """Norms, cosines of pairs, effective rank."""
    wide = tokens.astype(np.float64)
    norms = np.linalg.norm(wide, axis=1)
    unit = wide / np.where(norms == 0.0, 1.0, norms)[:, None]
    cosines = (unit @ unit.T)[np.triu_indices(len(unit), 1)]
    values = np.linalg.svd(wide, compute_uv=False)
    shares = values[values > 0.0] / max(float(values.sum()), np.finfo(np.float64).tiny)
    return {
        "norm": summary(norms),
        "cosine": summary(cosines),
        "effective_rank": float(np.exp(-np.sum(shares * np.log(shares)))) if shares.size else 0.0,
    }


def summary(values: np.ndarray[Any, Any]) -> dict[str, float] | None:
    """Mean, minimum and maximum; None of nothing."""
    if values.size == 0:
        return None
    return {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}


class Other:
    """A reference checkpoint, compared piece by piece."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self._published = open_published(source)
        self.version: str = self._published.config()["version"]
        self._shapes = {name: tuple(shape) for name, _, shape, _ in self._published.tensors()}
        self._parts: dict[str, dict[str, Any]] = {}
        self._different: list[str] = []
        self._lacks: list[str] = []

    def compare(self, piece: Piece) -> None:
        """Counts a piece as identical, related or unrelated to the reference's."""
        name = self._published.prefix + piece.name
        shape = self._shapes.get(name)
        own = piece.values.shape
        if shape is None:
            self._lacks += [piece.name] if not piece.embodiment else []
            return
        if piece.embodiment is not None and piece.embodiment >= shape[0]:
            return
        if shape[0 if piece.embodiment is None else 1 :] != own:
            if not piece.embodiment:
                self._different.append(f"{piece.name}: {own}, in the reference {shape}")
            return
        theirs = self._published.read(name, piece.embodiment)
        drawn = piece.drawn
        if drawn is not None and drawn.kind == "constant" and np.all(theirs == drawn.scale):
            return  # as every checkpoint has it
        part = self._parts.setdefault(
            part_of(piece.name), {"pieces": 0, "identical": 0, "cosines": [], "change": 0.0}
        )
        part["pieces"] += 1
        if np.array_equal(piece.values, theirs):
            part["identical"] += 1
        elif piece.values.size > 1 and not piece.name.endswith((".b", ".bias")) and not is_norm(piece.name):
            mine, norm = np.sqrt(sum_of_squares(piece.values)), np.sqrt(sum_of_squares(theirs))
            if mine > 0.0 and norm > 0.0:
                part["cosines"].append(dot(piece.values, theirs) / float(mine * norm))
                change = np.sqrt(sum_of_squares(piece.values - theirs)) / norm
                part["change"] = max(part["change"], float(change))

    def summary(self) -> dict[str, Any]:
        """By part; `pieces` are tensors, slices of embodiments counted one by one, without biases and norms
        that the reference has as initialised."""
        return {
            "different_shapes": self._different,
            "not_in_reference": self._lacks,
            "parts": {
                name: {
                    "pieces": part["pieces"],
                    "identical": part["identical"],
                    "cosine": summary(np.array(part["cosines"])),
                    "largest_change": part["change"],
                }
                for name, part in ((name, self._parts.get(name)) for name in (*PARTS, UNUSED))
                if part is not None
            },
        }


def dot(a: Float32Array, b: Float32Array) -> float:
    """Of all elements, in float64, a megabyte or so at a time; by one thread, since reading takes longer."""
    a, b = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for first in range(0, a.size, 1 << 17):
        piece = slice(first, first + (1 << 17))
        total += float(np.einsum("i,i->", a[piece].astype(np.float64), b[piece].astype(np.float64)))
    return total


def odd_of_tokens(report: Mapping[str, Any]) -> list[str]:
    """What is unusual about the future tokens."""
    tokens = report["future_tokens"]
    if tokens is None:
        # Tokens that are not finite are told of as such.
        has_none = report["version"] == "n1.5" and report["config"]["num_future_tokens"] == 0
        return ["a head of N1.5 without future tokens"] if has_none else []
    groups = [", ".join(map(str, group)) for group in tokens["identical"]]
    odd = [f"future tokens {group} are identical" for group in groups[:SHOWN]]
    if len(groups) > SHOWN:
        odd.append(f"and so are those of {len(groups) - SHOWN} more groups")
    odd += [f"future token {index} is zero" for index in tokens["zero"]]
    if tokens["key_bias"] is not None:
        odd.append("the keys of the future tokens have a bias that only saccade applies")
    return odd


def odd_of_embodiments(report: Mapping[str, Any]) -> list[str]:
    """What is unusual about the layers of the embodiments."""
    ids = [str(entry["id"]) for entry in report["embodiments"] if entry["looks"] == "zero"]
    if not ids:
        return []
    return [f"the layers of {len(ids)} embodiments are zero, as after convert with others: {', '.join(ids)}"]


def from_noise(report: Mapping[str, Any]) -> dict[str, list[str]]:
    """Sentences for and against "trained from a random start"; what they rest on is in the report."""
    found: dict[str, list[str]] = {"for": [], "against": [], "neither": []}
    for name in ("DiT blocks", "VL self-attention", "timestep encoder", "output projections"):
        part = report["parts"].get(name)
        if part is None or not part["judged"]:
            continue
        share = part["as_drawn"] / part["judged"]
        side = "for" if share > 0.5 else "against" if share < 0.05 else "neither"
        found[side].append(
            f"{name}: {part['as_drawn']} of {part['judged']} tensors are distributed as before any training"
        )
    tokens = report["future_tokens"]
    if tokens is not None:
        side = {True: "for", False: "against", None: "neither"}[tokens["as_drawn"]]
        told = {"for": "not told from", "against": "not", "neither": "too few to be told from"}[side]
        found[side].append(
            f"future tokens: {told} N(0, {NORMAL_STD}), distance {tokens['distance']:.3f}, "
            f"standard deviation {tokens['std']:.4f}"
        )
        if tokens["count"] != 32:
            found["neither"].append(
                f"{tokens['count']} future tokens, where published checkpoints have 32: a loader that "
                "forgives no shape drops such a checkpoint, or one of 32 where the model has "
                f"{tokens['count']}"
            )
    if report["version"] == "n1.5" and len(report["embodiments"]) == 32:
        for name in PRETRAINED:
            entry = report["embodiments"][EMBODIMENTS[name]]
            if entry["looks"] == "zero":
                continue
            side = "for" if entry["looks"] == "as initialised" else "against"
            found[side].append(
                f"embodiment {entry['id']} ({name}), which NVIDIA trained: layers look {entry['looks']}"
            )
    if report["reference"] is not None:
        for name, part in report["reference"]["parts"].items():
            side, what = likeness(part)
            found[side].append(f"{name} beside the reference: {what}")
        for shapes in report["reference"]["different_shapes"]:
            found["neither"].append(f"another shape than the reference's: {shapes}")
    return found


def likeness(part: Mapping[str, Any]) -> tuple[str, str]:
    """Which side a part's likeness to the reference is on, and why."""
    identical, pieces, cosine = part["identical"], part["pieces"], part["cosine"]
    same = f"{identical} of {pieces} tensors and slices are identical"
    if cosine is None:
        return ("against" if identical else "neither"), same
    others = f"cosines of the other weights from {cosine['min']:.3f} to {cosine['max']:.3f}"
    if cosine["mean"] > RELATED or identical * 2 > pieces:
        return "against", f"{same}, {others}"
    return ("for" if cosine["max"] < RELATED else "neither"), f"{same}, {others}"
