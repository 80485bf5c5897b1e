"""The maps of one observation: traces, summaries and occlusion, as the sheet and the page show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

import saccade
from saccade._internal.arrays import Float32Array
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.intervention import ROW_GROUPS, Intervention
from saccade_lab.maps.occlusion import Occlusion
from saccade_lab.maps.summary import Overlap, overlap, summarize
from saccade_lab.maps.view import View

Indices = npt.NDArray[np.int64]
#: The maps of one Euler step and block, ``(heads, rows, keys)``.
Attention = Mapping[tuple[int, int], Float32Array]

CAVEAT = (
    "A bright patch shows where a row reads, not what causes an action. After the backbone and the VL "
    "self-attention a position contains more than its patch, so what is read there need not come from that "
    "patch of the picture."
)
OCCLUSION = "The occlusion map shows what the actions depend on."
MEAN = "mean"


@dataclass(frozen=True)
class Selection:
    """Which maps are computed and shown.

    Attributes:
        blocks, steps: Indices of blocks and of Euler steps.
        heads: Heads over which the mean is taken.
        shown_heads: Those of them that are also shown one by one.
    """

    blocks: tuple[int, ...]
    steps: tuple[int, ...]
    heads: tuple[int, ...]
    shown_heads: tuple[int, ...]


@dataclass(frozen=True)
class Maps:
    """One observation and what the rows of the head attend to.

    Attributes:
        checkpoint: Where the head was loaded from, and its hash.
        config: Config of the head.
        view: The observation.
        selection: Which maps.
        rows: Slices of the groups; a group without rows is left out.
        attention: Maps by step and block, ``(heads, rows, keys)``, with the heads in the selection's order.
        redrawn: Maps of the future rows with random future tokens; None without future tokens.
        occlusion: None if there are no image tokens.
    """

    checkpoint: dict[str, str]
    config: HeadConfig
    view: View
    selection: Selection
    rows: dict[str, slice]
    attention: Attention
    redrawn: Attention | None
    occlusion: Occlusion | None

    @property
    def caveat(self) -> str:
        """What a reader of any map must know."""
        return CAVEAT if self.occlusion is None else f"{CAVEAT} {OCCLUSION}"

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
        """The mean over heads, and over steps unless one is given, ``(rows, keys)``."""
        steps = self.selection.steps if step is None else (step,)
        mean: Float32Array = np.mean(
            [self.attention[one, block].mean(axis=0) for one in steps], axis=0, dtype=np.float32
        )
        return mean

    def parts(self, block: int) -> dict[str, Indices]:
        """The keys of a block by camera and kind of token, or by group of rows."""
        return self.view.layout.parts() if self.reads_vl(block) else self._row_parts()

    def agreement(self, keys: Float32Array) -> float | None:
        """Spearman's rank correlation over all patches between a map ``(T_vl,)`` and the occlusion map.

        None without image tokens, or if one of the two maps is constant.
        """
        if self.occlusion is None:
            return None
        cameras = self.view.layout.cameras
        read = np.concatenate([keys[camera.positions] for camera in cameras])
        change = np.concatenate([self.occlusion.change[camera.name].ravel() for camera in cameras])
        if np.ptp(read) == 0 or np.ptp(change) == 0:
            return None
        ranks = [scipy.stats.rankdata(values) for values in (read, change)]
        return float(np.corrcoef(ranks)[0, 1])

    def agreements(self) -> list[dict[str, Any]]:
        """``agreement`` of each group's mean map over heads and Euler steps, in cross-attention blocks."""
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

        The entry of the mean map has ``per_head``: entropy and overlap of the maps of each head, averaged
        over the heads. If heads attend to different keys, the mean map is wide although each head's is
        narrow.
        """
        rng = np.random.default_rng(0)
        entries = []
        for (step, block), attention in self.attention.items():
            parts = self.parts(block)
            within = self.view.layout.kinds() if self.reads_vl(block) else parts
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
        """``attention.json``."""
        return {
            "saccade": saccade.__version__,
            "checkpoint": self.checkpoint,
            "source": self.view.source,
            "num_future_tokens": self.num_future_tokens,
            "rows": {name: [rows.start, rows.stop] for name, rows in self.rows.items()},
            "selection": asdict(self.selection),
            "layout": self.view.layout.to_dict(),
            "caveat": self.caveat,
            "baselines": BASELINES,
            "occlusion": None if self.occlusion is None else self.occlusion.to_dict(),
            "agreement": self.agreements(),
            "summaries": self.summaries,
        }


BASELINES = {
    "identical": "tokens with the same map: divergence 0, cosine 1, 1 distinct map",
    "shuffled": "each map shuffled by itself among the keys of one kind: equal entropy, unrelated keys",
    "redrawn": "future tokens replaced by random directions with the lengths of the learned tokens",
}


def _asdict(found: Overlap | None) -> dict[str, float] | None:
    return None if found is None else asdict(found)


def _per_head(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over the heads of entropy and overlap of their maps."""
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


def attention_maps(
    head: ActionHead, view: View, selection: Selection
) -> tuple[dict[str, slice], dict[tuple[int, int], Float32Array]]:
    """The slices of the groups of rows, and the chosen maps with the learned future tokens."""
    return _trace(head, view, selection, None)


def redrawn_maps(
    head: ActionHead, view: View, selection: Selection, tokens: Float32Array
) -> dict[tuple[int, int], Float32Array]:
    """The chosen maps of the future rows, with other future tokens."""
    rows, attention = _trace(head, view, selection, Intervention(future_tokens=tokens))
    return {place: maps[:, rows["future"]] for place, maps in attention.items()}


def _trace(
    head: ActionHead, view: View, selection: Selection, intervention: Intervention | None
) -> tuple[dict[str, slice], dict[tuple[int, int], Float32Array]]:
    trace = view.observation.trace(
        head,
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


def random_tokens(learned: Float32Array, seed: int) -> Float32Array:
    """Random directions with the lengths of the learned future tokens; both ``(N, width)``."""
    drawn = np.random.default_rng(seed).standard_normal(learned.shape, dtype=np.float32)
    lengths = np.linalg.norm(learned, axis=-1, keepdims=True)
    random: Float32Array = drawn * (lengths / np.linalg.norm(drawn, axis=-1, keepdims=True))
    return random
