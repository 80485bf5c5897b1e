"""Load on `saccade serve` over loopback: throughput, latency, memory, and what serving costs.

    python -m benches.serve                                        the bundled policy, 20,000 requests by each
                                                                   number of clients
    python -m benches.serve --requests 400 --rounds 2              quick
    python -m benches.serve --random DIR --precision int8 --clients 1 4 16 --requests 48 --rounds 3
                                                                   N1.5 at its published size, random weights,
                                                                   written to DIR first (4.8 GB)
    python -m benches.serve report [--write]                       the tables; --write: docs/results/serve.md

One server in a process of its own answers all. In each round every number of clients sends its part of the
requests, so that a disturbance of the machine meets them all. The clients share one process, which sends
messages that were packed before, so that they take little of the machine; each sends its next request when it
has its answer. Every answer is unpacked and counted.

After each of these parts the server rests, and this process computes batches of the sizes that the server has
just reported, with `policy.act`. "Of in process" is the server's throughput divided by this one.
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
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

import saccade
from benches import checkpoints, serve_report
from benches.pages.report import report
from benches.peers import machine
from saccade._internal.files import write_json
from saccade.serve.packing import pack

DEMO = saccade.demo_checkpoint()
#: Different observations; each client sends one after the other.
OBSERVATIONS = 8
#: Seconds of batches that are computed in process in each round.
COMPARED_SECONDS = 2.0
START_SECONDS = 900.0
#: The log has a line of each request within so many seconds, unless lines were lost.
LOG_SECONDS = 10.0
#: A client is not expected any more after a second without a request.
REST_SECONDS = 1.2


@dataclass
class Row:
    """What was measured with a number of clients. Lists have one value a round.

    Attributes:
        clients: Their number.
        requests: Number of requests of all rounds.
        lost: Requests without an answer, or with an error.
        per_second: Answers a second.
        in_process: Observations a second that `policy.act` computes in batches of the same sizes.
        memory: Resident memory of the server after its part of the round, in MB.
        batches: Number of batches by their size.
        server_cpu, client_cpu: Processor time for each request, in milliseconds.
        p50, p99: Latency as a client sees it, in milliseconds.
    """

    clients: int
    requests: int = 0
    lost: int = 0
    per_second: list[float] = field(default_factory=list)
    in_process: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    batches: dict[int, int] = field(default_factory=dict)
    server_cpu: list[float] = field(default_factory=list)
    client_cpu: list[float] = field(default_factory=list)
    p50: float = 0.0
    p99: float = 0.0


def main(arguments: list[str] | None = None) -> int:
    """The exit status: 1 if an answer was lost."""
    args = parse(arguments)
    path: Path = args.out / "results.json"
    if args.command == "report":
        return report(
            path,
            serve_report.COMMITTED,
            serve_report.PAGE,
            serve_report.document,
            program="benches.serve",
            write=args.write,
        )
    checkpoint = DEMO if args.random is None else checkpoints.written(args.random)
    options = {"precision": args.precision, "num_threads": args.num_threads}
    policy = saccade.Policy.from_pretrained(checkpoint, **options)
    observations = [policy.example_observation(seed) for seed in range(OBSERVATIONS)]
    rows = {clients: Row(clients) for clients in args.clients}
    latencies: dict[int, list[float]] = {clients: [] for clients in args.clients}
    name = "demo" if args.random is None else "full"
    path.parent.mkdir(parents=True, exist_ok=True)
    # What was measured of the other policy is kept.
    before = next((one for one in (path, serve_report.COMMITTED) if one.exists()), None)
    results = {} if before is None else json.loads(before.read_text())
    here = machine.describe()
    with server(checkpoint, args, path.with_name(f"{name}.jsonl")) as running:
        load(running, observations, 1, 2)  # the first request allocates memory
        running.batches(2)
        for number in range(args.rounds):
            for clients, row in rows.items():
                time.sleep(REST_SECONDS)
                requests = args.requests * (number + 1) // args.rounds - args.requests * number // args.rounds
                found = load(running, observations, clients, requests)
                batches = running.batches(requests)
                latencies[clients] += found.latencies
                row.requests += requests
                row.lost += requests - len(found.latencies)
                row.per_second.append(len(found.latencies) / found.seconds)
                row.server_cpu.append(1e3 * found.server_cpu / requests)
                row.client_cpu.append(1e3 * found.client_cpu / requests)
                row.memory.append(running.memory())
                row.batches = dict(Counter(row.batches) + batches)
                row.in_process.append(rate_in_process(policy, observations, batches))
                print(f"round {number + 1}: {line(row)}", flush=True)
            for clients, row in rows.items():
                row.p50, row.p99 = (1e3 * float(at) for at in np.percentile(latencies[clients], (50, 99)))
            results[name] = {
                "precision": args.precision,
                "num_threads": policy.head.num_threads,
                "machine": here,
                "rows": [asdict(row) for row in rows.values()],
            }
            write_json(path, results)
    print(f"wrote {path}")
    return int(any(row.lost for row in rows.values()))


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", nargs="?", choices=("run", "report"), default="run")
    parser.add_argument("--write", action="store_true", help="report: into docs/results/serve.md")
    parser.add_argument(
        "--random", type=Path, metavar="DIR", help="a random checkpoint of full size, written if missing"
    )
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 4, 16, 64], metavar="N")
    parser.add_argument(
        "--requests", type=int, default=20_000, metavar="N", help="for each number of clients"
    )
    parser.add_argument("--rounds", type=int, default=10, metavar="N")
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--num-threads", type=int, metavar="N")
    parser.add_argument("--out", type=Path, default=Path("out/serve"), metavar="DIR")
    args = parser.parse_args(arguments)
    if min(args.clients) < 1 or args.requests < args.rounds * max(args.clients):
        parser.error("expected at least one request for each client and round")
    return args


class Running:
    """A server in a process.

    Args:
        process: The process.
        log: The file with its log.
    """

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self._process = process
        self._log = log.open()
        end = time.monotonic() + START_SECONDS
        while not (first := self._log.readline()).endswith("\n"):
            if time.monotonic() > end or process.poll() is not None:
                raise RuntimeError("the server did not start")
            self._log.seek(0)
            time.sleep(0.05)
        self.port = int(json.loads(first)["address"].rpartition(":")[2])

    def batches(self, requests: int) -> Counter[int]:
        """Number of batches by their size: of n observations, n requests say so.

        Args:
            requests: Number of requests since the last call; waits until the log has so many.
        """
        sizes: Counter[int] = Counter()
        text, end = "", time.monotonic() + LOG_SECONDS
        while requests and time.monotonic() < end:
            text += self._log.readline()
            if not text.endswith("\n"):
                time.sleep(0.01)
                continue
            one, text = json.loads(text), ""
            if one["event"] == "request":
                requests -= 1
                if one.get("batch"):
                    sizes[one["batch"]] += 1
        return Counter({size: max(1, round(count / size)) for size, count in sizes.items()})

    def memory(self) -> float:
        """Resident memory in MB."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        found = re.search(r"^VmRSS:\s*(\d+) kB", status, re.MULTILINE)
        return 0.0 if found is None else int(found[1]) / 1e3

    def cpu(self) -> float:
        """Processor time in seconds."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def server(checkpoint: Path, args: argparse.Namespace, log: Path) -> Iterator[Running]:
    """A server in a process.

    Raises:
        RuntimeError: It does not start, or does not end with status 0.
    """
    command = [sys.executable, "-m", "saccade", "serve", str(checkpoint), "--port", "0", "--log", "json"]
    command += ["--precision", args.precision, "--request-seconds", "3600"]
    if args.num_threads is not None:
        command += ["--num-threads", str(args.num_threads)]
    with log.open("wb") as output, subprocess.Popen(command, stdout=output) as process:
        try:
            yield Running(process, log)
        finally:
            process.send_signal(signal.SIGTERM)
            status = process.wait(60)
        if status:
            raise RuntimeError(f"the server ended with status {status}")


@dataclass
class Load:
    """What the clients saw: seconds of each answer that is no error, of all, and of the processors."""

    latencies: list[float]
    seconds: float
    server_cpu: float
    client_cpu: float


def load(running: Running, observations: Sequence[Any], clients: int, requests: int) -> Load:
    """Sends requests, each client the next one when it has its answer."""
    messages = [
        pack({"endpoint": "get_action", "data": {"observation": seen, "options": {"seed": seed}}})
        for seed, seen in enumerate(observations)
    ]
    left, sent = itertools.count(), {}
    latencies: list[float] = []
    poller, context = zmq.Poller(), zmq.Context()
    sockets = [context.socket(zmq.REQ) for _ in range(clients)]

    def send(one: zmq.Socket[bytes]) -> None:
        number = next(left)
        if number < requests:
            sent[one] = time.perf_counter()
            one.send(messages[number % len(messages)])

    start, client_cpu, server_cpu = time.perf_counter(), time.process_time(), running.cpu()
    for one in sockets:
        one.setsockopt(zmq.LINGER, 0)
        one.connect(f"tcp://127.0.0.1:{running.port}")
        poller.register(one, zmq.POLLIN)
        send(one)
    while sent and (ready := poller.poll(120_000)):
        for one, _ in ready:
            answer = msgpack.unpackb(one.recv())
            elapsed = time.perf_counter() - sent.pop(one)
            if isinstance(answer, list):
                latencies.append(elapsed)
            send(one)
    found = Load(
        latencies,
        time.perf_counter() - start,
        running.cpu() - server_cpu,
        time.process_time() - client_cpu,
    )
    context.destroy(linger=0)
    return found


def rate_in_process(policy: saccade.Policy, observations: Sequence[Any], batches: Counter[int]) -> float:
    """Observations a second of `policy.act` in batches of these sizes."""

    def act(size: int) -> None:
        policy.act([observations[row % len(observations)] for row in range(size)], seed=0)

    # In an order in which every beginning has the same mixture of sizes.
    sizes = [(turn + 0.5) / count for size, count in batches.items() for turn in range(count)]
    names = [size for size, count in batches.items() for _ in range(count)]
    order = [names[place] for place in np.argsort(sizes, kind="stable")]
    act(order[0])
    count, start = 0, time.perf_counter()
    for size in order:
        act(size)
        count += size
        if time.perf_counter() - start > COMPARED_SECONDS:
            break
    return count / (time.perf_counter() - start)


def line(row: Row) -> str:
    """The latest round as text."""
    return (
        f"{row.clients} clients: {row.per_second[-1]:.1f} a second, lost {row.lost}, "
        f"{row.per_second[-1] / row.in_process[-1]:.0%} of in process, {row.memory[-1]:.0f} MB"
    )


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
