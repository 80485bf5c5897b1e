"""How the report writes cases, times and tables."""

from __future__ import annotations

from collections.abc import Iterable

from benches.peers import inputs
from benches.peers.cases import Case
from benches.peers.results import Results
from saccade import HeadConfig

PIECES = {
    "head": "The whole head",
    "blocks": "Four DiT blocks",
    "cross": "The cross-attention of one block",
}


WORK_TITLES = {
    "encode": "encode",
    "sample": "sample from a cached context",
    "both": "encode + sample",
}


PART_TITLES = {"held": "with cached keys and values", "both": "including keys and values"}


def usual(results: Results, piece: str, release: str = "n1.5") -> list[Case]:
    """The measured cases of a piece at the released size, one view and one observation, by thread count."""
    return sorted(case for case in results.cases if case == Case(piece, case.threads, release=release))


def size(case: Case) -> str:
    """The case's sizes for a heading."""
    parts = [f"T_vl {case.num_vl_tokens}", f"N {case.num_future_tokens}"]
    parts += [f"{case.batch} observations"] * (case.batch > 1) + [f"{case.samples} samples"] * (
        case.samples > 1
    )
    return ", ".join([*parts, plural(case.threads)])


def plural(threads: int) -> str:
    """`1 thread`, `2 threads`."""
    return f"{threads} thread" + ("s" if threads != 1 else "")


def config(case: Case) -> HeadConfig:
    """The config of the head that the piece is part of."""
    return HeadConfig.from_dict(inputs.config_of(case))


def calls(case: Case) -> int:
    """How many layers the multiply-adds are counted over; the time is that of one layer."""
    return config(case).num_layers // 2 if case.piece == "cross" else 1


def arithmetic(name: str) -> str:
    """The arithmetic of a contender: `float32`, `bfloat16` or `int8`."""
    return next((kind for kind in ("float32", "int8") if kind in name), "bfloat16")


def number(seconds: float) -> str:
    """Seconds as milliseconds, with four digits at most."""
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 1000 else f"{value:.1f}" if value >= 10 else f"{value:.3f}"


def percent(shares: Iterable[float]) -> str:
    """Shares in percent, such as `86 / 94 %`."""
    return " / ".join(f"{100 * share:.0f}" for share in shares) + " %"


def table(head: list[str], rows: Iterable[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
