"""Runs the studies of docs/protocol.md and prints what they cost, as a table in Markdown.

    python -m saccade.checkpoints.random_checkpoint full
    python docs/measure_protocol.py frames full table
    python docs/measure_protocol.py run full table --out out/protocol

`frames` renders the simulator as the pictures of a robot with the cameras of the checkpoint: the first moment
of two episodes, of 640 x 480 pixels, with the state in the middle of the robot's range. `run` takes the
commands from the page, with other names for checkpoint, pictures and output, and runs one after the other.
CPU time and peak memory are those of the whole command as the kernel counts them, loading included; both hold
on a machine that other programs share. Needs the extra `sim` for `frames`.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from PIL import Image

import saccade
from saccade._internal.environment import cpu_name

PAGE = Path(__file__).resolve().parent / "protocol.md"
WIDTH, HEIGHT = 640, 480
EPISODES = {"push": 0, "two-goals": 1}  # task and seed


def render(args: argparse.Namespace) -> None:
    """Writes the pictures."""
    from saccade_lab.sim.cameras import DEFAULT_CAMERAS
    from saccade_lab.sim.environment import TaskEnvironment

    cameras = saccade.Policy.from_pretrained(args.checkpoint).requirements.cameras or ()
    for task, seed in EPISODES.items():
        world = TaskEnvironment(task, image_size=WIDTH, cameras=DEFAULT_CAMERAS[: len(cameras)])
        images, _ = world.reset(seed=seed)
        folder = args.frames / task / "1"
        folder.mkdir(parents=True)
        for camera, image in zip(cameras, images["images"].values(), strict=True):
            top = (WIDTH - HEIGHT) // 2
            Image.fromarray(image[top : top + HEIGHT]).save(folder / f"{camera.name}.png")
        world.close()
    print(f"{args.frames}: {len(EPISODES)} moments of {len(cameras)} cameras")


def page_commands() -> list[list[str]]:
    """The arguments of each `saccade study` on the page that measures something."""
    blocks = re.findall(r"^```bash\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = re.sub(r"\s*\\\n\s*", " ", "".join(blocks)).splitlines()
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("saccade study")]
    return [command for command in commands if "--frames" in command]


def measure(args: argparse.Namespace) -> None:
    """Runs the commands and prints the table."""
    print(
        f"{cpu_name()}, {os.cpu_count()} cores\n\n| command | CPU time | peak memory |\n|---|---|---|",
        flush=True,
    )
    values = {"--checkpoint": args.checkpoint, "--frames": args.frames, "--out": args.out}
    for command in page_commands():
        given = list(command)
        for option, value in values.items():
            given[given.index(option) + 1] = str(value)
        if args.only and given[1] not in args.only:
            continue
        if args.blocks and given[1] == "patching":
            given += ["--blocks", args.blocks]
        process = subprocess.Popen([sys.executable, "-m", "saccade", *given], stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{shlex.join(given)}: ended with {process.returncode}")
        seconds, memory = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9
        options = shlex.join(given[given.index("--out") + 2 :])
        print(
            f"| `{' '.join(['study', given[1], options]).strip()}` | {seconds:.0f} s | {memory:.1f} GB |",
            flush=True,
        )


def main() -> None:
    """Runs one of the two."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(required=True)
    for name, about, function in (
        ("frames", "render pictures", render),
        ("run", "run and measure the commands", measure),
    ):
        one = kinds.add_parser(name, help=about)
        one.add_argument("checkpoint", type=Path, help="a whole checkpoint")
        one.add_argument("frames", type=Path, help="directory of the pictures")
        one.set_defaults(run=function)
    one.add_argument("--out", type=Path, required=True, help="directory of the tables")
    one.add_argument("--blocks", help="those of patching (default: all)")
    one.add_argument("--only", nargs="+", help="names of the studies (default: all)")
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
