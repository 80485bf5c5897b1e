"""A control loop: an action every 100 ms while a policy encodes and samples in the background.

    python examples/control_loop.py --small               a small random checkpoint, a few seconds
    python examples/control_loop.py                       N1.5's size, random: writes 4.8 GB once
    python examples/control_loop.py --busy                also with as many busy processes as cores
    python examples/control_loop.py --checkpoint my-policy --cameras front

The control thread does nothing but wait for the next tick and send one action of the current chunk. The
policy's thread takes the newest frames, encodes and samples, and passes the chunk on as one reference. While
it computes, the robot goes on with the last chunk, so it hands that chunk to `sample`: the actions that will
be executed meanwhile are frozen, and the new chunk continues from them (`saccade.Chunking`).

The control thread is not starved although the policy computes on all cores. Every call of the policy releases
the interpreter; the thread asks for a real-time priority, which Linux grants to root and by `ulimit -r`; and
without it a thread that mostly sleeps still runs before one that always computes. A core kept free for it
would idle, and the chunks would be older.

Printed are the age of the frames behind each action, the jitter of the ticks, and the ticks that were missed:
sent a period late, or without an action because the chunk had come to its end, when the robot holds the last.
Replace `Robot` by your own.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from real_time import histogram

import saccade
from saccade_lab import random_checkpoint

Actions = dict[str, Any]

DEFAULT_CHECKPOINT = Path("out/control-loop/n15")


class Robot:
    """A stand-in for cameras and joints, in the form that the policy's `example_observation` has."""

    def __init__(self, policy: saccade.Policy, instruction: str) -> None:
        # A few noisy images by turns: as new as a camera's, and they cost no time.
        self._observations = [policy.example_observation(seed) for seed in range(4)]
        for observation in self._observations:
            observation["language"] = {key: [[instruction]] for key in observation["language"]}
        self._num_observed = 0
        self.sent: Actions = {}

    def observe(self) -> dict[str, Any]:
        """The newest frames and joint positions."""
        self._num_observed += 1
        return self._observations[self._num_observed % len(self._observations)]

    def send(self, action: Actions) -> None:
        """Moves towards an action, `{part: (width,)}`, in the robot's units."""
        self.sent = action


@dataclass(frozen=True)
class Plan:
    """A chunk, and when its frames were taken."""

    chunk: Actions  # as the policy returned it, {part: (1, horizon, width)}
    tick: int  # that its first action is for
    seen: float  # by time.perf_counter

    def action(self, tick: int) -> Actions | None:
        """The action of a tick; None behind the end of the chunk."""
        index = tick - self.tick
        if index >= self.horizon:
            return None
        return {part: values[0, index] for part, values in self.chunk.items()}

    @property
    def horizon(self) -> int:
        """Number of actions."""
        return int(next(iter(self.chunk.values())).shape[1])


class Thinker(threading.Thread):
    """Observes, encodes and samples, again and again; `plan` is the newest chunk."""

    def __init__(self, policy: saccade.Policy, robot: Robot, rate: float) -> None:
        super().__init__(name="policy", daemon=True)
        self._policy, self._robot, self._rate = policy, robot, rate
        self._random = np.random.default_rng(0)
        self._stop_asked = threading.Event()
        self._context: saccade.PolicyContext | None = None
        self.recent: deque[float] = deque(maxlen=4)  # seconds that the last chunks took
        self.tick = -1  # the last one that was sent
        self.encoding: list[float] = []
        self.sampling: list[float] = []
        self._error: BaseException | None = None
        # The first chunk is there before the robot moves. The second tells how long one takes.
        self.plan = self.next_plan(None)
        self.plan = self.next_plan(None)

    def next_plan(self, last: Plan | None) -> Plan:
        """A new chunk from the newest observation, which continues the last one if there is one."""
        tick, seen = self.tick + 1, time.perf_counter()
        observation = self._robot.observe()
        # Views that have not changed, and the instruction, are taken from the last context.
        context = self._policy.encode(observation, previous=self._context)
        encoded = time.perf_counter()
        options: dict[str, Any] = {}
        if last is not None and tick - last.tick < last.horizon:
            # What remains of the last chunk. Its first actions are executed before the new one is here.
            overlap = last.horizon - (tick - last.tick)
            frozen = min(self.delay, overlap)
            options = {
                "previous_chunk": last.chunk,
                "chunking": saccade.Chunking(overlap=overlap, frozen=frozen),
            }
        chunk = self._policy.sample(context, observation, seed=self._random, **options)
        done = time.perf_counter()
        self._context = context
        self.recent.append(done - seen)
        self.encoding.append(encoded - seen)
        self.sampling.append(done - encoded)
        # Without an overlap the robot has stood still since the frames, so it begins with the first action.
        return Plan(chunk, tick if options or last is None else self.tick + 1, seen)

    @property
    def delay(self) -> int:
        """Ticks from frames to actions, of the slowest of the last chunks, rounded up."""
        return math.ceil(max(self.recent) * self._rate)

    def run(self) -> None:
        """Runs until `stop`."""
        self.plan = Plan(self.plan.chunk, 0, self.plan.seen)  # the robot has not moved since
        try:
            while not self._stop_asked.is_set():
                self.plan = self.next_plan(self.plan)  # one reference: no lock is needed
        except BaseException as error:
            self._error = error
            self._stop_asked.set()

    @property
    def is_stopping(self) -> bool:
        """Whether there will be no more chunks: `stop` was called, or an error ended the thread."""
        return self._stop_asked.is_set()

    def ask_to_stop(self) -> None:
        """No more chunks after the current one."""
        self._stop_asked.set()

    def stop(self) -> None:
        """Ends the thread after its current chunk; raises what ended it before, if anything did."""
        self.ask_to_stop()
        self.join()
        if self._error is not None:
            raise self._error


@dataclass
class Record:
    """What happened in a run of the control loop, in seconds."""

    late: list[float] = field(default_factory=list)  # from the due time of a tick to its start
    age: list[float] = field(default_factory=list)  # of the frames behind the action that is sent
    missed: int = 0  # ticks that were due before the one before had been sent
    held: int = 0  # ticks without an action: the chunk had ended


def control(thinker: Thinker, robot: Robot, rate: float, seconds: float) -> Record:
    """The control loop: `rate` ticks a second."""
    record, period = Record(), 1 / rate
    start, tick = time.perf_counter(), 0
    while tick < seconds * rate and not thinker.is_stopping:
        # Due times are absolute, so a late tick does not delay the next one.
        due = start + tick * period
        time.sleep(max(0.0, due - time.perf_counter()))
        begin = time.perf_counter()
        plan = thinker.plan  # before the tick is told, so its first action is never for a later one
        thinker.tick = tick
        action = plan.action(tick)
        if action is None:
            record.held += 1  # the robot holds the last action
        else:
            robot.send(action)
        record.late.append(begin - due)
        record.age.append(begin - plan.seen)
        over = int((time.perf_counter() - due) / period)
        record.missed += over
        tick += over + 1
    return record


def prefer_this_thread() -> str:
    """Asks for a real-time priority for the calling thread alone; says what it got."""
    if hasattr(os, "SCHED_FIFO"):
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
        except OSError:
            return "normal priority"
        return "real-time priority"
    return "normal priority"


def spin() -> None:
    """A busy process."""
    while True:
        pass


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """So many processes that compute all the time."""
    spawn = multiprocessing.get_context("spawn")
    processes = [spawn.Process(target=spin, daemon=True) for _ in range(count)]
    try:
        for process in processes:
            process.start()
        time.sleep(1.0 if processes else 0.0)  # until they are at it
        yield
    finally:
        for process in processes:
            process.terminate()


def run(policy: saccade.Policy, args: argparse.Namespace, busy: int) -> str:
    """One run of the loop, and its report; the row of the table."""
    robot = Robot(policy, args.instruction)
    with busy_processes(busy):
        thinker = Thinker(policy, robot, args.rate)
        thinker.encoding.clear()
        thinker.sampling.clear()
        thinker.start()
        try:
            # A thread of its own: what is started later would inherit a real-time priority.
            with ThreadPoolExecutor(1) as executor:
                loop = executor.submit(
                    lambda: (prefer_this_thread(), control(thinker, robot, args.rate, args.seconds))
                )
                try:
                    priority, record = loop.result()
                finally:
                    thinker.ask_to_stop()  # the robot too: Ctrl-C ends both
        finally:
            thinker.stop()
    title = "quiet" if busy == 0 else f"{busy} busy processes"
    print(
        f"\n{title}, {priority}: {len(record.late)} ticks of {1e3 / args.rate:g} ms in {args.seconds:g} s, "
        f"{record.missed} missed, {record.held} without an action, {len(thinker.encoding)} chunks"
    )
    for name, values in (
        ("jitter: start of a tick after its due time", record.late),
        ("age of the frames behind an action", record.age),
        ("encoding: images and instruction to a context", thinker.encoding),
        ("sampling: a chunk", thinker.sampling),
    ):
        print("\n".join(histogram(name, values)))
    cells = [title, str(len(record.late)), str(record.missed), str(record.held), str(len(thinker.encoding))]
    cells += [quantiles(values) for values in (record.late, record.age, thinker.encoding, thinker.sampling)]
    return f"| {' | '.join(cells)} |"


def quantiles(seconds: list[float]) -> str:
    """Median, 99th percentile and maximum in milliseconds."""
    if not seconds:
        return ""
    return " / ".join(f"{1e3 * np.quantile(seconds, part):.3g}" for part in (0.5, 0.99, 1))


def load(args: argparse.Namespace, stack: ExitStack) -> saccade.Policy:
    """The policy; a random checkpoint is written where there is none."""
    source: str | Path = args.checkpoint or DEFAULT_CHECKPOINT
    if args.small:
        name = stack.enter_context(tempfile.TemporaryDirectory(prefix="saccade-control-loop-"))
        source = random_checkpoint.write(
            Path(name) / "small",
            backbone=random_checkpoint.small_backbone("n1.5"),
            head=random_checkpoint.small_head("n1.5"),
        )
    elif args.checkpoint is None and not DEFAULT_CHECKPOINT.exists():
        print(f"writing a random checkpoint of N1.5's size to {source}, 4.8 GB", file=sys.stderr)
        random_checkpoint.write(DEFAULT_CHECKPOINT)
    return saccade.Policy.from_pretrained(
        source, precision=args.precision, num_threads=args.num_threads, cameras=args.cameras
    )


def main() -> None:
    """Runs the loop, quiet and with busy processes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--checkpoint",
        help=f"a whole checkpoint (default: a random one, {DEFAULT_CHECKPOINT}, written if it is not there)",
    )
    parser.add_argument("--small", action="store_true", help="a small random checkpoint, for a quick trial")
    parser.add_argument("--cameras", nargs="+", help="which of its cameras (default: all)")
    parser.add_argument("--instruction", default="open the drawer", help="default: open the drawer")
    parser.add_argument("--precision", default="int8", help="float32, bfloat16, int8 or int4 (default int8)")
    parser.add_argument("--num-threads", type=int, help="of the policy (default: the physical cores)")
    parser.add_argument("--rate", type=float, default=10, help="actions per second (default 10)")
    parser.add_argument("--seconds", type=float, default=20, help="of each run (default 20)")
    parser.add_argument("--busy", action="store_true", help="also with as many busy processes as cores")
    args = parser.parse_args()
    if args.rate <= 0 or args.seconds <= 0:
        parser.error(f"--rate, --seconds: expected more than 0, got {args.rate:g} and {args.seconds:g}")
    with ExitStack() as stack:
        try:
            policy = load(args, stack)
        except (saccade.SaccadeError, OSError) as error:
            parser.error(str(error))
        print(policy)
        rows = [run(policy, args, busy) for busy in ((0, os.cpu_count() or 1) if args.busy else (0,))]
    print("\nms: median / p99 / max\n")
    print("| | ticks | missed | without an action | chunks | jitter | age | encoding | sampling |")
    print("|---|---|---|---|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
