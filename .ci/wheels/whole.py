"""Tests a whole policy as a user has it: an environment with NumPy and the wheel alone, a checkpoint, words.

    python .ci/wheels/whole.py WHEEL                        N1.5 at its published size, 4.8 GB on disk
    python .ci/wheels/whole.py WHEEL --small                a few MB
    python .ci/wheels/whole.py WHEEL --checkpoint FOLDER    a checkpoint that exists

Makes a virtual environment, installs the wheel, writes a random checkpoint with it (by the lab's source,
which needs NumPy alone), loads that at each precision in a process of its own and acts from arrays and an
instruction. Prints a table. A failure is named in its row, and the exit status is then 1. Needs Python's
standard library alone.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any

LAB = Path(__file__).resolve().parents[2] / "lab"

#: What may be installed.
EXPECTED = {"numpy", "pip", "saccade-vla", "setuptools"}

PRECISIONS = ("float32", "bfloat16", "int8")

#: 10^9 bytes that a policy of N1.5 with one embodiment may use at most, loading included.
MEMORY = {"int8": 2.6, "bfloat16": 4.6}

#: Runs in the new environment with the checkpoint and a precision; prints JSON.
PROGRAM = """
import json, sys, time
import numpy as np
import saccade

folder, precision = sys.argv[1:]
start = time.perf_counter()
policy = saccade.Policy.from_pretrained(folder, precision=precision)
loaded = time.perf_counter()
peak = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM:"))
example = policy.example_observation(seed=0)
rng = np.random.default_rng(0)
frames = {
    f"observation.images.{name}": rng.integers(0, 256, video.shape[2:], np.uint8)
    for name, video in example["video"].items()
}
state = np.concatenate([part[0, -1] for part in example["state"].values()])
observation = {**frames, "observation.state": state, "task": "open the drawer"}
begun = time.perf_counter()
actions = policy.act(observation, seed=0)
first = time.perf_counter()
again = policy.act(observation, seed=0)
second = time.perf_counter()
other = policy.act({**observation, "task": "push"}, seed=0)
modules = sorted({"torch", "transformers", "tokenizers", "PIL"} & set(sys.modules))
print(json.dumps({
    "shape": actions.shape,
    "finite": bool(np.isfinite(actions).all()),
    "repeats": bool(np.array_equal(actions, again)),
    "heeds_words": not np.array_equal(actions, other),
    "modules": modules,
    "load": loaded - start,
    "first": first - begun,
    "second": second - first,
    "memory": 1024 * peak / 1e9,
}))
"""


def main() -> int:
    """The exit status."""
    args = parse()
    folder = Path(tempfile.mkdtemp(prefix="saccade-whole-"))
    try:
        python = environment(folder / "venv", args.wheel)
        checkpoint = args.checkpoint or folder / "checkpoint"
        if args.checkpoint is None:
            size = ["--small"] if args.small else []
            run(python, "-m", "saccade_lab.random_checkpoint", checkpoint, *size, path=LAB)
        failed = False
        print(f"{'':10}{'load, s':>9}{'first, s':>10}{'second, s':>11}{'memory, GB':>12}  chunk")
        for precision in PRECISIONS:
            found = json.loads(run(python, "-I", "-c", PROGRAM, checkpoint, precision))
            problems = problems_of(found, precision, limited=not args.small)
            failed = failed or bool(problems)
            numbers = (
                f"{found['load']:9.2f}{found['first']:10.2f}{found['second']:11.2f}{found['memory']:12.2f}"
            )
            print(f"{precision:10}{numbers}  {found['shape']} {'; '.join(problems) or 'ok'}")
        return int(failed)
    finally:
        shutil.rmtree(folder)


def environment(folder: Path, wheel: Path) -> Path:
    """The interpreter of a new environment that holds the wheel and NumPy."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    run(python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", wheel)
    listed = json.loads(run(python, "-m", "pip", "--disable-pip-version-check", "list", "--format", "json"))
    unexpected = {package["name"] for package in listed} - EXPECTED
    if unexpected:
        raise SystemExit(
            f"the environment has more than NumPy and the wheel: {', '.join(sorted(unexpected))}"
        )
    return python


def problems_of(found: dict[str, Any], precision: str, *, limited: bool) -> list[str]:
    """What is wrong with a run; `limited` if the memory of the published size is tested."""
    checks = {
        "not a chunk of actions": len(found["shape"]) == 2 and min(found["shape"]) > 0,
        "not finite": found["finite"],
        "the same seed gave other actions": found["repeats"],
        "the instruction makes no difference": found["heeds_words"],
        f"imports {', '.join(found['modules'])}": not found["modules"],
    }
    if limited and precision in MEMORY:
        checks[f"more than {MEMORY[precision]} GB"] = found["memory"] <= MEMORY[precision]
    return [problem for problem, holds in checks.items() if not holds]


def run(*command: str | Path, path: Path | None = None) -> str:
    """The standard output of a command, which may import from `path`."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(
        list(map(str, command)),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=tempfile.gettempdir(),
        env=environment,
    )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command[:4]))} ended with status {done.returncode}")
    return done.stdout


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=lambda text: Path(text).resolve(), help="the wheel to install")
    parser.add_argument("--checkpoint", type=lambda text: Path(text).resolve(), help="default: a random one")
    parser.add_argument("--small", action="store_true", help="the random checkpoint is small")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
