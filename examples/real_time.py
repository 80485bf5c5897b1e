"""A real-time loop on a CPU: a slow System 2, a fast System 1, and a report of missed deadlines.

    python examples/real_time.py                          the bundled policy's head, 50 chunks per second
    python examples/real_time.py --size n1.5 --rate 0.5   GR00T N1.5's size, 1.5 GB of random weights

Two threads share one head. The slow thread (System 2) gets features from the vision-language backbone and
encodes them, as often as it can. The fast thread (System 1) samples a chunk of actions at control rate from
the latest `Context` and the newest state. The threads exchange a reference, because a `Context` never
changes. Both release the interpreter, so the next observation is encoded while chunks are sampled from the
last one.

Replace `Robot` by your own: here its backbone sleeps for some milliseconds, as if a GPU were working, and
returns noise.
"""

from __future__ import annotations

import argparse
import importlib.resources
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import saccade
from saccade_lab.random_checkpoint.head import config_of_size, write_head

Float32Array = NDArray[np.float32]
EMBODIMENT_ID = 0


class Robot:
    """A stand-in for cameras, joints and the backbone."""

    def __init__(self, config: saccade.HeadConfig, num_vl_tokens: int, backbone_seconds: float) -> None:
        self._random = np.random.default_rng(0)
        self._features = (1, num_vl_tokens, config.context_dim)
        self._state = np.zeros((1, config.state_dim), np.float32)
        self._backbone_seconds = backbone_seconds

    def backbone(self) -> Float32Array:
        """Features of the current camera images, `(1, T_vl, context_dim)`."""
        time.sleep(self._backbone_seconds)
        return self._random.standard_normal(self._features, dtype=np.float32)

    def read_state(self) -> Float32Array:
        """The current joint positions, normalised, `(1, state_dim)`."""
        return self._state

    def send(self, actions: Float32Array) -> None:
        """Sets the chunk to execute from now on, `(1, horizon, action_dim)`, normalised."""
        self._state[0, : actions.shape[-1]] += 0.01 * np.tanh(actions[0, 0, : self._state.shape[1]])


@dataclass(frozen=True)
class Observation:
    """What System 2 passes to System 1."""

    context: saccade.Context
    seen: float  # when its images were taken, by time.perf_counter


class System2(threading.Thread):
    """Encodes one observation after another; `latest` is the newest finished one."""

    def __init__(self, head: saccade.ActionHead, robot: Robot) -> None:
        super().__init__(name="system-2", daemon=True)
        self._head, self._robot = head, robot
        self._stop_asked = threading.Event()
        self.seconds: list[float] = []
        self.latest = self._observe()  # so that System 1 has something from the start

    def _observe(self) -> Observation:
        seen = time.perf_counter()
        features = self._robot.backbone()
        start = time.perf_counter()
        context = self._head.encode(features)
        self.seconds.append(time.perf_counter() - start)
        return Observation(context, seen)

    def run(self) -> None:
        """Runs until `stop`."""
        while not self._stop_asked.is_set():
            self.latest = self._observe()  # one reference: no lock is needed

    def stop(self) -> None:
        """Ends the thread after its current observation."""
        self._stop_asked.set()
        self.join()


@dataclass
class Punctuality:
    """Seconds of every tick of System 1."""

    late: list[float] = field(default_factory=list)  # from the due time of the tick to its start
    sample: list[float] = field(default_factory=list)  # from the start of the tick to its actions
    age: list[float] = field(default_factory=list)  # of the images behind the actions
    missed: int = 0  # ticks that ended before their actions were ready


def act(head: saccade.ActionHead, robot: Robot, system2: System2, rate: float, seconds: float) -> Punctuality:
    """System 1: samples `rate` chunks per second for `seconds` seconds."""
    config, record = head.config, Punctuality()
    random = np.random.default_rng(1)
    actions = np.empty((1, config.action_horizon, config.action_dim), np.float32)
    period, due = 1 / rate, time.perf_counter()
    end = due + seconds
    while due < end:
        # Due times are absolute, so a late tick does not delay the next one.
        time.sleep(max(0.0, due - time.perf_counter()))
        begin = time.perf_counter()
        observation = system2.latest
        head.sample(observation.context, robot.read_state(), EMBODIMENT_ID, seed=random, out=actions)
        robot.send(actions)
        done = time.perf_counter()
        record.late.append(begin - due)
        record.sample.append(done - begin)
        record.age.append(done - observation.seen)
        # During a missed tick the robot keeps executing the last chunk, which has `horizon` actions.
        over = int((done - due) / period)
        record.missed += over
        due += (over + 1) * period
    return record


def histogram(title: str, seconds: list[float]) -> list[str]:
    """Quantiles in milliseconds, and a histogram over powers of two of microseconds."""
    if not seconds:
        return [f"{title}: never"]
    low, median, high, most = (1e3 * np.quantile(seconds, part) for part in (0, 0.5, 0.99, 1))
    lines = [f"{title}, ms: min {low:.2f}, median {median:.2f}, p99 {high:.2f}, max {most:.2f}"]
    powers = np.ceil(np.log2(np.maximum(1e6 * np.asarray(seconds), 1))).astype(int)
    for power in range(powers.min(), powers.max() + 1):
        count = int((powers == power).sum())
        bar = "#" * int(np.ceil(50 * count / len(powers)))
        lines.append(f"  up to {2.0**power / 1e3:9.3f} ms {count:6d} {bar}")
    return lines


def load(args: argparse.Namespace) -> saccade.ActionHead:
    """Loads the head of the chosen size."""
    if args.size == "demo":
        with importlib.resources.as_file(saccade.demo_checkpoint()) as folder:
            return saccade.ActionHead.from_pretrained(folder, num_threads=args.num_threads)
    with tempfile.TemporaryDirectory(prefix="saccade-real-time-") as name:
        write_head(Path(name), config_of_size("n1.5"))
        return saccade.ActionHead.from_pretrained(name, num_threads=args.num_threads)


def main() -> None:
    """Runs both systems and prints the timing of the fast one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", choices=("demo", "n1.5"), default="demo", help="which head (default demo)")
    parser.add_argument("--rate", type=float, default=50, help="chunks per second (default 50)")
    parser.add_argument("--seconds", type=float, default=5, help="duration (default 5)")
    parser.add_argument("--backbone-ms", type=float, default=100, help="time of the backbone (default 100)")
    parser.add_argument("--num-threads", type=int, help="threads of the head (default: the physical cores)")
    args = parser.parse_args()
    if args.rate <= 0 or args.seconds <= 0 or args.backbone_ms < 0:
        parser.error("--rate, --seconds: expected more than 0; --backbone-ms: expected at least 0")
    if args.num_threads is not None and args.num_threads < 1:
        parser.error(f"--num-threads: expected at least 1, got {args.num_threads}")

    num_vl_tokens = 296 if args.size == "n1.5" else 57
    head = load(args)
    # Allocate memory and start threads before the robot moves.
    head.warmup(num_vl_tokens)
    robot = Robot(head.config, num_vl_tokens, args.backbone_ms / 1e3)
    system2 = System2(head, robot)
    system2.start()
    try:
        record = act(head, robot, system2, args.rate, args.seconds)
    finally:
        system2.stop()

    print(head)
    print(
        f"System 1: {args.rate:g} per second for {args.seconds:g} s, "
        f"{len(record.late)} chunks, {record.missed} deadlines missed"
    )
    for title, values in (
        ("start of a tick after its due time", record.late),
        ("state to actions", record.sample),
        ("images to actions", record.age),
        ("System 2, encoding", system2.seconds),
    ):
        print("\n".join(histogram(title, values)))


if __name__ == "__main__":
    main()
