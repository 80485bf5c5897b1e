"""`saccade study probes`: what linear probes read off the head's rows, block by block.

Episodes of the policy in closed loop are traced. From the rows after each block, ridge regressions are fitted
to what the simulator knows (where object, goal and hand are, how far the gripper is open), judged on episodes
that they were not fitted to, and compared with probes of the tokens that the head reads.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import threadpoolctl  # type: ignore[import-untyped]
from sklearn.decomposition import PCA
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupKFold, StratifiedGroupKFold
from sklearn.preprocessing import StandardScaler

from saccade._files import write_atomically
from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.intervention import ROW_GROUPS
from saccade.sim.policy import EMBODIMENT_ID
from saccade.study import figures
from saccade.study.cells import Cell, OnDone, Rows, digest, run_cells
from saccade.study.loaded import describe_checkpoint, environment_of, head_of, policy_of
from saccade.study.observations import Look, Rollouts, add_rollout_arguments, record_looks, rollouts_of
from saccade.study.section import Figure, Grid, Section, number
from saccade.study.statistics import CONFIDENCE, Estimate
from saccade.study.tables import Provenance

STUDY = "probes"
FOLDS, INNER_FOLDS = 5, 4
#: Inputs of a probe are scaled to a mean variance of 1, so these penalties suit inputs of any width.
PENALTIES = tuple(float(penalty) for penalty in np.logspace(-2, 5, 8))
TARGETS = ("object", "goal", "hand", "gripper")
SEEN = ("object", "goal")  # those that are not in the proprioception
RESAMPLES = 2000  # of the bootstrap
#: A target that moves less than this between frames of a task is not probed, metres (gripper: opening).
LEAST_SPREAD = 1e-3
ALL_TASKS = "all"

EPILOG = """\
Runs the policy in closed loop, traces it at every look, and fits linear probes (ridge regressions on
principal components) to where object, goal and hand are and how far the gripper is open. Every probe is
judged on episodes that it was not fitted to; R^2 is of the variance within a task.

examples:
  saccade study probes --out out/study
  saccade study probes --checkpoint out/policy --tasks push,two-goals --episodes 40 --step 3 --out out/study
"""

FloatArray = npt.NDArray[Any]  # of float32 or float64
#: What a probe reads: the rows, the block after which they were taken (-1: before the first), and whether
#: the mean of the tokens is read or all of them, one after the other.
Input = tuple[str, int, str]
#: A target's name, and whether it is the true one or the shuffled control.
Target = tuple[str, str]
PROPRIO: Input = ("proprioception", -1, "all")
VL: Input = ("vl_embs", -1, "all")


@dataclass(frozen=True)
class Frames:
    """What was seen and known at every look of several episodes; the first axis of every array is the look.

    Attributes:
        episodes: `(frames,)`, a number per episode.
        tasks: `(frames,)`, a number per task.
        inputs: What probes may read, each `(frames, dimensions)`.
        targets: What they should tell, name to `(frames, coordinates)`.
    """

    episodes: npt.NDArray[np.int64]
    tasks: npt.NDArray[np.int64]
    inputs: Mapping[Input, FloatArray]
    targets: Mapping[str, FloatArray]


def shuffled_targets(frames: Frames, seed: int) -> dict[str, FloatArray]:
    """Gives every episode the targets of another episode of its task.

    Looks keep their order, so that what follows from the time alone is still there to be found. An episode
    that is longer than the other one repeats its last targets.
    """
    rng = np.random.default_rng(seed)
    taken = np.empty(len(frames.episodes), np.int64)
    looks = {episode: np.flatnonzero(frames.episodes == episode) for episode in np.unique(frames.episodes)}
    for task in np.unique(frames.tasks):
        order = rng.permutation(np.unique(frames.episodes[frames.tasks == task]))
        for episode, other in zip(order, np.roll(order, 1), strict=True):
            numbers = np.minimum(np.arange(len(looks[episode])), len(looks[other]) - 1)
            taken[looks[episode]] = looks[other][numbers]
    return {name: values[taken] for name, values in frames.targets.items()}


def held_out_errors(
    values: FloatArray, targets: Mapping[Target, FloatArray], frames: Frames, dimensions: int
) -> dict[Target, tuple[FloatArray, FloatArray]]:
    """Squared errors of linear probes, each on episodes that it was not fitted to.

    In each fold everything is fitted to the training episodes. The task's mean is taken off inputs and
    targets, so that nothing is won or lost by telling tasks apart. Inputs are then standardised and reduced
    to their first principal components, at most `dimensions`; then comes a ridge regression for each target,
    whose penalty is the best of `PENALTIES` in a cross-validation among the training episodes.

    Args:
        values: `(frames, inputs)`, what the probes read.
        targets: each `(frames, coordinates)`.
        frames: its episodes and tasks are used.
        dimensions: how much a probe may read at most.

    Returns:
        For each target two arrays `(frames,)`: the probe's squared error, and that of always saying the mean
        of the task's training frames. Both are summed over the coordinates.
    """
    found = {name: (np.zeros(len(values)), np.zeros(len(values))) for name in targets}
    asked = np.concatenate(list(targets.values()), axis=1, dtype=np.float64)  # (frames, all coordinates)
    owners = np.repeat(np.arange(len(targets)), [target.shape[1] for target in targets.values()])
    splitter = StratifiedGroupKFold(FOLDS, shuffle=True, random_state=0)
    for train, test in splitter.split(values, frames.tasks, frames.episodes):
        inputs = values - task_means(values, frames.tasks, train)
        wanted = asked - task_means(asked, frames.tasks, train)
        scaler = StandardScaler().fit(inputs[train])
        reduction = PCA(min(dimensions, len(train) - 1, values.shape[1]), random_state=0)
        with np.errstate(invalid="ignore"):  # rows that only name the task are all zeros now
            known = reduction.fit_transform(scaler.transform(inputs[train])).astype(np.float64)
        scale = np.sqrt(np.mean(np.square(known))) or 1.0
        new = reduction.transform(scaler.transform(inputs[test])).astype(np.float64) / scale
        penalties = best_penalties(known / scale, wanted[train], owners, frames.episodes[train])
        told = Ridge(alpha=penalties[owners]).fit(known / scale, wanted[train]).predict(new)
        for owner, (errors, spreads) in enumerate(found.values()):
            errors[test] = np.square(told - wanted[test])[:, owners == owner].sum(axis=1)
            spreads[test] = np.square(wanted[test])[:, owners == owner].sum(axis=1)
    return found


def best_penalties(
    values: FloatArray,
    targets: FloatArray,
    owners: npt.NDArray[np.int64],
    episodes: npt.NDArray[np.int64],
) -> FloatArray:
    """The penalty of `PENALTIES` with the least error in a cross-validation by episode, for each target.

    One decomposition serves all penalties and targets.

    Args:
        values: `(frames, dimensions)`.
        targets: `(frames, coordinates)` of all targets.
        owners: `(coordinates,)`, to which target each belongs.
        episodes: `(frames,)`.

    Returns:
        `(targets,)`.
    """
    errors = np.zeros((len(PENALTIES), targets.shape[1]))
    for train, test in GroupKFold(INNER_FOLDS).split(values, groups=episodes):
        mean, offset = values[train].mean(axis=0), targets[train].mean(axis=0)
        left, singular, right = np.linalg.svd(values[train] - mean, full_matrices=False)
        projected = left.T @ (targets[train] - offset)  # (dimensions, coordinates)
        for place, penalty in enumerate(PENALTIES):
            weights = right.T @ (projected * (singular / (singular**2 + penalty))[:, None])
            told = (values[test] - mean) @ weights + offset
            errors[place] += np.square(told - targets[test]).sum(axis=0)
    by_target = np.stack([errors[:, owners == owner].sum(axis=1) for owner in np.unique(owners)])
    best: FloatArray = np.asarray(PENALTIES)[by_target.argmin(axis=1)]
    return best


def task_means(values: FloatArray, tasks: npt.NDArray[np.int64], chosen: npt.NDArray[np.int64]) -> FloatArray:
    """For every frame the mean of its task over the chosen frames, shaped like `values`."""
    means = np.zeros_like(values)
    for task in np.unique(tasks):
        means[tasks == task] = values[chosen[tasks[chosen] == task]].mean(axis=0)
    return means


def within_tasks(values: FloatArray, tasks: npt.NDArray[np.int64]) -> float:
    """Root of the mean squared distance from the mean of the task."""
    apart = values - task_means(values, tasks, np.arange(len(tasks)))
    return float(np.sqrt(np.square(apart).sum(axis=1).mean()))


def per_episode(values: FloatArray, episodes: npt.NDArray[np.int64]) -> FloatArray:
    """Sums over the looks of each episode, in the order of the episodes' numbers."""
    _, inverse = np.unique(episodes, return_inverse=True)
    return np.bincount(inverse, weights=values)


def explained(
    errors: FloatArray, spreads: FloatArray, draws: npt.NDArray[np.int64]
) -> tuple[float, FloatArray]:
    """R^2 of all episodes together, and of each bootstrap draw of them.

    Args:
        errors, spreads: of `held_out_errors`, added up by episode, `(episodes,)`.
        draws: how often each draw takes each episode, `(resamples, episodes)`.

    Returns:
        1 - errors / spreads, and `(resamples,)` of the same.
    """
    return float(1 - errors.sum() / spreads.sum()), 1 - (draws @ errors) / (draws @ spreads)


def estimate(value: float, drawn: FloatArray) -> Estimate:
    """A number with the percentile interval of its bootstrap draws."""
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def probe(frames: Frames, dimensions: int) -> list[dict[str, Any]]:
    """All probes of a scope, with intervals over its episodes.

    The draws of the bootstrap are the same for all probes, so differences are paired.

    Args:
        frames: of the scope; the inputs `PROPRIO` and `VL` among them are what the others are compared with.
        dimensions: see `held_out_errors`.

    Returns:
        A row per target and input, for targets that vary.
    """
    numbers, counts = np.unique(frames.episodes, return_counts=True)
    rng = np.random.default_rng(0)
    draws = rng.multinomial(len(numbers), np.full(len(numbers), 1 / len(numbers)), size=RESAMPLES)
    spreads = {name: within_tasks(values, frames.tasks) for name, values in frames.targets.items()}
    moving = [name for name, spread in spreads.items() if spread >= LEAST_SPREAD]
    if not moving:
        return []
    shuffled = shuffled_targets(frames, 0)
    asked = {(name, "true"): frames.targets[name] for name in moving}
    asked |= {(name, "shuffled"): shuffled[name] for name in moving}
    found: dict[tuple[Input, Target], tuple[float, FloatArray]] = {}
    for source, values in frames.inputs.items():
        for target, (errors, usual) in held_out_errors(values, asked, frames, dimensions).items():
            sums = per_episode(errors, frames.episodes), per_episode(usual, frames.episodes)
            found[source, target] = explained(*sums, draws)
    rows = []
    for name in moving:
        for source in frames.inputs:
            value, drawn = found[source, (name, "true")]
            estimates = {
                "r2": estimate(value, drawn),
                "shuffled": estimate(*found[source, (name, "shuffled")]),
            }
            for label, other in (("over_proprio", PROPRIO), ("over_vl", VL)):
                base, base_drawn = found[other, (name, "true")]
                estimates[label] = estimate(value - base, drawn - base_drawn)
            row: dict[str, Any] = dict(zip(("rows", "block", "tokens"), source, strict=True))
            row |= {"target": name, "spread": spreads[name]}
            for label, one in estimates.items():
                row |= {label: one.value, f"{label}_low": one.low, f"{label}_high": one.high}
            rows.append({**row, "episodes": len(numbers), "frames": int(counts.sum())})
    return rows


def frames_of(head: ActionHead, looks: Sequence[Look], step: int) -> Frames:
    """The looks of one episode, traced at one Euler step.

    Args:
        head: of the policy.
        looks: of the episode.
        step: the Euler step at which rows are taken.
    """
    parts: dict[Input, list[FloatArray]] = {}

    def add(rows: str, block: int, tokens: FloatArray) -> None:
        """All tokens, and if there are several their mean."""
        parts.setdefault((rows, block, "all"), []).append(tokens.ravel())
        if len(tokens) > 1:
            parts.setdefault((rows, block, "mean"), []).append(tokens.mean(axis=0))

    for look in looks:
        context = head.encode(look.features)
        trace = head.trace(
            context, look.state, EMBODIMENT_ID, noise=look.noise, record=("hidden",), steps=[step]
        )
        add(PROPRIO[0], -1, look.state)
        add("features", -1, look.features[0])
        add(VL[0], -1, np.asarray(context.vl_embs)[0])
        for (_, block), hidden in trace.hidden.items():
            for group in ROW_GROUPS:
                tokens = np.asarray(hidden)[0, trace.rows[group]]
                if len(tokens):
                    add(group, block, tokens)
    targets = {name: np.stack([getattr(look, name) for look in looks]) for name in TARGETS}
    inputs = {source: np.stack(values) for source, values in parts.items()}
    return Frames(np.zeros(len(looks), np.int64), np.zeros(len(looks), np.int64), inputs, targets)


def join(parts: Sequence[Frames], tasks: Sequence[int]) -> Frames:
    """Several episodes in one; each part is one episode, of the task with that number."""
    lengths = [len(part.episodes) for part in parts]
    return Frames(
        np.repeat(np.arange(len(parts)), lengths),
        np.repeat(np.asarray(tasks, np.int64), lengths),
        {source: np.concatenate([part.inputs[source] for part in parts]) for source in parts[0].inputs},
        {name: np.concatenate([part.targets[name] for part in parts]) for name in TARGETS},
    )


def save_frames(frames: Frames, path: Path) -> None:
    """Writes one episode."""
    arrays = {
        "/".join(("inputs", rows, str(block), tokens)): values
        for (rows, block, tokens), values in frames.inputs.items()
    }
    arrays |= {f"targets/{name}": values for name, values in frames.targets.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def load_frames(path: Path) -> Frames:
    """Reads what `save_frames` wrote."""
    inputs: dict[Input, FloatArray] = {}
    targets: dict[str, FloatArray] = {}
    with np.load(path, allow_pickle=False) as arrays:
        for key in arrays.files:
            kind, *name = key.split("/")
            if kind == "inputs":
                inputs[name[0], int(name[1]), name[2]] = arrays[key]
            else:
                targets[name[0]] = arrays[key]
    zeros = np.zeros(len(targets[TARGETS[0]]), np.int64)
    return Frames(zeros, zeros, inputs, targets)


@dataclass(frozen=True)
class Settings:
    """What to probe.

    Attributes:
        rollouts: Whose episodes.
        step: The Euler step at which rows are taken. At the first one the action rows start from noise, so
            that what is found in them was read on the way.
        dimensions: See `held_out_errors`.
    """

    rollouts: Rollouts
    step: int = 0
    dimensions: int = 64


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    add_rollout_arguments(parser, episodes=20)
    parser.add_argument("--step", type=int, default=0, help="Euler step at which rows are taken (default: 0)")
    parser.add_argument(
        "--dimensions", type=int, default=64, help="principal components that a probe reads (default: 64)"
    )


def settings(args: argparse.Namespace) -> Settings:
    """The settings, checked."""
    rollouts = rollouts_of(args)
    if len(rollouts.seeds) < FOLDS:
        raise InputError(
            f"episodes: given {len(rollouts.seeds)}, expected at least {FOLDS}, one for each fold"
        )
    num_steps = describe_checkpoint(rollouts.checkpoint)["num_steps"]
    if not 0 <= args.step < num_steps:
        raise InputError(f"step: given {args.step}, expected 0 to {num_steps - 1}")
    if args.dimensions < 1:
        raise InputError(f"dimensions: given {args.dimensions}, expected at least 1")
    return Settings(rollouts, args.step, args.dimensions)


@dataclass(frozen=True)
class Work:
    """Both kinds of cells: an episode, whose frames are kept in a file, and all probes of a scope."""

    settings: Settings
    directory: Path

    def __call__(self, cell: Cell) -> Rows:
        """The rows of a cell."""
        if cell.key[0] == "episode":
            _, task, seed = cell.key
            return [self.record(str(task), int(seed))]
        scope = str(cell.key[1])
        tasks = self.settings.rollouts.tasks if scope == ALL_TASKS else (scope,)
        parts, numbers = [], []
        for task in tasks:
            for seed in self.settings.rollouts.seeds:
                if not self.path(task, seed).exists():  # tables may have been kept without it
                    self.record(task, seed)
                parts.append(load_frames(self.path(task, seed)))
                numbers.append(tasks.index(task))
        with threadpoolctl.threadpool_limits(1):
            found = probe(join(parts, numbers), self.settings.dimensions)
        return [{"kind": "probe", "task": scope, **row} for row in found]

    def path(self, task: str, seed: int) -> Path:
        """Where an episode's frames are kept."""
        return self.directory / f"{task}-{seed}.npz"

    def record(self, task: str, seed: int) -> dict[str, Any]:
        """Runs an episode and keeps its frames."""
        checkpoint = self.settings.rollouts.checkpoint
        episode, looks = record_looks(environment_of(checkpoint, task), policy_of(checkpoint), seed)
        save_frames(frames_of(head_of(checkpoint), looks, self.settings.step), self.path(task, seed))
        return {
            "kind": "episode",
            "task": task,
            "seed": seed,
            "success": episode.success,
            "frames": len(looks),
        }


def run(settings: Settings, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
    """Runs the episodes, then fits the probes: of each task, and of all tasks together."""
    rollouts = settings.rollouts
    common = {"checkpoint": describe_checkpoint(rollouts.checkpoint), "step": settings.step}
    work = Work(settings, out / STUDY / f"frames-{digest(common)}")
    episodes = [Cell(("episode", task, seed)) for task, seed in rollouts.episodes]
    seeds = [rollouts.seeds.start, len(rollouts.seeds)]
    scopes = {task: [task] for task in rollouts.tasks}
    if len(rollouts.tasks) > 1:
        scopes[ALL_TASKS] = list(rollouts.tasks)
    probes = [
        Cell(("probe", scope), {"tasks": tasks, "seeds": seeds, "dimensions": settings.dimensions})
        for scope, tasks in scopes.items()
    ]
    for cells in (episodes, [*episodes, *probes]):  # probes need all episodes
        run_cells(
            STUDY,
            cells,
            work,
            out,
            settings=common,
            backend=backend,
            jobs=jobs,
            on_done=on_done,
            expected=len(episodes) + len(probes),
        )


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
