"""docs/results/farm.md, from the JSON of the measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from benches.peers.text import table

PAGE = Path(__file__).resolve().parents[1] / "docs" / "results" / "farm.md"
COMMITTED = Path(__file__).with_name("farm.json")

NOTES = """Chunks a second: processes that act on random images without pause. Episodes an hour: processes
that run the five tasks of the bundled policy in the simulator, rendering included. All contenders get the
same observations; torch is `saccade_lab.reference`, the same policy in plain torch. Memory is the sum of
the proportional set sizes (PSS) of all processes: a page that three processes share counts
a third in each."""

POLICIES = ("demo", "full")
SECTIONS = {"chunks": "chunks a second", "episodes": "episodes an hour"}

Results = dict[str, Any]
Row = dict[str, Any]


def document(results: Results) -> str:
    """The page."""
    parts = [
        "# Many processes",
        "Written by `python -m benches.farm report --write` from `benches/farm.json`, which "
        "`python -m benches.farm` measured on this machine: " + machine(results["machine"]),
        NOTES,
    ]
    parts += choices(results)
    for policy in POLICIES:
        for section, title in SECTIONS.items():
            rows = rows_of(results, policy, section)
            if rows:
                name = results["names"][policy]
                parts += [f"## {name[0].upper()}{name[1:]}: {title}", *speeds(results, rows)]
    parts += memory(results)
    parts += left_out(results)
    return "\n\n".join(parts) + "\n"


def machine(held: Results) -> str:
    """The machine in one sentence."""
    versions = ", ".join(
        f"{name} {held['versions'][name]}" for name in ("saccade", "torch") if held["versions"].get(name)
    )
    return (
        f"{held['cpu']} ({held['family']}, {held['isa']}), {held['cores']} cores, {held['memory_gb']} GB, "
        f"Linux {held['kernel']}. {versions}; commit {held['commit']}."
    )


def rows_of(results: Results, policy: str, section: str) -> list[Row]:
    """The measurements of one policy, by engine, processes and batch.

    There are no episodes an hour without one setting that ran whole episodes.
    """
    found = [row for row in results["rows"] if (row["policy"], row["section"]) == (policy, section)]
    if section == "episodes" and not any(row["least_episodes"] for row in found):
        return []
    return sorted(found, key=lambda row: (row["engine"], -row["processes"], row["sharing"], row["batch"]))


def rate(results: Results, row: Row) -> float:
    """Chunks a second of all processes, or episodes an hour.

    Episodes an hour are the chunks of an hour divided by the mean number of chunks of an episode.
    """
    chunks = float(sum(done / seconds for done, seconds in zip(row["chunks"], row["seconds"], strict=True)))
    return chunks if row["section"] == "chunks" else 3600 * chunks / chunks_per_episode(results)


def chunks_per_episode(results: Results) -> float:
    """Of the setting that runs whole episodes."""
    rows = [row for row in results["rows"] if row.get("least_episodes")]
    lengths, ended = (sum(sum(row[name]) for row in rows) for name in ("lengths", "episodes"))
    return float(lengths / ended) if ended else float("nan")


def total_memory(row: Row) -> int:
    """Bytes that all processes take together."""
    return int(sum(one["pss"] for one in row["memory"]))


def shape(row: Row) -> str:
    """Processes and threads."""
    return f"{row['processes']} x {row['threads']}"


def number(value: float) -> str:
    """Three digits or more."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def best(results: Results, rows: Iterable[Row]) -> Row | None:
    """The fastest; None of none."""
    return max(rows, key=lambda row: rate(results, row), default=None)


def choices(results: Results) -> Iterator[str]:
    """What to choose on this machine."""
    uses: list[tuple[str, Callable[[Row], bool]]] = [
        ("most in all", lambda row: True),
        ("most, one observation at a time", lambda row: row["batch"] == 1),
    ]
    lines = []
    for policy in POLICIES:
        for section, title in SECTIONS.items():
            rows = rows_of(results, policy, section)
            # Those with one copy of the weights: the others differ in memory, and in rate by chance.
            ours = [row for row in rows if (row["engine"], row["sharing"]) == ("saccade", "fork")]
            theirs = best(results, [row for row in rows if row["engine"] == "torch"])
            for use, fits in uses:
                found = best(results, filter(fits, ours))
                if found is None:
                    continue
                times = "" if theirs is None else f"{rate(results, found) / rate(results, theirs):.1f}"
                lines.append(
                    [
                        f"{results['names'][policy]}, {found['precision']}: {title}",
                        use,
                        shape(found),
                        str(found["batch"]),
                        number(rate(results, found)),
                        times,
                        f"{total_memory(found) / 1e9:.1f}",
                    ]
                )
    if lines:
        yield "## What to choose here"
        yield (
            "The fastest settings of saccade, with one copy of the weights for all processes, and the memory "
            "of all of them. Times torch's best: the rate over that of torch's fastest setting, of any "
            "batch, in float32."
        )
        head = ["", "for", "processes x threads", "batch", "rate", "times torch's best", "GB"]
        yield table(head, lines)


def speeds(results: Results, rows: list[Row]) -> Iterator[str]:
    """All settings of one policy."""
    if rows[0]["section"] == "episodes":
        ended = [row for row in rows if row.get("least_episodes")]
        succeeded, count = (sum(sum(row[name]) for row in ended) for name in ("successes", "episodes"))
        yield (
            f"An episode takes {chunks_per_episode(results):.1f} chunks in the mean of {count}, of which "
            f"{succeeded} succeeded. The batch is the number of robots of each process."
        )
    head = ["engine", "processes x threads", "batch", "policy in memory", "rate", "GB in all"]
    lines = [
        [
            f"{row['engine']} {row['precision']}",
            shape(row),
            str(row["batch"]),
            "shared" if row["sharing"] == "fork" and row["processes"] > 1 else "its own",
            number(rate(results, row)),
            f"{total_memory(row) / 1e9:.2f}",
        ]
        for row in rows
    ]
    yield table(head, lines)


def memory(results: Results) -> Iterator[str]:
    """How memory is shared: settings that were measured both ways."""
    keys = ("policy", "section", "precision", "processes", "threads", "batch", "engine")
    by_key: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in results["rows"]:
        by_key.setdefault(tuple(row[key] for key in keys), {})[row["sharing"]] = row
    lines = []
    for both in by_key.values():
        if len(both) < 2:
            continue
        for sharing, row in both.items():
            working = row["memory"][1:] if sharing == "fork" else row["memory"]
            private = sum(one["private"] for one in working) / len(working)
            lines.append(
                [
                    f"{results['names'][row['policy']]}, {row['precision']}",
                    str(row["processes"]),
                    "fork: one copy of the weights" if sharing == "fork" else "spawn: one copy each",
                    f"{total_memory(row) / 1e9:.2f}",
                    f"{private / 1e9:.2f}",
                    number(rate(results, row)),
                ]
            )
    if lines:
        yield "## Memory"
        yield (
            "The same processes with the policy loaded once, by a process that then forks them, and loaded "
            "by each (spawn). In all: the PSS of all processes, with fork also of the one that only loaded. "
            "Alone: what a computing process shares with no other, on average."
        )
        head = ["", "processes", "weights", "GB in all", "GB of one process alone", "chunks a second"]
        yield table(head, lines)


def left_out(results: Results) -> Iterator[str]:
    """What was not measured, and why."""
    if results["left_out"]:
        yield "Not measured:"
        yield "\n".join(
            f"- {results['names'][one['setting']['policy']]}, {SECTIONS[one['setting']['section']]}, "
            f"{one['setting']['engine']}, {shape(one['setting'])}, batch {one['setting']['batch']}, "
            f"{one['setting']['sharing']}: {one['reason']}"
            for one in results["left_out"]
        )
