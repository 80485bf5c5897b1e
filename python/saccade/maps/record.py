"""All that is known about one observation: traces, summaries, occlusion; what the sheet and the page show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

import saccade
from saccade._files import sha256_of
from saccade.checkpoints import read_tensors
from saccade.config import HeadConfig
from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.intervention import ROW_GROUPS, Intervention
from saccade.maps.inputs import Inputs
from saccade.maps.occlusion import Occlusion
from saccade.maps.summary import Overlap, overlap, summarize

Float32Array = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]
#: The maps of one Euler step and block, `(heads, rows, keys)`.
Attention = Mapping[tuple[int, int], Float32Array]

CAVEAT = (
    "A bright patch is a position that is read, not a cause. After the backbone and the VL self-attention a "
    "position holds more than its patch, so what is read there need not come from that patch of the picture."
)
BESIDE = "The occlusion map beside it shows what the actions depend on."
FUTURE_TOKENS = "future_tokens."
PREFIXES = ("action_head.", "_groot_model.action_head.", "")  # those that ActionHead.load knows
MEAN = "mean"


@dataclass(frozen=True)
class Selection:
    """Which maps are wanted.

    Attributes:
        blocks, steps: Of the DiT and of the Euler loop.
        heads: Those that the mean is taken over.
        shown_heads: Those of them that are shown one by one as well.
    """

    blocks: tuple[int, ...]
    steps: tuple[int, ...]
    heads: tuple[int, ...]
    shown_heads: tuple[int, ...]


@dataclass(frozen=True)
class Maps:
    """One observation and what the head's rows look at.

    Attributes:
        checkpoint: Where the head was loaded from, and its hash.
        config: Of the head.
        inputs: The observation.
        selection: Which maps.
        rows: Where the groups lie; a group without rows is left out.
        attention: By step and block, `(heads, rows, keys)`, heads in the selection's order.
        redrawn: The same with future tokens drawn at random, only the future rows; None without future
            tokens.
        occlusion: None if there are no image tokens.
    """

    checkpoint: dict[str, str]
    config: HeadConfig
    inputs: Inputs
    selection: Selection
    rows: dict[str, slice]
    attention: Attention
    redrawn: Attention | None
    occlusion: Occlusion | None

    @property
    def caveat(self) -> str:
        """What has to be said with every map."""
        return CAVEAT if self.occlusion is None else f"{CAVEAT} {BESIDE}"

    @property
    def num_future_tokens(self) -> int:
        """N."""
        return self.config.num_future_tokens

    def reads_vl(self, block: int) -> bool:
        """Whether a block reads the vision-language tokens; otherwise it reads the rows."""
        return reads_vl(self.config, block)

    def cross_blocks(self) -> list[int]:
        """Chosen blocks that read the vision-language tokens."""
        return [block for block in self.selection.blocks if self.reads_vl(block)]

    def self_blocks(self) -> list[int]:
        """Chosen blocks that read the rows."""
        return [block for block in self.selection.blocks if not self.reads_vl(block)]

    def mean(self, block: int, step: int | None = None) -> Float32Array:
        """The mean over heads, and over steps unless one is given, `(rows, keys)`."""
        steps = self.selection.steps if step is None else (step,)
        mean: Float32Array = np.mean(
            [self.attention[one, block].mean(axis=0) for one in steps], axis=0, dtype=np.float32
        )
        return mean

    def parts(self, block: int) -> dict[str, Indices]:
        """The block's keys by what they are: cameras and kinds of tokens, or groups of rows."""
        return self.inputs.layout.parts() if self.reads_vl(block) else self._row_parts()

    def agreement(self, keys: Float32Array) -> float | None:
        """Spearman's rank correlation over all patches between a map `(T_vl,)` and the occlusion map.

        None where there are no image tokens, or where one of the two is the same everywhere.
        """
        if self.occlusion is None:
            return None
        cameras = self.inputs.layout.cameras
        read = np.concatenate([keys[camera.positions] for camera in cameras])
        change = np.concatenate([self.occlusion.change[camera.name].ravel() for camera in cameras])
        if np.ptp(read) == 0 or np.ptp(change) == 0:
            return None
        return float(np.corrcoef(rankdata(read), rankdata(change))[0, 1])

    def agreements(self) -> list[dict[str, Any]]:
        """`agreement` of each group's mean map over heads and Euler steps, in the blocks that read vision."""
        return [
            {
                "block": block,
                "group": group,
                "rank_correlation": self.agreement(self.mean(block)[rows].mean(axis=0)),
            }
            for block in self.cross_blocks()
            for group, rows in self.rows.items()
        ]

    def _row_parts(self) -> dict[str, Indices]:
        return {name: np.arange(rows.start, rows.stop) for name, rows in self.rows.items()}

    @cached_property
    def summaries(self) -> list[dict[str, Any]]:
        """One entry for each step, block, group and head, the mean map of all heads first.

        The entry of the mean map has `per_head`: entropy and overlap of each head's own maps, averaged over
        the heads. Heads that look at different places make a wide mean map though each of them is narrow.
        """
        rng = np.random.default_rng(0)
        entries = []
        for (step, block), attention in self.attention.items():
            parts = self.parts(block)
            within = self.inputs.layout.kinds() if self.reads_vl(block) else parts
            for group, rows in self.rows.items():
                redrawn = (
                    self.redrawn[step, block] if group == "future" and self.redrawn is not None else None
                )
                heads: list[tuple[str | int, int | None]] = [(MEAN, None)]
                heads += [(head, place) for place, head in enumerate(self.selection.heads)]
                found = []
                for head, place in heads:
                    maps = (attention.mean(axis=0) if place is None else attention[place])[rows]
                    entry = {
                        "step": step,
                        "block": block,
                        "reads": "vl" if self.reads_vl(block) else "rows",
                        "group": group,
                        "head": head,
                        **asdict(summarize(maps, parts, within, rng)),
                    }
                    if redrawn is not None:
                        other = redrawn.mean(axis=0) if place is None else redrawn[place]
                        entry["redrawn"] = _asdict(overlap(other))
                    found.append(entry)
                found[0]["per_head"] = _per_head(found[1:])
                entries += [found[0]] + [e for e in found[1:] if e["head"] in self.selection.shown_heads]
        return entries

    def to_dict(self) -> dict[str, Any]:
        """`attention.json`."""
        return {
            "saccade": saccade.__version__,
            "checkpoint": self.checkpoint,
            "source": self.inputs.source,
            "num_future_tokens": self.num_future_tokens,
            "rows": {name: [rows.start, rows.stop] for name, rows in self.rows.items()},
            "selection": asdict(self.selection),
            "layout": self.inputs.layout.to_dict(),
            "caveat": self.caveat,
            "baselines": BASELINES,
            "occlusion": None if self.occlusion is None else self.occlusion.to_dict(),
            "agreement": self.agreements(),
            "summaries": self.summaries,
        }


BASELINES = {
    "identical": "tokens with the same map: divergence 0, cosine 1, 1 distinct map",
    "shuffled": "each token's map shuffled on its own among the keys of one kind: the same spread, unrelated "
    "places",
    "redrawn": "future tokens replaced by random directions of the learned tokens' lengths",
}


def _asdict(found: Overlap | None) -> dict[str, float] | None:
    return None if found is None else asdict(found)


def _per_head(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over the heads of what each head's own maps give."""
    means: dict[str, Any] = {"entropy": float(np.mean([entry["entropy"]["mean"] for entry in entries]))}
    for name in ("overlap", "shuffled", "redrawn"):
        values = [entry[name] for entry in entries if entry.get(name) is not None]
        means[name] = (
            {key: float(np.mean([value[key] for value in values])) for key in values[0]} if values else None
        )
    return means


def reads_vl(config: HeadConfig, block: int) -> bool:
    """Whether a block is a cross-attention block."""
    return not (config.interleave_self_attention and block % 2)


def choose(name: str, given: Sequence[int] | None, count: int) -> tuple[int, ...]:
    """Those given, sorted, or all.

    Raises:
        InputError: one is out of range.
    """
    if given is None:
        return tuple(range(count))
    wrong = [number for number in given if not 0 <= number < count]
    if wrong or not given:
        raise InputError(
            f"--{name}: given {', '.join(map(str, given)) or 'none'}, the checkpoint has {name} 0 to "
            f"{count - 1}"
        )
    return tuple(sorted(set(given)))


def look(
    head: ActionHead, inputs: Inputs, selection: Selection
) -> tuple[dict[str, slice], dict[tuple[int, int], Float32Array]]:
    """Where the groups of rows lie, and the chosen maps, for the learned future tokens."""
    return _trace(head, inputs, selection, None)


def look_redrawn(
    head: ActionHead, inputs: Inputs, selection: Selection, tokens: Float32Array
) -> dict[tuple[int, int], Float32Array]:
    """The chosen maps of the future rows, with other future tokens."""
    rows, attention = _trace(head, inputs, selection, Intervention(future_tokens=tokens))
    return {place: maps[:, rows["future"]] for place, maps in attention.items()}


def _trace(
    head: ActionHead, inputs: Inputs, selection: Selection, intervention: Intervention | None
) -> tuple[dict[str, slice], dict[tuple[int, int], Float32Array]]:
    trace = head.trace(
        head.encode(inputs.features),
        inputs.state,
        inputs.embodiment_id,
        noise=inputs.noise,
        intervention=intervention,
        record=("attention",),
        blocks=selection.blocks,
        steps=selection.steps,
    )
    attention = {
        place: np.asarray(maps)[0, list(selection.heads)] for place, maps in sorted(trace.attention.items())
    }
    rows = {name: trace.rows[name] for name in ROW_GROUPS}
    return {name: where for name, where in rows.items() if where.stop > where.start}, attention


def learned_tokens(checkpoint: Path) -> Float32Array:
    """The checkpoint's future tokens, `(N, width)`; it must have some."""
    tables = [read_tensors(checkpoint, prefix + FUTURE_TOKENS) for prefix in PREFIXES]
    return next(table["weight"] for table in tables if "weight" in table)


def random_tokens(checkpoint: Path, seed: int) -> Float32Array:
    """Random directions with the lengths of the checkpoint's future tokens, `(N, width)`."""
    learned = learned_tokens(checkpoint)
    drawn = np.random.default_rng(seed).standard_normal(learned.shape, dtype=np.float32)
    lengths = np.linalg.norm(learned, axis=-1, keepdims=True)
    random: Float32Array = drawn * (lengths / np.linalg.norm(drawn, axis=-1, keepdims=True))
    return random


def describe_checkpoint(checkpoint: Path) -> dict[str, str]:
    """Name and hash of a checkpoint; the hash is over the config beside it, if any, and then the tensors."""
    directory = checkpoint if checkpoint.is_dir() else checkpoint.parent
    config = [directory / "config.json"] if (directory / "config.json").is_file() else []
    tensors = sorted(directory.glob("*.safetensors")) if checkpoint.is_dir() else [checkpoint]
    return {"name": checkpoint.resolve().name, "sha256": sha256_of(*config, *tensors)}
