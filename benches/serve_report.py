"""docs/results/serve.md, from the JSON of the measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benches.peers.text import table
from saccade_lab.timing import quartiles

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results" / "serve.md"
#: The committed measurements, by policy.
COMMITTED = Path(__file__).with_name("serve_results.json")

NOTES = """Clients on the server's own machine send their next request when they have the response to the
last one.

- **a second**: responses to all clients together. **x one**: relative to one client, of the same round.
- **p50, p99**: from sending a request to its response, as a client sees it.
- **batch**: observations that were computed together, mean over requests.
- **in process**: observations a second of `policy.act` in a loop, with batches of the same sizes.
- **ms of processor**: CPU time per request, of the server and of the clients.

One server handled all rounds. Medians and quartiles are over rounds. On two cores, many clients cannot be
served faster than two threads compute, and a single client's request already uses both."""

POLICIES = {"demo": "The bundled policy", "full": "N1.5 at its published size, random weights"}

Results = dict[str, Any]
Row = dict[str, Any]


def document(results: dict[str, Results]) -> str:
    """The page."""
    parts = [
        "# The server under load",
        "Written by `python -m benches.serve report --write` from `benches/serve_results.json`, which "
        "`python -m benches.serve` measured.",
        NOTES,
    ]
    for name, title in POLICIES.items():
        if name in results:
            parts += [f"## {title}, {results[name]['precision']}", *section(results[name])]
    return "\n\n".join(parts) + "\n"


def section(result: Results) -> Iterator[str]:
    """What was measured of one policy."""
    held, rows = result["machine"], result["rows"]
    yield (
        f"{held['cpu']} ({held['name']}, {held['isa']}), {held['cores']} cores, {held['memory_gb']} GB; "
        f"{result['num_threads']} threads; saccade {held['versions']['saccade']}, commit {held['commit']}."
    )
    head = ["clients", "a second (quartiles)", "x one", "p50 ms", "p99 ms", "batch", "in process"]
    head += ["of in process (quartiles)", "lost", "ms of processor: server, clients"]
    yield table(head, [cells(row, rows[0]) for row in rows])
    memory = rows[-1]["memory"]
    requests = sum(row["requests"] for row in rows)
    text = f"Requests: {requests}; rounds: {len(memory)}."
    if len(memory) > 1:
        text += (
            f" Memory of the server: {memory[0]:.0f} MB after the first round, {memory[-1]:.0f} MB after the "
        )
        text += "last."
    yield text


def cells(row: Row, first: Row) -> list[str]:
    """A line of the table."""
    sizes = {int(size): count for size, count in row["batches"].items()}
    mean = sum(size * size * count for size, count in sizes.items()) / sum(
        size * count for size, count in sizes.items()
    )
    shares = [mine / act for mine, act in zip(row["per_second"], row["in_process"], strict=True)]
    times = [mine / one for mine, one in zip(row["per_second"], first["per_second"], strict=True)]
    return [
        str(row["clients"]),
        spread(row["per_second"], number),
        f"{quartiles(times)[1]:.2f}",
        number(row["p50"]),
        number(row["p99"]),
        f"{mean:.1f}",
        number(quartiles(row["in_process"])[1]),
        spread(shares, "{:.0%}".format),
        f"{row['lost']} of {row['requests']}",
        f"{number(quartiles(row['server_cpu'])[1])}, {number(quartiles(row['client_cpu'])[1])}",
    ]


def spread(values: list[float], shown: Callable[[float], str]) -> str:
    """The median, with the quartiles if there are several rounds."""
    low, middle, high = map(shown, quartiles(values))
    return f"{middle} ({low} to {high})" if len(values) > 1 else middle


def number(value: float) -> str:
    """Three digits or more."""
    digits = 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3
    return f"{value:.{digits}f}"
