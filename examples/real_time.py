"""A real-time loop on a CPU: System 2 slow, System 1 fast, and how punctual it is.

    python examples/real_time.py                          the shipped policy's head, 50 chunks a second
    python examples/real_time.py --size n1.5 --rate 0.5   GR00T N1.5's size, 1.5 GB of random weights

Two threads share one head. The slow one (System 2) sees: it gets features from the vision-language backbone
and encodes them, as often as it can. The fast one (System 1) acts: at control rate it samples a chunk of
actions from the latest `Context` and the newest state. What goes from one to the other is a reference, since
a `Context` never changes, and both release the interpreter: the next observation is encoded while chunks are
sampled from the last one.

Yours to replace is `Robot`: its backbone sleeps for some milliseconds, as if a GPU were at work, and returns
noise.
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
from saccade.bench import heads

Float32Array = NDArray[np.float32]
EMBODIMENT_ID = 0


class Robot:
    """Stands for cameras, joints and the backbone."""

    def __init__(self, config: saccade.HeadConfig, num_vl_tokens: int, backbone_seconds: float) -> None:
        self._random = np.random.default_rng(0)
        self._features = (1, num_vl_tokens, config.context_dim)
        self._state = np.zeros((1, config.state_dim), np.float32)
        self._backbone_seconds = backbone_seconds

    def backbone(self) -> Float32Array:
        """Features of what the cameras see now, `(1, T_vl, context_dim)`."""
        time.sleep(self._backbone_seconds)
        return self._random.standard_normal(self._features, dtype=np.float32)

    def read_state(self) -> Float32Array:
        """Where the joints are now, normalised, `(1, state_dim)`."""
        return self._state

    def send(self, actions: Float32Array) -> None:
        """The chunk to follow from now on, `(1, horizon, action_dim)`, normalised."""
        self._state[0, : actions.shape[-1]] += 0.01 * np.tanh(actions[0, 0, : self._state.shape[1]])


@dataclass(frozen=True)
class Observation:
    """What System 2 leaves for System 1."""

    context: saccade.Context
    seen: float  # when its pictures were taken, on time.perf_counter


class System2(threading.Thread):
    """Encodes one observation after the other; `latest` is the newest that is done."""

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
        """Until `stop`."""
        while not self._stop_asked.is_set():
            self.latest = self._observe()  # one reference: no lock is needed

    def stop(self) -> None:
        """Ends the thread after the observation that it is at."""
        self._stop_asked.set()
        self.join()


@dataclass
class Punctuality:
    """Seconds of every tick of System 1."""

    late: list[float] = field(default_factory=list)  # from when the tick was due to when it began
    sample: list[float] = field(default_factory=list)  # from its beginning to the actions
    age: list[float] = field(default_factory=list)  # of the pictures behind the actions
    missed: int = 0  # ticks that were over before their actions came


def act(head: saccade.ActionHead, robot: Robot, system2: System2, rate: float, seconds: float) -> Punctuality:
    """System 1: `rate` chunks a second for so many `seconds`."""
    config, record = head.config, Punctuality()
    random = np.random.default_rng(1)
    actions = np.empty((1, config.action_horizon, config.action_dim), np.float32)
    period, due = 1 / rate, time.perf_counter()
    end = due + seconds
    while due < end:
        # Absolute times: what one tick is late does not delay the next.
        time.sleep(max(0.0, due - time.perf_counter()))
        begin = time.perf_counter()
        observation = system2.latest
        head.sample(observation.context, robot.read_state(), EMBODIMENT_ID, seed=random, out=actions)
        robot.send(actions)
        done = time.perf_counter()
        record.late.append(begin - due)
        record.sample.append(done - begin)
        record.age.append(done - observation.seen)
        # The robot goes on along the last chunk while a tick is missed: it has `horizon` actions.
        over = int((done - due) / period)
        record.missed += over
        due += (over + 1) * period
    return record


def histogram(title: str, seconds: list[float]) -> list[str]:
    """How often which power of two of microseconds was reached, under the quantiles in milliseconds."""
    if not seconds:
        return [f"{title}: never"]
    low, median, high, most = (1e3 * np.quantile(seconds, part) for part in (0, 0.5, 0.99, 1))
    lines = [f"{title}, ms: least {low:.2f}, median {median:.2f}, 99 % {high:.2f}, most {most:.2f}"]
    powers = np.ceil(np.log2(np.maximum(1e6 * np.asarray(seconds), 1))).astype(int)
    for power in range(powers.min(), powers.max() + 1):
        count = int((powers == power).sum())
        bar = "#" * int(np.ceil(50 * count / len(powers)))
        lines.append(f"  up to {2.0**power / 1e3:9.3f} ms {count:6d} {bar}")
    return lines


def load(args: argparse.Namespace) -> saccade.ActionHead:
    """The head that was asked for."""
    if args.size == "demo":
        with importlib.resources.as_file(importlib.resources.files("saccade") / "sim" / "demo") as folder:
            return saccade.ActionHead.load(folder, num_threads=args.threads)
    with tempfile.TemporaryDirectory(prefix="saccade-real-time-") as name:
        heads.write(Path(name), heads.sized("n1.5"))
        return saccade.ActionHead.load(name, num_threads=args.threads)


def main() -> None:
    """Runs both systems and prints how punctual the fast one was."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", choices=("demo", "n1.5"), default="demo", help="which head (default demo)")
    parser.add_argument("--rate", type=float, default=50, help="chunks a second (default 50)")
    parser.add_argument("--seconds", type=float, default=5, help="how long (default 5)")
    parser.add_argument("--backbone-ms", type=float, default=100, help="what a backbone takes (default 100)")
    parser.add_argument("--threads", type=int, help="threads of the head (default: the physical cores)")
    args = parser.parse_args()
    if args.rate <= 0 or args.seconds <= 0 or args.backbone_ms < 0:
        parser.error("--rate, --seconds: expected more than 0; --backbone-ms: expected at least 0")
    if args.threads is not None and args.threads < 1:
        parser.error(f"--threads: expected at least 1, got {args.threads}")

    num_vl_tokens = 296 if args.size == "n1.5" else 57
    head = load(args)
    # Memory is claimed and threads are started before the robot moves.
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
        f"System 1: {args.rate:g} a second for {args.seconds:g} s, "
        f"{len(record.late)} chunks, {record.missed} deadlines missed"
    )
    for title, values in (
        ("tick begins after it was due", record.late),
        ("state to actions", record.sample),
        ("pictures to actions", record.age),
        ("System 2, encoding", system2.seconds),
    ):
        print("\n".join(histogram(title, values)))


if __name__ == "__main__":
    main()
