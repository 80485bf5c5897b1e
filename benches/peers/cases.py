"""The measured cases: pieces of the head, their sizes, and the multiply-adds of each."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from benches.work import encode_work, sample_work, total
from saccade import HeadConfig
from saccade_lab.timing import Call

NUM_BLOCKS = 4  # of the piece "blocks": cross, self, cross, self
LINEAR_SHAPES = ((49, 1536, 6144), (49, 6144, 1536), (49, 1536, 1536), (296, 2048, 1536))
"""`(rows, inputs, outputs)`: a DiT block's feed-forward and projections, a projection of the features."""
COST: dict[str, tuple[int, ...]] = {
    "N": (0, 16, 32, 64, 128),
    "T_vl": (74, 148, 296, 559, 822),
    "steps": (1, 2, 4, 8),
    "samples": (1, 2, 4, 8),
}
"""Sizes for the cost model; each is varied alone, the others as released."""
FIELDS = {"N": "num_future_tokens", "T_vl": "num_vl_tokens"}
"""The fields of a case by the names of `COST`, where they differ."""
WORKS: dict[str, tuple[str, ...]] = {
    "linear": tuple(f"{rows} x {inputs} x {outputs}" for rows, inputs, outputs in LINEAR_SHAPES),
    "cross": ("held", "both"),
    "blocks": ("held", "both"),
    "head": ("encode", "sample"),
    "throughput": ("encode", "sample"),
    "cost": (
        *(f"encode, T_vl {value}" for value in COST["T_vl"]),
        *(f"sample, {name} {value}" for name, values in COST.items() for value in values),
    ),
    "policy": ("1 view", "2 views"),
}
"""The timed works of each piece. `held`: keys and values of the observation are cached; `both`: they are
computed too. For the whole head, `both` is the sum of its two works in the same round. For the whole policy,
which is measured apart, a work is a chunk from so many frames and an instruction.
"""

USUAL = ("head", "blocks", "cross", "linear")
"""The pieces of a run that names none: all but the cost model and throughput."""
WHOLE = ("head", "throughput", "cost")
"""The pieces that are the whole head."""
RELEASES = ("n1.5", "n1.7")
"""The releases whose whole policy is measured."""
BATCHES = (1, 8, 32)
"""Observations of the piece `throughput`."""


@dataclass(frozen=True, order=True)
class Case:
    """One piece of the head at one size.

    Attributes:
        piece: A key of `WORKS`: the linear layers alone (`LINEAR_SHAPES`), the attention of the eight cross
            blocks, four DiT blocks, the whole head, the whole head for several observations at once, the
            whole head at the sizes of `COST`, the whole policy (of the other sizes only `size` matters).
        threads: Threads that every engine is given.
        num_vl_tokens: T_vl.
        num_future_tokens: N.
        batch: Observations.
        samples: Chunks for each observation.
        steps: Euler steps (of the whole head).
        size: `full` (as published) or `small` (to see that it works).
        release: Of the whole policy `n1.5` or `n1.7`; the head is N1.5's.
    """

    piece: str
    threads: int
    num_vl_tokens: int = 296
    num_future_tokens: int = 32
    batch: int = 1
    samples: int = 1
    steps: int = 4
    size: str = "full"
    release: str = "n1.5"

    @property
    def works(self) -> tuple[str, ...]:
        """The works that are timed."""
        return WORKS[self.piece]

    @property
    def reported(self) -> tuple[str, ...]:
        """The works that are reported."""
        return (*self.works, "both") if self.piece in ("head", "throughput") else self.works

    def as_dict(self) -> dict[str, Any]:
        """The fields, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        if self.piece == "policy":
            return f"policy {self.release.upper()}, {self.threads} threads"
        return (
            f"{self.piece} T_vl {self.num_vl_tokens} N {self.num_future_tokens} batch {self.batch} "
            f"samples {self.samples} steps {self.steps}, {self.threads} threads"
        )


def default_cases(threads: list[int]) -> list[Case]:
    """Every piece at the released size, one view, N 32, one chunk; one observation, of throughput several."""
    cases = [Case(piece, count) for count in threads for piece in USUAL]
    cases += [Case("throughput", count, batch=batch) for batch in BATCHES for count in threads]
    return [*cases, Case("cost", max(threads)), *(Case("policy", count) for count in threads)]


def full_cases(threads: list[int]) -> list[Case]:
    """Every piece at T_vl 296 and 822, N 0 / 32 / 64, one and eight observations, one and eight chunks."""
    cases = []
    for default in default_cases(threads):
        cases.append(default)
        if default.piece in ("linear", "throughput", "cost", "policy"):
            continue
        for vl in (296, 822):
            # The cross-attention sees N only as more rows; four blocks have no samples of one observation.
            for future in (0, 32, 64):
                cases.append(replace(default, num_vl_tokens=vl, num_future_tokens=future))
            cases.append(replace(default, num_vl_tokens=vl, batch=8))
            if default.piece != "blocks":
                cases.append(replace(default, num_vl_tokens=vl, samples=8))
    return list(dict.fromkeys(cases))


def exact_macs(config: HeadConfig, case: Case) -> dict[str, float]:
    """Multiply-adds of the exact computation by work: the floor for every engine.

    For the whole head, work that can be skipped without changing a result is not counted: keys and values of
    the cross blocks count once per observation, the last self-attention block and the output count for the
    action rows only, and time-only values count as cached.
    """
    if case.piece == "linear":
        products = (float(rows * inputs * outputs) for rows, inputs, outputs in LINEAR_SHAPES)
        return dict(zip(case.works, products, strict=True))
    if case.piece == "cost":
        return {work: exact_macs(config, case_of_cost(case, work))[work.split(",")[0]] for work in case.works}
    vl, width = case.num_vl_tokens, config.width
    rows = 1 + case.num_future_tokens + config.action_horizon
    cross = [index % 2 == 0 or not config.interleave_self_attention for index in range(config.num_layers)]
    key_values = sum(cross) * 2 * vl * config.context_dim * width
    if case.piece == "cross":
        attention = sum(cross) * (2 * rows * width**2 + 2 * rows * vl * width)
        return _works(case.batch * key_values, case.batch * case.samples * attention)
    if case.piece == "blocks":
        blocks = sum(_block(config, rows, vl, is_cross) for is_cross in cross)
        return _works(case.batch * key_values, case.batch * blocks)
    call = Call(vl, case.steps, case.batch, case.samples, num_future_tokens=case.num_future_tokens)
    encode, sample = (float(total(work(config, call)).multiply_adds) for work in (encode_work, sample_work))
    return {"encode": encode, "sample": sample, "both": encode + sample}


def case_of_cost(case: Case, work: str) -> Case:
    """The whole head at the size that a work of the piece `cost` names."""
    name, value = work.partition(", ")[2].split(" ")
    changed: dict[str, Any] = {FIELDS.get(name, name): int(value)}
    return replace(case, piece="head", **changed)


def _works(key_values: float, held: float) -> dict[str, float]:
    return {"held": held, "both": key_values + held}


def _block(config: HeadConfig, rows: int, vl: int, is_cross: bool) -> int:
    """One DiT block's: query, output, feed-forward; scores, values; a self block's keys and values."""
    width = config.width
    keys = vl if is_cross else rows
    return rows * 10 * width**2 + 2 * rows * keys * width + (0 if is_cross else rows * 2 * width**2)
