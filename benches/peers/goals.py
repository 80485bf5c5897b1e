"""Speed-ups and shares of the floor that saccade aimed for, and whether they were reached."""

from __future__ import annotations

from dataclasses import dataclass, replace

from benches.peers.cases import LINEAR_SHAPES
from benches.peers.contenders import CONTENDERS
from benches.peers.floors import floor
from benches.peers.results import Results
from benches.peers.text import percent, plural, table, usual
from saccade_lab.timing import quartiles


@dataclass(frozen=True)
class Goal:
    """A target for the time of a peer divided by the time of saccade.

    Attributes:
        what: For the table.
        piece, work: The case and the part of it that is timed.
        peers: Contenders; the fastest of those measured counts.
        ours: The contender that is compared with them.
        least, beyond: Ratios at which the target is reached, and exceeded.
    """

    what: str
    piece: str
    work: str
    peers: tuple[str, ...]
    ours: str
    least: float
    beyond: float


LEROBOT_BF16 = ("lerobot-bfloat16", "lerobot-bfloat16-pure")


PURE_BF16 = ("lerobot-bfloat16-pure",)


GOALS = (
    Goal("float32, encode + sample", "head", "both", ("lerobot-float32",), "saccade-float32", 3.7, 4.0),
    Goal(
        "float32, sample from a cached context",
        "head",
        "sample",
        ("lerobot-float32",),
        "saccade-float32",
        5.0,
        5.5,
    ),
    Goal("bfloat16, encode + sample", "head", "both", LEROBOT_BF16, "saccade-bfloat16", 1.8, 2.0),
    Goal(
        "bfloat16, sample from a cached context", "head", "sample", LEROBOT_BF16, "saccade-bfloat16", 2.5, 2.8
    ),
    Goal(
        "bfloat16, four DiT blocks including keys and values",
        "blocks",
        "both",
        ("openvino-bfloat16",),
        "saccade-bfloat16",
        1.1,
        1.2,
    ),
    Goal("int8, encode + sample", "head", "both", LEROBOT_BF16, "saccade-int8", 3.2, 3.6),
    *(
        Goal(
            f"int8, future_refresh={refresh}, sample from a cached context",
            "head",
            "sample",
            LEROBOT_BF16,
            f"saccade-int8-refresh{refresh}",
            7.0,
            9.0,
        )
        for refresh in (2, 4)
    ),
)


GOALS_AMX = (
    Goal("bfloat16, encode + sample", "head", "both", PURE_BF16, "saccade-bfloat16", 2.6, 3.2),
    Goal("bfloat16, sample from a cached context", "head", "sample", PURE_BF16, "saccade-bfloat16", 3.6, 4.5),
    Goal("int8, encode + sample", "head", "both", PURE_BF16, "saccade-int8", 3.5, 4.6),
    Goal("int8, sample from a cached context", "head", "sample", PURE_BF16, "saccade-int8", 4.8, 6.5),
    Goal("bfloat16, encode + sample", "head", "both", ("openvino-bfloat16",), "saccade-bfloat16", 1.3, 1.6),
    Goal("float32, encode + sample", "head", "both", ("lerobot-float32",), "saccade-float32", 2.4, 2.7),
)
"""Where AMX multiplies. torch and OpenVINO use it too."""


FLOOR_GOALS_AMX: dict[str, tuple[float, float | None]] = {
    "saccade-float32": (0.85, None),
    "saccade-bfloat16": (0.60, 0.75),
    "saccade-int8": (0.60, 0.75),
}
"""Contender -> shares of the floor of the whole head at which the target is reached, and exceeded (None: no
such share).
"""


BATCH_GOAL_AMX = (4.0, 32)
"""Chunks per second of so many observations at once, relative to one."""


NEEDED = tuple(dict.fromkeys(name for goal in (*GOALS, *GOALS_AMX) for name in (goal.ours, *goal.peers)))
"""The contenders of the targets."""


LINEAR_GOALS = {1: ((0.86, 0.94), (0.90, 0.97)), 2: ((0.82, 0.91), (0.90, 0.97))}
"""Thread count -> shares of the peak at (49, 296) rows at which the target is reached, and exceeded."""


def goals(results: Results) -> str:
    """The table of targets, and whether each was reached."""
    rows = []
    has_tiles = results.data["machine"]["isa"] == "amx"
    for goal in GOALS_AMX if has_tiles else GOALS:
        for case in usual(results, goal.piece):
            peers = [name for name in goal.peers if name in results.names(case)]
            if not peers or goal.ours not in results.names(case):
                continue
            peer = min(peers, key=lambda name: quartiles(results.seconds(case, name, goal.work))[1])
            measured = results.ratio(case, peer, goal.ours, goal.work)
            if measured is not None:
                rows.append(
                    [
                        f"{goal.what}, against {CONTENDERS[peer].label}",
                        plural(case.threads),
                        f"{goal.least} x ({goal.beyond} x)",
                        f"{'' if results.ratios(case, peer, goal.ours, goal.work) else '~'}"
                        f"{measured[1]:.2f} x ({measured[0]:.2f}–{measured[2]:.2f})",
                        reached(measured[1], goal.least, goal.beyond),
                    ]
                )
    for name, (least_share, beyond_share) in FLOOR_GOALS_AMX.items() if has_tiles else ():
        for case in usual(results, "head"):
            seconds, shortest = results.seconds(case, name, "both"), floor(results, case, name)
            if seconds and shortest is not None:
                share = shortest / quartiles(seconds)[1]
                rows.append(
                    [
                        f"{CONTENDERS[name].label}, encode + sample, share of the floor",
                        plural(case.threads),
                        percent([least_share])
                        + (f" ({percent([beyond_share])})" if beyond_share is not None else ""),
                        percent([share]),
                        reached(share, least_share, beyond_share),
                    ]
                )
    gain, batch = BATCH_GOAL_AMX
    for name in ("saccade-bfloat16", "saccade-int8") if has_tiles else ():
        for case in sorted(
            case for case in results.cases if case.piece == "throughput" and case.batch == batch
        ):
            one, many = (results.seconds(each, name, "both") for each in (replace(case, batch=1), case))
            if one and many:
                measured_gain = batch * quartiles(one)[1] / quartiles(many)[1]
                rows.append(
                    [
                        f"{CONTENDERS[name].label}, chunks/s of batch {batch} against batch 1",
                        plural(case.threads),
                        f"{gain} x",
                        f"{measured_gain:.2f} x",
                        reached(measured_gain, gain, None),
                    ]
                )
    for threads, (least, beyond) in LINEAR_GOALS.items():
        for kind in ("float32", "bfloat16", "int8"):
            shares = linear_shares(results, kind, threads)
            if shares:
                met = [reached(*numbers) for numbers in zip(shares, least, beyond, strict=True)]
                rows.append(
                    [
                        f"linear kernels, {kind}, 49 / 296 rows, of the peak",
                        plural(threads),
                        f"{percent(least)} ({percent(beyond)})",
                        percent(shares),
                        met[0] if met[0] == met[1] else " / ".join(met),
                    ]
                )
    return (
        table(["what", "", "target (exceeded at)", "measured", "reached"], rows)
        if rows
        else "Nothing measured yet."
    )


def reached(measured: float, least: float, beyond: float | None) -> str:
    """Whether a target is reached, or exceeded if that has a number."""
    if beyond is not None and measured >= beyond:
        return "exceeded"
    return "yes" if measured >= least else "**no**"


def linear_shares(results: Results, kind: str, threads: int) -> list[float]:
    """Shares of the peak of the best instruction set: the smallest of the shapes with 49 rows, then 296."""
    best = results.data["machine"]["isa"]
    found: dict[int, list[float]] = {49: [], 296: []}
    for rows, inputs_, outputs in LINEAR_SHAPES:
        values = [
            rate["of_peak"]["median"]
            for bench in results.data["linear"]
            for case in bench["cases"]
            if case["case"] == f"{rows} x {inputs_} x {outputs}"
            for rate in case["rates"]
            if rate["threads"] == threads
            and is_linear(rate["name"], best, kind)
            and rate["of_peak"]["samples"]
        ]
        if values:
            found[rows].append(quartiles(values)[1])
    return [min(values) for values in found.values()] if all(found.values()) else []


def is_linear(name: str, isa: str, kind: str) -> bool:
    """Whether a name of `cargo bench --bench linear` means this instruction set and arithmetic."""
    return name in (f"saccade {isa}, {kind}", f"saccade {isa}, {kind} arithmetic")
