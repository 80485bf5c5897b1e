"""Load on `saccade serve` over loopback: throughput, latency, memory, and what serving costs.

    python -m benches.serve CHECKPOINT                          20,000 requests by each number of clients
    python -m benches.serve CHECKPOINT --requests 200           quick
    python -m benches.serve --random OUT [--small]              writes a random checkpoint first
    python -m benches.serve CHECKPOINT --precision int8 --clients 1 4 --requests 200

A server is started in a process of its own for each number of clients. The clients share one process, which
sends messages that were packed before, so that they take little of the machine; each sends its next request
when it has its answer. Every answer is unpacked and counted. The server's memory is read along the way, after
the first tenth of the requests.

Then this process computes batches of the sizes that the server reported, in their order, with `policy.act`.
`of in process` is the server's throughput divided by this one.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zmq

import saccade
from saccade.serve import Limits
from saccade.serve.packing import pack, unpack

#: Different observations; each client sends one after the other.
OBSERVATIONS = 8
#: Seconds of batches that are computed in process for the comparison.
COMPARED_SECONDS = 20.0
START_SECONDS = 900.0


@dataclass(frozen=True)
class Row:
    """What was measured with a number of clients.

    Attributes:
        clients: Their number.
        requests: Number of requests.
        lost: Requests without an answer, or with an error.
        per_second: Answers a second.
        p50, p99: Latency as a client sees it, in milliseconds.
        batch: Mean number of observations that were computed together.
        in_process: Observations a second that `policy.act` computes in batches of the same sizes.
        memory: Resident memory of the server after a tenth of the requests, and at the end, in MB.
    """

    clients: int
    requests: int
    lost: int
    per_second: float
    p50: float
    p99: float
    batch: float
    in_process: float
    memory: tuple[float, float]


def main(arguments: list[str] | None = None) -> int:
    """The exit status: 1 if an answer was lost."""
    args = parse(arguments)
    checkpoint = prepared(args)
    policy = saccade.Policy.load(
        checkpoint, embodiment=args.embodiment, precision=args.precision, num_threads=args.num_threads
    )
    observations = [policy.example_observation(seed) for seed in range(OBSERVATIONS)]
    rows = []
    for clients in args.clients:
        with server(checkpoint, args, clients) as (port, process, log):
            result = load(port, process.pid, observations, clients, args.requests)
        batches = batch_sizes(log)
        in_process = rate_in_process(policy, observations, batches)
        latencies = 1e3 * np.array(result.latencies)
        rows.append(
            Row(
                clients,
                args.requests,
                args.requests - len(latencies),
                len(latencies) / result.seconds,
                float(np.percentile(latencies, 50)),
                float(np.percentile(latencies, 99)),
                float(np.mean(batches)),
                in_process,
                result.memory,
            )
        )
        print(line(rows[-1]), flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    report = {
        "checkpoint": str(checkpoint),
        "precision": args.precision,
        "rows": [asdict(row) for row in rows],
    }
    args.out.write_text(json.dumps(report | {"machine": saccade.show_config("dicts")}, indent=2, default=str))
    print(table(rows))
    print(f"wrote {args.out}")
    return int(any(row.lost for row in rows))


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", nargs="?", type=Path, metavar="CHECKPOINT")
    parser.add_argument(
        "--random", type=Path, metavar="OUT", help="write a random checkpoint here, and serve it"
    )
    parser.add_argument("--small", action="store_true", help="a small one, for --random")
    parser.add_argument("--embodiment", metavar="TAG")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 4, 16, 64], metavar="N")
    parser.add_argument(
        "--requests", type=int, default=20_000, metavar="N", help="for each number of clients"
    )
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--num-threads", type=int, metavar="N")
    parser.add_argument("--serve-args", default="", metavar="TEXT", help="further arguments of saccade serve")
    parser.add_argument("--out", type=Path, default=Path("out/serve/results.json"), metavar="FILE")
    args = parser.parse_args(arguments)
    if (args.checkpoint is None) == (args.random is None):
        parser.error("expected either CHECKPOINT or --random OUT")
    if min(args.clients) < 1 or args.requests < max(args.clients):
        parser.error("expected at least one request for each client")
    return args


def prepared(args: argparse.Namespace) -> Path:
    """The checkpoint, which is written if it is to be random."""
    if args.random is None:
        return Path(args.checkpoint)
    if not (args.random / "config.json").is_file():
        small = ["--small"] if args.small else []
        command = [sys.executable, "-m", "saccade.checkpoints.random_checkpoint", str(args.random), *small]
        subprocess.run(command, check=True)
    return Path(args.random)


@contextlib.contextmanager
def server(
    checkpoint: Path, args: argparse.Namespace, clients: int
) -> Iterator[tuple[int, subprocess.Popen[bytes], Path]]:
    """A server in a process: its port, the process, and the file with its log.

    Raises:
        RuntimeError: It does not start, or does not end with status 0.
    """
    log = args.out.with_name(f"{args.out.stem}-{clients}.jsonl")
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "saccade", "serve", str(checkpoint), "--port", "0", "--log", "json"]
    command += ["--precision", args.precision, *args.serve_args.split()]
    if args.embodiment is not None:
        command += ["--embodiment", args.embodiment]
    if args.num_threads is not None:
        command += ["--num-threads", str(args.num_threads)]
    with log.open("wb") as output, subprocess.Popen(command, stdout=output) as process:
        try:
            yield port_of(log, process), process, log
        finally:
            process.send_signal(signal.SIGTERM)
            status = process.wait(60)
        if status:
            raise RuntimeError(f"the server ended with status {status}")


def port_of(log: Path, process: subprocess.Popen[bytes]) -> int:
    """The port that a server says that it listens on."""
    end = time.monotonic() + START_SECONDS
    while time.monotonic() < end and process.poll() is None:
        first = log.read_text().partition("\n")
        if first[1]:
            return int(json.loads(first[0])["address"].rpartition(":")[2])
        time.sleep(0.05)
    raise RuntimeError("the server did not start")


@dataclass
class Load:
    """What the clients saw.

    Attributes:
        latencies: Seconds of each answer that is no error.
        seconds: Time of all of them.
        memory: Of the server, see :class:`Row`.
    """

    latencies: list[float]
    seconds: float
    memory: tuple[float, float]


def load(port: int, process: int, observations: Sequence[Any], clients: int, requests: int) -> Load:
    """Sends requests, each client the next one when it has its answer."""
    messages = [
        pack({"endpoint": "get_action", "data": {"observation": seen, "options": {"seed": seed}}})
        for seed, seen in enumerate(observations)
    ]
    left, found, sent = itertools.count(), Load([], 0.0, (0.0, 0.0)), {}
    poller, context = zmq.Poller(), zmq.Context()
    sockets = [context.socket(zmq.REQ) for _ in range(clients)]

    def send(one: zmq.Socket[bytes]) -> None:
        number = next(left)
        if number < requests:
            sent[one] = time.perf_counter()
            one.send(messages[number % len(messages)])

    start = time.perf_counter()
    for one in sockets:
        one.setsockopt(zmq.LINGER, 0)
        one.connect(f"tcp://127.0.0.1:{port}")
        poller.register(one, zmq.POLLIN)
        send(one)
    early, answers = 0.0, 0
    while sent:
        ready = poller.poll(120_000)
        if not ready:
            break
        for one, _ in ready:
            answer = unpack(one.recv(), Limits()).value
            elapsed = time.perf_counter() - sent.pop(one)
            answers += 1
            if isinstance(answer, list):
                found.latencies.append(elapsed)
            send(one)
        if not early and answers >= requests // 10:
            early = resident(process)
    found.seconds = time.perf_counter() - start
    found.memory = (early, resident(process))
    context.destroy(linger=0)
    return found


def resident(process: int) -> float:
    """Resident memory of a process in MB."""
    status = Path(f"/proc/{process}/status").read_text()
    found = re.search(r"^VmRSS:\s*(\d+) kB", status, re.MULTILINE)
    return 0.0 if found is None else int(found[1]) / 1e3


def batch_sizes(log: Path) -> list[int]:
    """The sizes of the batches, in their order: of a batch of n, n requests in a row say so."""
    lines = [json.loads(text) for text in log.read_text().splitlines()]
    sizes = [one["batch"] for one in lines if one["event"] == "request" and one.get("batch")]
    found, position = [], 0
    while position < len(sizes):
        found.append(sizes[position])
        position += sizes[position]
    return found


def rate_in_process(policy: saccade.Policy, observations: Sequence[Any], batches: Sequence[int]) -> float:
    """Observations a second of `policy.act` in batches of these sizes."""
    for size in Counter(batches):
        policy.act([observations[row % len(observations)] for row in range(size)], seed=0)
    count, start = 0, time.perf_counter()
    for size in batches:
        policy.act([observations[row % len(observations)] for row in range(size)], seed=0)
        count += size
        if time.perf_counter() - start > COMPARED_SECONDS:
            break
    return count / (time.perf_counter() - start)


def line(row: Row) -> str:
    """A row as text."""
    return (
        f"{row.clients} clients: {row.per_second:.1f} a second, {row.p50:.1f} / {row.p99:.1f} ms, lost "
        f"{row.lost}, batches of {row.batch:.1f}, {row.per_second / row.in_process:.0%} of in process, "
        f"{row.memory[0]:.0f} -> {row.memory[1]:.0f} MB"
    )


def table(rows: Sequence[Row]) -> str:
    """All rows as a table in Markdown."""
    lines = [
        "| clients | a second | x one | p50 ms | p99 ms | batch | of in process | lost | memory MB |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        cells = [
            f"{row.clients}",
            f"{row.per_second:.1f}",
            f"{row.per_second / rows[0].per_second:.2f}",
            f"{row.p50:.1f}",
            f"{row.p99:.1f}",
            f"{row.batch:.1f}",
            f"{row.per_second / row.in_process:.0%}",
            f"{row.lost} of {row.requests}",
            f"{row.memory[0]:.0f}, {row.memory[1]:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
