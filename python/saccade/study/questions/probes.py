"""`saccade study probes`: what linear probes read from the head's rows, block by block.

Episodes of the policy in closed loop are traced. From the rows after each block, ridge regressions are fitted
to what the simulator knows (positions of object, goal and hand, opening of the gripper), judged on episodes
that they were not fitted to, and compared with probes of the tokens that the head reads.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pandas as pd
import threadpoolctl  # type: ignore[import-untyped]

from saccade.cli.arguments import add_integer, add_rollout_arguments
from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.intervention import ROW_GROUPS
from saccade.study import figures
from saccade.study.cell import Cell, Rows, digest
from saccade.study.linear_probes import (
    FOLDS,
    PROPRIO,
    VL,
    FloatArray,
    Frames,
    Input,
    join,
    load_frames,
    probe,
    save_frames,
)
from saccade.study.section import Figure, Grid, Section, number
from saccade.study.source import simulator_of
from saccade.study.statistics import Estimate
from saccade.study.study import Study
from saccade.study.table import Provenance

if TYPE_CHECKING:
    from saccade.study.simulator import Recorded, Simulator

TARGETS = ("object", "goal", "hand", "gripper")
SEEN = ("object", "goal")  # those that are not in the proprioception
ALL_TASKS = "all"

EPILOG = """\
Runs the policy in closed loop, traces it at every observation, and fits linear probes (ridge regressions on
principal components) to the positions of object, goal and hand and to the opening of the gripper. Every probe
is judged on episodes that it was not fitted to; R^2 is of the variance within a task.

examples:
  saccade study probes --out out/study
  saccade study probes --checkpoint out/policy --tasks push two-goals --episodes 40 --step 3 --out out/study
"""


@dataclass(frozen=True)
class Probes(Study):
    """What can be read linearly from the rows after each block.

    Attributes:
        source: The episodes.
        step: The Euler step at which rows are taken. At the first one the action rows start from noise, so
            that what is found in them was read on the way.
        dimensions: Principal components that a probe reads at most.
        frames: Directory in which traced episodes are kept; `begin` chooses it.
        recorded: Whether all episodes are there, so that probes can be fitted.
    """

    source: Simulator
    step: int = 0
    dimensions: int = 64
    frames: Path | None = None
    recorded: bool = False
    name: ClassVar[str] = "probes"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See `Study`."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=20)
        add_integer(parser, "--step", minimum=0, default=0, help="Euler step at which rows are taken")
        add_integer(parser, "--dimensions", default=64, help="principal components that a probe reads")

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Probes:
        """See `Study`."""
        source = simulator_of(args)
        if len(source.seeds) < FOLDS:
            raise InputError(
                f"--episodes: given {len(source.seeds)}, expected at least {FOLDS}, one for each fold"
            )
        if args.step >= source.config.num_steps:
            raise InputError(f"--step: given {args.step}, expected 0 to {source.config.num_steps - 1}")
        return cls(source, args.step, args.dimensions)

    def begin(self, out: Path) -> Probes:
        """See `Study`."""
        return replace(self, frames=out / self.name / f"frames-{digest(self.settings())}")

    def settings(self) -> Mapping[str, Any]:
        """See `Study`."""
        return {**self.source.describe(), "step": self.step}

    @property
    def scopes(self) -> dict[str, list[str]]:
        """The tasks that probes are fitted to together: each by itself, and all of them."""
        scopes = {task: [task] for task in self.source.tasks}
        if len(self.source.tasks) > 1:
            scopes[ALL_TASKS] = list(self.source.tasks)
        return scopes

    @property
    def num_cells(self) -> int:
        """See `Study`."""
        return len(self.source.units) + len(self.scopes)

    def cells(self) -> Sequence[Cell]:
        """The episodes; once they are there, the probes of each scope too."""
        episodes = [Cell(("episode", task, seed)) for task, seed in self.source.units]
        if not self.recorded:
            return episodes
        seeds = [self.source.seeds.start, len(self.source.seeds)]
        return episodes + [
            Cell(("probe", scope), {"tasks": tasks, "seeds": seeds, "dimensions": self.dimensions})
            for scope, tasks in self.scopes.items()
        ]

    def then(self, table: pd.DataFrame) -> Probes | None:
        """See `Study`."""
        return None if self.recorded else replace(self, recorded=True)

    def measure(self, cell: Cell) -> Rows:
        """An episode, whose frames are kept in a file, or all probes of a scope."""
        if cell.key[0] == "episode":
            _, task, seed = cell.key
            return [self.record(str(task), int(seed))]
        scope = str(cell.key[1])
        tasks = self.scopes[scope]
        parts, numbers = [], []
        for task in tasks:
            for seed in self.source.seeds:
                if not self.path(task, seed).exists():  # tables may have been kept without it
                    self.record(task, seed)
                parts.append(load_frames(self.path(task, seed)))
                numbers.append(tasks.index(task))
        with threadpoolctl.threadpool_limits(1):
            found = probe(join(parts, numbers), self.dimensions)
        return [{"kind": "probe", "task": scope, **row} for row in found]

    def path(self, task: str, seed: int) -> Path:
        """Where an episode's frames are kept."""
        assert self.frames is not None
        return self.frames / f"{task}-{seed}.npz"

    def record(self, task: str, seed: int) -> dict[str, Any]:
        """Runs an episode and keeps its frames."""
        recorded = self.source.recorded(task, seed)
        save_frames(frames_of(self.source.head(), recorded, self.step), self.path(task, seed))
        return {
            "kind": "episode",
            "task": task,
            "seed": seed,
            "success": recorded.episode.success,
            "frames": len(recorded.observation),
        }

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See `Study`."""
        return section(table, provenance)


def frames_of(head: ActionHead, recorded: Recorded, step: int) -> Frames:
    """The observations of one episode, traced at one Euler step.

    Args:
        head: of the policy.
        recorded: the episode.
        step: the Euler step at which rows are taken.
    """
    parts: dict[Input, list[FloatArray]] = {}

    def add(rows: str, block: int, tokens: FloatArray) -> None:
        """All tokens, and if there are several their mean."""
        parts.setdefault((rows, block, "all"), []).append(tokens.ravel())
        if len(tokens) > 1:
            parts.setdefault((rows, block, "mean"), []).append(tokens.mean(axis=0))

    for observation in recorded.observation.rows():
        context = observation.encode(head)
        trace = observation.trace(head, context, record=("hidden",), steps=[step])
        add(PROPRIO[0], -1, observation.state)
        add("features", -1, observation.backbone_features[0])
        add(VL[0], -1, np.asarray(context.vl_embs)[0])
        for (_, block), hidden in trace.hidden.items():
            for group in ROW_GROUPS:
                tokens = np.asarray(hidden)[0, trace.rows[group]]
                if len(tokens):
                    add(group, block, tokens)
    targets = {name: getattr(recorded.privileged, name) for name in TARGETS}
    inputs = {source: np.stack(values) for source, values in parts.items()}
    zeros = np.zeros(len(recorded.observation), np.int64)
    return Frames(zeros, zeros, inputs, targets)


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    probes = table[table["kind"] == "probe"]
    checkpoint = provenance.settings["checkpoint"]
    probed = probes if len(probes) else pd.DataFrame({"episodes": [0], "frames": [0]})
    summary = [
        f"{int(probed['episodes'].max())} episodes of {checkpoint['name']} in closed loop, "
        f"{int(probed['frames'].max())} looks, rows taken at Euler step {provenance.settings['step']} of "
        f"{checkpoint['num_steps']}. Ridge regressions on principal components, on episodes that they were "
        f"not fitted to ({FOLDS} folds by episode). The task's mean is taken off rows and targets: R^2 is "
        "of the variance within a task. Intervals are over episodes, with the same draws for all probes, "
        "which are not fitted anew for each draw.",
        "Every probe reads the same number of components at most, whatever it reads: the mean of the "
        "tokens, or all of them side by side. Control: targets of another episode of the task, look by "
        "look; what it finds follows from the time and from the task, not from the episode.",
    ]
    if probes.empty:
        return Section(
            "Probes", summary, concluded=["Not measured: episodes were run, no probe is done yet."]
        )
    scope = ALL_TASKS if (probes["task"] == ALL_TASKS).any() else str(probes["task"].iloc[0])
    chosen = probes[probes["task"] == scope]
    pictures = [
        Figure(
            str(target),
            f"How much of where the {target} is can be read off the rows after each block, within tasks; "
            "lines without blocks: what the hand alone tells, and what the tokens tell that the head reads. "
            "95 % intervals.",
            block_picture(chosen[chosen["target"] == target]),
        )
        for target in chosen["target"].unique()
    ]
    grids = [input_grid(chosen, scope), task_grid(probes)]
    return Section("Probes", summary, pictures, grids, conclusions(chosen, checkpoint), NOT_SHOWN)


NOT_SHOWN = (
    "A probe says that something can be read off linearly, not that the head uses it. Rows that are never "
    "read may know the goal; cuts say whether they are needed.",
    "A low R^2 does not say that a row knows nothing: it may know it in another form, or in components that "
    "hold little of its variance.",
    "The hand moves towards what the policy has seen, so the hand's position alone says something about "
    "object and goal. What counts is the difference from the probe of proprioception.",
)


def one_of(rows: pd.DataFrame, column: str = "r2") -> Estimate:
    """The estimate in the first of the rows."""
    row = rows.iloc[0]
    return Estimate(float(row[column]), float(row[f"{column}_low"]), float(row[f"{column}_high"]))


def of_input(rows: pd.DataFrame, source: Input) -> pd.DataFrame:
    """The rows of one input."""
    name, block, tokens = source
    return rows[(rows["rows"] == name) & (rows["block"] == block) & (rows["tokens"] == tokens)]


def block_picture(rows: pd.DataFrame) -> Any:
    """R^2 over the blocks, of one target."""
    blocks = sorted(int(block) for block in rows["block"].unique() if block >= 0)
    series = {}
    for group in ROW_GROUPS:
        for tokens in ("all", "mean"):
            if not of_input(rows, (group, blocks[0], tokens)).empty:
                name = group if group == "state" else f"{group} ({tokens})"
                series[name] = [one_of(of_input(rows, (group, block, tokens))) for block in blocks]
    for source, name in ((VL, "vl_embs"), (PROPRIO, "proprioception")):
        series[name] = [one_of(of_input(rows, source))] * len(blocks)
    picture = figures.lines(blocks, series, "after block", "R^2 on other episodes", reference=0)
    legend = picture.axes[0].get_legend()
    assert legend is not None
    legend.remove()  # it would hide lines; below the plot there is room
    picture.legend(loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    return picture


def input_grid(rows: pd.DataFrame, scope: str) -> Grid:
    """All inputs and targets of a scope."""
    targets = list(rows["target"].unique())
    lines = []
    for source in rows[["rows", "block", "tokens"]].drop_duplicates().itertuples(index=False):
        found = of_input(rows, tuple(source)).set_index("target")
        where = "input" if source[1] < 0 else f"block {int(source[1])}"
        values = [number(one_of(found.loc[[target]]), digits=2) for target in targets]
        controls = "; ".join(f"{found.loc[target, 'shuffled']:.2f}" for target in targets)
        lines.append([str(source[0]), where, str(source[2]), *values, controls])
    name = "all tasks together, within each" if scope == ALL_TASKS else scope
    return Grid(
        f"R^2 on other episodes, {name}. Last column: the shuffled control, target by target.",
        ("rows", "after", "tokens", *targets, "shuffled"),
        lines,
    )


def task_grid(probes: pd.DataFrame) -> Grid:
    """Object and goal by task: what the hand tells, the best of the future rows' blocks, and the tokens."""
    lines = []
    for (task, target), rows in probes.groupby(["task", "target"], sort=False):
        if target not in SEEN:
            continue
        future = rows[(rows["rows"] == "future") & (rows["tokens"] == "mean")]
        best = future.sort_values("r2").tail(1)
        lines.append(
            [
                str(task),
                str(target),
                f"{100 * float(rows['spread'].iloc[0]):.1f}",
                number(one_of(of_input(rows, PROPRIO)), digits=2),
                f"{number(one_of(best), digits=2)}, block {int(best['block'].iloc[0])}"
                if len(best)
                else "no tokens",
                number(one_of(of_input(rows, VL)), digits=2),
            ]
        )
    caption = (
        "R^2 by task. Spread: root of the mean squared distance from the task's mean, centimetres; a target "
        "that hardly moves is left out. Future rows: the mean of the tokens, after the block where it tells "
        "most."
    )
    return Grid(caption, ("task", "target", "spread", "proprioception", "future rows", "vl_embs"), lines)


def conclusions(rows: pd.DataFrame, checkpoint: Mapping[str, Any]) -> list[str]:
    """Whether the future rows carry what is seen, and from which block on."""
    if not (rows["rows"] == "future").any():
        return ["Future rows: not measured, the checkpoint has no future tokens."]
    lines = []
    for target in SEEN:
        of_target = rows[rows["target"] == target]
        if of_target.empty:
            lines.append(f"Where the {target} is: not measured, it hardly moves.")
            continue
        future = of_target[(of_target["rows"] == "future") & (of_target["tokens"] == "mean")].sort_values(
            "block"
        )
        carries = (future["over_proprio_low"] > 0) & (future["r2_low"] > future["shuffled_high"])
        if not carries.any():
            most = future.sort_values("r2").tail(1)
            lines.append(
                f"Where the {target} is: the mean of the future rows was not found to tell more of it than "
                f"the hand alone and the control do; at most (after block {int(most['block'].iloc[0])}) it "
                f"tells {number(one_of(most, 'over_proprio'), digits=2)} more than the hand."
            )
            continue
        first = future[carries].head(1)
        blocks = ", ".join(str(int(block)) for block in future.loc[carries, "block"])
        block = int(first["block"].iloc[0])
        state = one_of(of_input(of_target, ("state", block, "all")))
        lines.append(
            f"Where the {target} is: the future rows carry it after block {blocks}. After block {block}: R^2 "
            f"{number(one_of(first), digits=2)} from their mean, "
            f"{number(one_of(first, 'over_proprio'), digits=2)} more than from the hand alone, "
            f"{number(one_of(first, 'over_vl'), digits=2)} compared with all tokens that the head reads; "
            f"shuffled control {number(one_of(first, 'shuffled'), digits=2)}. After the same block the one "
            f"state row has {number(state, digits=2)}; after the last block the future rows have "
            f"{number(one_of(future.tail(1)), digits=2)}."
        )
    return lines
