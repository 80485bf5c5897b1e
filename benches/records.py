"""The records of numbers in guides: what a command printed, with commit and CPU.

    python -m benches.records       from a clean tree; a few minutes

Writes `benches/results/NAME.json`. Each file names its command.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import saccade
from benches.files import write_record
from benches.pages.report import require_commit
from benches.peers import machine

RESULTS = Path(__file__).with_name("results")
DEMO = "saccade.demo_checkpoint()"
ROLLOUT = "rollout --seed 1000 --episodes 20 --num-threads 1"
PARITY = f"parity --checkpoint {DEMO} --num-vl-tokens 64 --batch 8 --num-threads 1"

#: What is written, by name: arguments of `saccade`.
COMMANDS = {
    "parity": "parity --num-threads 1",
    "precision-bfloat16": f"{PARITY} --precision bfloat16",
    "precision-int8": f"{PARITY} --precision int8",
    "precision-int4": f"{PARITY} --precision int4",
    "simulation-rust": f"{ROLLOUT} --engine rust",
    "simulation-torch": f"{ROLLOUT} --engine torch",
}


def record(name: str) -> dict[str, Any]:
    """Runs a command.

    Args:
        name: In `COMMANDS`.

    Returns:
        The command, and what it printed.
    """
    demo = str(saccade.demo_checkpoint())
    arguments = [demo if word == DEMO else word for word in shlex.split(COMMANDS[name])]
    with tempfile.TemporaryDirectory() as folder:  # a rollout writes out/rollout
        done = subprocess.run(
            [sys.executable, "-m", "saccade", *arguments, "--json"],
            cwd=folder,
            stdout=subprocess.PIPE,
            check=True,
        )
    printed = json.loads(done.stdout.decode().replace(demo, DEMO))
    return {"command": f"saccade {COMMANDS[name]} --json", "printed": printed}


def main() -> int:
    """Writes all records."""
    here = machine.describe()  # before the first file changes the tree
    require_commit(here, RESULTS)
    RESULTS.mkdir(exist_ok=True)
    for name in COMMANDS:
        path = RESULTS / f"{name}.json"
        write_record(path, {"machine": here, **record(name)})
        print(path, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
