"""Chunks per second of several observations at once, and how they grow with the number of threads."""

from __future__ import annotations

from benches.peers.cases import BATCHES, Case
from benches.peers.contenders import CONTENDERS
from benches.peers.floors import limits
from benches.peers.results import Results
from benches.peers.text import plural, table
from saccade_lab.timing import quartiles


def throughput(results: Results) -> list[str]:
    """The tables: chunks per second by batch, and by number of threads."""
    threads = sorted({case.threads for case in results.cases if case.piece == "throughput"})
    if not threads:
        return []
    parts = [
        "## Throughput",
        "Chunks per second, `encode` and `sample` of several observations at once. The last column is the "
        "largest batch relative to one observation at a time.",
    ]
    for count in threads:
        parts += [f"### {plural(count)}", by_batch(results, count)]
    if len(threads) > 1:
        parts += ["### Scaling", by_threads(results, threads), *memory_ends_it(results, threads)]
    return parts


def rate(results: Results, name: str, threads: int, batch: int) -> float | None:
    """Chunks per second, the median; None if it was not measured or the result was not correct."""
    case = Case("throughput", threads, batch=batch)
    seconds = results.seconds(case, name, "both")
    return batch / quartiles(seconds)[1] if seconds and results.is_correct(case, name) else None


def names(results: Results) -> list[str]:
    """The contenders that were measured, in their order."""
    cases = [case for case in results.cases if case.piece == "throughput"]
    return [name for name in CONTENDERS if any(name in results.names(case) for case in cases)]


def by_batch(results: Results, threads: int) -> str:
    """A row per contender, a column per batch."""
    rows = []
    for name in names(results):
        rates = [rate(results, name, threads, batch) for batch in BATCHES]
        if any(rates):
            gain = f"{rates[-1] / rates[0]:.2f} x" if rates[0] and rates[-1] else ""
            rows.append([CONTENDERS[name].label, *map(cell, rates), gain])
    return table(["chunks/s", *(f"batch {batch}" for batch in BATCHES), "gain"], rows)


def by_threads(results: Results, threads: list[int]) -> str:
    """A row per contender and batch, a column per number of threads; in brackets relative to the first."""
    rows = []
    for name in names(results):
        for batch in BATCHES:
            rates = [rate(results, name, count, batch) for count in threads]
            if not rates[0] or not any(rates[1:]):
                continue
            cells = ["" if each is None else f"{cell(each)} ({each / rates[0]:.2f} x)" for each in rates]
            rows.append([CONTENDERS[name].label, str(batch), *cells])
    return table(["chunks/s", "batch", *map(plural, threads)], rows)


def memory_ends_it(results: Results, threads: list[int]) -> list[str]:
    """For each arithmetic and batch the least times that multiply-adds and memory allow, by threads."""
    rows = []
    for name in ("saccade-float32", "saccade-bfloat16", "saccade-int8"):
        for batch in BATCHES:
            cells = []
            for count in threads:
                pair = limits(results, Case("throughput", count, batch=batch), name)
                cells.append("" if pair is None else " / ".join(f"{1e3 * seconds:.0f}" for seconds in pair))
            if any(cells):
                rows.append([CONTENDERS[name].label, str(batch), *cells])
    how = (
        "The least time of a batch in ms: all multiply-adds at the peak of that many threads / reading every "
        "weight once for each product at their bandwidth. Where the second is longer, memory is the limit, "
        "and more threads add nothing."
    )
    return [how, table(["ms", "batch", *map(plural, threads)], rows)] if rows else []


def cell(value: float | None) -> str:
    """A rate with three digits; empty if there is none."""
    return "" if value is None else f"{value:.3g}"
