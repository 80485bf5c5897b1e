"""Times calls of a policy in two trees of this repository, in turns: what a change costs or saves.

    python -m benches.trees OLD NEW              the bundled policy: act, encode, act with previous
    python -m benches.trees OLD NEW --checkpoint PATH --num-threads 1 --rounds 60

Each tree is a directory with `python/saccade`, its extension module built into it. Each has a process of its
own that imports saccade from it. They get the same observation and noise, and one waits while the other
computes. The actions must have the same bits. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

#: The program of each process. It answers each line, a number of calls, with seconds by kind of call.
PROGRAM = """
import hashlib, json, sys, time
import numpy as np
import saccade

checkpoint, num_threads, embodiment = json.loads(sys.argv[1])
policy = saccade.Policy.from_pretrained(
    checkpoint or saccade.demo_checkpoint(), num_threads=num_threads, embodiment=embodiment
)
observation = policy.example_observation(seed=0)
config = policy.head.config
shape = (1, config.action_horizon, config.encoder_action_dim)
noise = np.random.default_rng(0).standard_normal(shape, dtype=np.float32)
held = policy.encode(observation)
calls = {
    "act": lambda: policy.act(observation, noise=noise),
    "encode": lambda: policy.encode(observation),
    "act, previous": lambda: policy.act(observation, noise=noise, previous=held),
}
bits = hashlib.sha256(b"".join(np.asarray(part).tobytes() for part in calls["act"]().values())).hexdigest()
print(json.dumps({"bits": bits, "file": saccade.__file__}), flush=True)
for line in sys.stdin:
    found = {}
    for name, call in calls.items():
        call()
        found[name] = []
        for _ in range(int(line)):
            start = time.perf_counter()
            call()
            found[name].append(time.perf_counter() - start)
    print(json.dumps(found), flush=True)
"""


class Tree:
    """A process with the policy of one tree."""

    def __init__(self, tree: Path, options: list[Any]) -> None:
        # Nothing of the directory that this runs in, nor of the environment's own saccade, is imported.
        environment = os.environ | {"PYTHONPATH": str(tree / "python"), "PYTHONSAFEPATH": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, json.dumps(options)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        begun = self._read()
        if not Path(begun["file"]).is_relative_to(tree):
            raise SystemExit(f"{tree}: saccade was imported from {begun['file']}")
        self.bits: str = begun["bits"]
        self.seconds: dict[str, list[float]] = {}

    def measure(self, count: int) -> None:
        """Adds the seconds of some calls."""
        assert self._process.stdin is not None
        print(count, file=self._process.stdin, flush=True)
        for name, seconds in self._read().items():
            self.seconds.setdefault(name, []).extend(seconds)

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"a process ended with code {self._process.wait()}")
        read: dict[str, Any] = json.loads(line)
        return read


def main() -> int:
    """Measures and prints the milliseconds of each call in both trees."""
    parser = argparse.ArgumentParser(prog="python -m benches.trees", description=__doc__)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--checkpoint", help="default: the bundled policy of each tree")
    parser.add_argument("--embodiment")
    parser.add_argument("--num-threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=30, help="turns of each tree")
    parser.add_argument("--calls", type=int, default=20, help="calls of a kind in a turn")
    args = parser.parse_args()
    options = [args.checkpoint, args.num_threads, args.embodiment]
    trees = [Tree(tree.resolve(), options) for tree in (args.old, args.new)]
    for _ in range(args.rounds):
        for tree in trees:
            tree.measure(args.calls)
    for tree in trees:
        tree.close()
    old, new = trees
    if old.bits != new.bits:
        raise SystemExit("the actions of the two trees differ")
    print(f"{'milliseconds':15}{'old':>18}{'new':>18}   old / new")
    for name, before in old.seconds.items():
        shown = [
            f"{1e3 * min(times):8.3f} {1e3 * statistics.median(times):8.3f}"
            for times in (before, new.seconds[name])
        ]
        ratios = [f"{least(before) / least(new.seconds[name]):.3f}" for least in (min, statistics.median)]
        print(f"{name:15}{shown[0]:>18}{shown[1]:>18}   {' '.join(ratios)}")
    print("each: least and median")
    return 0


if __name__ == "__main__":
    sys.exit(main())
