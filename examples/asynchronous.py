"""Asynchronous inference: the effect of delay in closed loop, with and without real-time chunking.

    python examples/asynchronous.py                     2 episodes of each task and condition, a minute
    python examples/asynchronous.py --episodes 30       the run of docs/real-time.md; resumes after a stop
    python examples/asynchronous.py report              print the tables and draw the figure again

The bundled policy drives the simulated robot. A chunk of actions arrives `delay` control ticks after its
observation; until then the robot keeps executing the last chunk. The first `delay` actions of the new chunk
are therefore in the past when it arrives, and the robot jumps from one chunk into the middle of the next.
There are two conditions, with the same layouts, instructions and noise:

plain     the new chunk is sampled independently of the last one
chunked   the head gets the last chunk as `previous_chunk=`. Its next `delay` actions will be executed, so
          they are frozen; the influence of the actions after them decreases along the overlap
          (`saccade.Chunking`)

The delay is counted in ticks, not in seconds, so a seed gives the same run on any machine.
Needs saccade_lab with its extra `study`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Picture
from numpy.typing import NDArray

import saccade
from saccade.errors import InputError
from saccade_lab.files import writable_directory
from saccade_lab.machine import cpu_name
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import Episode, environment_for
from saccade_lab.sim.settings import EMBODIMENT_ID
from saccade_lab.sim.tasks import DEMO_TASKS, TASKS, check_evaluation_seeds
from saccade_lab.sim.video import VideoWriter
from saccade_lab.study.figures import COLOURS, WIDTH
from saccade_lab.study.statistics import Estimate, bootstrap, paired_difference, scaled, wilson

Float32Array = NDArray[np.float32]
ARMS = ("plain", "chunked")
#: Control ticks between two observations.
EVERY = 8
#: No training, model selection or other experiment used seeds from here on.
FIRST_SEED = 10_000
#: The figure shows the first episode of this task, up to this tick.
SHOWN_TASK = "push"
SHOWN_TICKS = 72


class Thinker:
    """The bundled policy: from an observation to a chunk, with or without the previous chunk."""

    def __init__(self) -> None:
        self.policy = Policy.from_pretrained(num_threads=1)

    def chunk(
        self,
        environment: TaskEnvironment,
        rng: np.random.Generator,
        previous: Float32Array | None,
        chunking: saccade.Chunking | None,
    ) -> Float32Array:
        """The chunk `(1, horizon, action_dim)`, normalised as the head returns it; `previous` likewise."""
        observation = environment.observe()
        head = self.policy.head
        return np.asarray(
            head.sample(
                head.encode(self.policy.features(observation)),
                self.policy.state(observation),
                EMBODIMENT_ID,
                noise=self.policy.noise(rng),
                previous_chunk=previous,
                chunking=chunking,
            )
        )

    def commands(self, chunk: Float32Array) -> Float32Array:
        """The commands of a chunk, `(horizon, 4)` in [-1, 1]."""
        return self.policy.robot_actions(chunk[0])


@dataclass
class Drive:
    """One episode.

    Attributes:
        delay: Control ticks from an observation to its chunk.
        arm: One of `ARMS`.
        task, seed, success, steps: As in `saccade_lab.sim.rollout.Episode`.
        commands: The executed commands, `(steps, 4)`.
        seams: Steps at which a new chunk took over.
    """

    delay: int
    arm: str
    task: str
    seed: int
    success: bool
    steps: int
    commands: Float32Array
    seams: tuple[int, ...]

    def row(self) -> dict[str, Any]:
        """The entry for the result file: smoothness instead of single commands."""
        values = {name: value for name, value in asdict(self).items() if name not in ("commands", "seams")}
        return {**values, "num_seams": len(self.seams), **self.smoothness()}

    def smoothness(self) -> dict[str, float | None]:
        """Mean Euclidean norms over the command's four numbers; None without values.

        `seam`: the change at steps at which a new chunk took over. `within`: the change at all other steps.
        `bend`: the second difference over the whole episode.
        """
        changes = np.linalg.norm(np.diff(self.commands, axis=0), axis=1)
        bends = np.linalg.norm(np.diff(self.commands, n=2, axis=0), axis=1)
        at_seams = np.isin(np.arange(1, len(self.commands)), self.seams)
        parts = {"seam": changes[at_seams], "within": changes[~at_seams], "bend": bends}
        return {name: float(part.mean()) if len(part) else None for name, part in parts.items()}


def drive(
    thinker: Thinker,
    environment: TaskEnvironment,
    seed: int,
    delay: int,
    arm: str,
    max_steps: int | None = None,
    on_step: Callable[[TaskEnvironment, Episode], None] = lambda environment, episode: None,
) -> Drive:
    """Runs an episode. The first chunk is available at the start; all others arrive late."""
    task = environment.task
    every, horizon = EVERY, thinker.policy.horizon
    # The overlap is what remains of the last chunk at the next observation; its first `delay` actions will be
    # executed.
    chunking = saccade.Chunking(overlap=horizon - every, frozen=delay) if arm == "chunked" else None
    environment.restart(seed)
    rng = np.random.default_rng((list(TASKS).index(task.name), seed))
    episode = Episode(task.name, seed, environment.instruction)
    executed, seams = [], []
    current, observed = thinker.chunk(environment, rng, None, None), 0
    pending, requested = current, 0
    on_step(environment, episode)
    for step in range(min(task.max_steps, max_steps or task.max_steps)):
        if pending is not current and step - requested >= delay:
            current, observed = pending, requested
            seams.append(step)
        if step and step % every == 0:
            given = (current, chunking) if chunking else (None, None)
            pending, requested = thinker.chunk(environment, rng, *given), step
            if delay == 0:
                current, observed = pending, requested
                seams.append(step)
        executed.append(thinker.commands(current)[step - observed])
        episode.success = environment.advance(executed[-1]).success
        episode.steps += 1
        on_step(environment, episode)
        if episode.success:
            break
    commands = np.array(executed, np.float32).reshape(-1, 4)
    return Drive(delay, arm, task.name, seed, episode.success, episode.steps, commands, tuple(seams))


def interval(value: Estimate, digits: int = 3) -> str:
    """A number with its interval."""
    return f"{value.value:.{digits}f} ({value.low:.{digits}f} to {value.high:.{digits}f})"


def percent(value: Estimate) -> str:
    """A rate, or a difference of rates, in percent."""
    return interval(scaled(value), 1)


class Results:
    """Statistics of the episodes by delay and arm. `rows` are those of the result file."""

    def __init__(self, rows: Sequence[dict[str, Any]]) -> None:
        self._arms: dict[tuple[int, str], dict[tuple[str, int], dict[str, Any]]] = {}
        for row in rows:
            self._arms.setdefault((row["delay"], row["arm"]), {})[row["task"], row["seed"]] = row
        self.delays = sorted({delay for delay, _ in self._arms})

    def arm(self, delay: int, arm: str) -> list[dict[str, Any]]:
        """The episodes of an arm."""
        return list(self._arms.get((delay, arm), {}).values())

    def success(self, delay: int, arm: str) -> Estimate:
        """The success rate, with Wilson's interval."""
        rows = self.arm(delay, arm)
        return wilson(sum(row["success"] for row in rows), len(rows))

    def mean(self, delay: int, arm: str, what: str) -> Estimate:
        """The mean over episodes of one of `Drive.smoothness`, with a bootstrap interval."""
        values = [row[what] for row in self.arm(delay, arm) if row[what] is not None]
        if not values:
            return Estimate(np.nan, np.nan, np.nan)
        return bootstrap(values, range(len(values)))

    def pairs(
        self, first: tuple[int, str], second: tuple[int, str]
    ) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """The pairs of episodes that exist in both arms."""
        one, two = self._arms.get(first, {}), self._arms.get(second, {})
        return [(one[key], two[key]) for key in one if key in two]

    def table(self) -> list[str]:
        """The table of the arms."""
        lines = [
            "| delay, ticks | arm | success | % (Wilson 95 %) | change at a seam | change elsewhere "
            "| second difference |",
            "|---|---|---|---|---|---|---|",
        ]
        for delay, arm in product(self.delays, ARMS):
            rows = self.arm(delay, arm)
            if rows:
                means = [interval(self.mean(delay, arm, what)) for what in ("seam", "within", "bend")]
                wins = f"{sum(row['success'] for row in rows)}/{len(rows)}"
                cells = [str(delay), arm, wins, percent(self.success(delay, arm)), *means]
                lines.append(f"| {' | '.join(cells)} |")
        return lines

    def comparisons(self) -> list[str]:
        """The table of differences between arms on the same episodes."""
        lines = [
            "| compared | pairs | success, points (Tango 95 %) | change at a seam | second difference |",
            "|---|---|---|---|---|",
        ]
        compared = [((delay, "chunked"), (delay, "plain")) for delay in self.delays]
        compared += [((delay, arm), (0, "plain")) for delay, arm in product(self.delays, ARMS) if delay]
        for first, second in compared:
            pairs = self.pairs(first, second)
            if pairs:
                won = paired_difference(*([pair[i]["success"] for pair in pairs] for i in (0, 1)))
                cells = [
                    f"delay {first[0]} {first[1]}, minus delay {second[0]} {second[1]}",
                    str(len(pairs)),
                    percent(won.difference),
                    *(self.change(pairs, what) for what in ("seam", "bend")),
                ]
                lines.append(f"| {' | '.join(cells)} |")
        return lines

    def change(self, pairs: Sequence[tuple[dict[str, Any], dict[str, Any]]], what: str) -> str:
        """The mean difference within pairs, with its interval."""
        both = [
            (one[what], two[what]) for one, two in pairs if one[what] is not None and two[what] is not None
        ]
        if not both:
            return "-"
        return interval(bootstrap([one - two for one, two in both], range(len(both))))

    def by_task(self) -> list[str]:
        """The table of successes by task."""
        tasks = list(dict.fromkeys(row["task"] for key in self._arms for row in self._arms[key].values()))
        lines = [f"| delay, ticks | arm | {' | '.join(tasks)} |", f"|---|---|{'---|' * len(tasks)}"]
        for delay, arm in product(self.delays, ARMS):
            rows = self.arm(delay, arm)
            if rows:
                won = [[row["success"] for row in rows if row["task"] == task] for task in tasks]
                cells = [f"{sum(part)}/{len(part)}" for part in won]
                lines.append(f"| {delay} | {arm} | {' | '.join(cells)} |")
        return lines


def draw(results: Results, examples: Sequence[Drive], path: Path) -> None:
    """Draws success and changes at seams against the delay, and the commands of one episode in each arm."""
    picture = Picture(figsize=(WIDTH, 5.2), layout="constrained")
    axes = picture.subplot_mosaic([["success", "seam"], ["trace", "trace"]])
    for plot in axes.values():
        plot.spines[["top", "right"]].set_visible(False)
    for number, arm in enumerate(ARMS):
        delays = [delay for delay in results.delays if results.arm(delay, arm)]
        x = [delay + 0.12 * (2 * number - 1) for delay in delays]
        for name, values in (
            ("success", [scaled(results.success(delay, arm)) for delay in delays]),
            ("seam", [results.mean(delay, arm, "seam") for delay in delays]),
        ):
            middle = [value.value for value in values]
            spread = [
                [value.value - value.low for value in values],
                [value.high - value.value for value in values],
            ]
            axes[name].errorbar(
                x, middle, spread, fmt="o-", color=COLOURS[number], markersize=4, linewidth=1.2, label=arm
            )
    within = [results.mean(delay, ARMS[0], "within").value for delay in results.delays]
    axes["seam"].plot(results.delays, within, ":", color="0.4", linewidth=1.2, label="plain, between seams")
    axes["success"].set(ylim=(0, 103), ylabel="success, %")
    axes["seam"].set(ylim=(0, 1.5 * axes["seam"].get_ylim()[1]), ylabel="change at a seam")
    for name in ("success", "seam"):
        axes[name].set_xlabel("delay, control ticks")
        axes[name].set_xticks(results.delays)
        axes[name].legend(frameon=False, fontsize=8, loc="lower left" if name == "success" else "upper right")
    for example in examples:
        shown = example.commands[:SHOWN_TICKS, 0]
        seams = [seam for seam in example.seams if seam < len(shown)]
        colour = COLOURS[ARMS.index(example.arm)]
        axes["trace"].plot(shown, color=colour, linewidth=1.2, label=example.arm)
        axes["trace"].plot(seams, shown[seams], "o", color=colour, markersize=4)
    one = examples[0]
    axes["trace"].set_title(f"{one.task}, seed {one.seed}, delay {one.delay}; dots: a new chunk", fontsize=9)
    axes["trace"].set(xlabel="control tick", ylabel="command sideways")
    axes["trace"].legend(frameon=False, fontsize=8)
    picture.savefig(path, dpi=160)


def run(args: argparse.Namespace, seeds: range) -> None:
    """Runs the episodes that are not in the result file yet."""
    thinker = Thinker()
    most = thinker.policy.horizon - EVERY
    if not all(0 <= delay <= most for delay in args.delays):
        raise InputError(f"--delays: expected 0 to {most}, the length of the overlap; got {args.delays}")
    file = writable_directory(args.out) / "results.json"
    record = {
        "checkpoint_sha256": thinker.policy.checkpoint_sha256(),
        "engine": thinker.policy.describe(),
        "machine": {"cpu": cpu_name(), "system": platform.platform(), "python": platform.python_version()},
        "max_steps": args.max_steps,
        "episodes": [],
    }
    if file.exists():
        found = json.loads(file.read_text(encoding="utf-8"))
        same = ("checkpoint_sha256", "engine", "max_steps")
        if any(found.get(key) != record[key] for key in same):
            raise InputError(f"{file} is from another policy, engine or --max-steps; use another --out")
        record["episodes"] = found["episodes"]
    done = {(row["delay"], row["arm"], row["task"], row["seed"]) for row in record["episodes"]}
    if args.video:
        writable_directory(args.out / "videos")
    with contextlib.ExitStack() as opened:
        mode = "rgb_array" if args.video else None
        environments = {
            task: opened.enter_context(
                contextlib.closing(environment_for(thinker.policy, task, render_mode=mode))
            )
            for task in args.tasks
        }
        for seed, task, delay, arm in product(seeds, args.tasks, args.delays, ARMS):
            if (delay, arm, task, seed) in done:
                continue
            with contextlib.ExitStack() as stack:
                more = {}
                if args.video and seed == seeds[0]:
                    name = f"{task}-{seed}-delay-{delay}-{arm}.mp4"
                    more["on_step"] = stack.enter_context(VideoWriter(args.out / "videos" / name)).add
                one = drive(thinker, environments[task], seed, delay, arm, args.max_steps, **more)
            record["episodes"].append(one.row())
            # A run that is stopped while it writes keeps the last complete file.
            partial = file.with_suffix(".part")
            partial.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
            partial.replace(file)
            print(f"{task} {seed} delay {delay} {arm}: {'done' if one.success else 'failed'} {one.steps}")


def report(args: argparse.Namespace) -> None:
    """Prints the tables and writes the figure."""
    record = json.loads((args.out / "results.json").read_text(encoding="utf-8"))
    results = Results(record["episodes"])
    print(f"{record['machine']['cpu']}; {record['engine']}; checkpoint {record['checkpoint_sha256'][:12]}\n")
    for table in (results.table(), results.comparisons(), results.by_task()):
        print("\n".join(table) + "\n")
    # Commands are not stored; the same seed reproduces them.
    thinker, delay = Thinker(), results.delays[len(results.delays) // 2]
    rows = results.arm(delay, ARMS[0])
    first = next((row for row in rows if row["task"] == SHOWN_TASK), rows[0])
    with contextlib.closing(environment_for(thinker.policy, first["task"])) as environment:
        examples = [
            drive(thinker, environment, first["seed"], delay, arm, record["max_steps"]) for arm in ARMS
        ]
    draw(results, examples, args.out / "asynchronous.png")
    print(f"figure: {args.out / 'asynchronous.png'}")


def main() -> None:
    """Runs the episodes, then reports."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [task.name for task in DEMO_TASKS]
    parser.add_argument("do", nargs="?", choices=("run", "report"), default="run", help="default: run")
    parser.add_argument(
        "--tasks", nargs="+", choices=names, default=names, metavar="TASK", help="default: all"
    )
    parser.add_argument("--episodes", type=int, default=2, help="episodes of each task and arm (default: 2)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help=f"first seed (default: {FIRST_SEED})")
    parser.add_argument(
        "--delays", type=int, nargs="+", default=[0, 2, 4, 6, 8], help="control ticks (default: 0 2 4 6 8)"
    )
    parser.add_argument("--max-steps", type=int, help="end episodes after at most this many steps")
    parser.add_argument("--video", action="store_true", help="write an MP4 of the first seed in each arm")
    parser.add_argument(
        "--out", type=Path, default=Path("out/asynchronous"), help="default: out/asynchronous"
    )
    args = parser.parse_args()
    if args.max_steps is not None and args.max_steps < 1:
        parser.error(f"--max-steps: expected at least 1, got {args.max_steps}")
    try:
        if args.do == "run":
            run(args, check_evaluation_seeds(args.seed, args.episodes))
        report(args)
    except (InputError, FileNotFoundError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
