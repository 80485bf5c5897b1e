"""A second analysis of the later stages that train policies, from the table and the README alone.

`python studies/why-32/reanalysis_stages.py` prints, for each stage that has rows, the check of the data, the
success and held-out losses of each recipe, and the differences between recipes with their intervals: for both
tasks together, and for each alone. They are exploratory, so there are no p values. Then come the one
test of these stages, that of the new pairs with more steps, and the same policies under arms, the core's
among them: other numbers of Euler steps, cuts, merged or random tokens and other softmax weights. It shares
no code with `why_32`.
Differences are in percentage points; the slope is in points per unit of log2(N + 1).
"""

import csv
import itertools
import lzma
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from reanalysis import EPISODES, PLAN, RESULTS, TASKS, Row, expect, integer, interval, sign_flip

Policy = tuple[str, int]  # a recipe and a training seed
Contrast = tuple[str, dict[str, float]]  # its name, and what the success of each recipe is multiplied by

VLSA, VISION = "vlsa", ("patch-32", "patch-8", "two-cameras")
STAGES = ("scaled", "alignment", "numbers", "compute", VISION[0], VLSA, *VISION[1:], "aligned-again")
# The arms of other numbers of Euler steps than four, which are those of the arm "plain".
EULER = ("steps of 1", "steps of 2", "steps of 8")
CUTS = ("future-unread", "future-blind", "rows-blind", "future-redrawn")
CHANGES = (*CUTS, "1 merged", "4 merged", "mass of 4", "mass of 32")
COUNTS = (0, 1, 4, 16, 32, 64)
PARTS = {"both tasks": TASKS, **{task: (task,) for task in TASKS}}
CORE = ("n-0", "n-4", "n-32")
BASE = ("n-0-scaled", "n-4-scaled", "n-32-scaled")
# Columns of a training row that may differ between policies of a stage, beside the results and N.
VARIED: dict[str, set[str]] = {stage: set() for stage in STAGES}
VARIED["alignment"] = VARIED["aligned-again"] = {"alignment_loss", "validation_alignment_loss"}
VARIED["compute"] = {"width", "steps", "category_std", "language_width", "saccade"}
VARIED[VLSA] = {"vl_num_layers"}
# Those that, beside these, may differ between the stage and scaled. A start is a backbone's weights.
APART: dict[str, set[str]] = {stage: {"stage", "saccade"} for stage in STAGES}
APART["alignment"] |= {"alignment_weight"}
APART["aligned-again"] |= {"alignment_weight", "cpu"}  # an Intel
APART["patch-32"] |= {"patch_size", "num_vl_tokens", "start_sha256"}
APART["patch-8"] |= APART["patch-32"]
APART["two-cameras"] |= {"num_cameras", "num_vl_tokens", "start_sha256", "demonstrations_sha256"}
APART["two-cameras"] |= {"recording", "cpu"}  # demonstrations of their own, on an Intel
# What the end of a recipe's name says of its settings.
SAID = {"-wide": {"width": 104.0}, "-long": {"steps": 1628.0}, "-aligned": {"alignment_weight": 0.2}}
SAID["-aligned-again"] = SAID["-aligned"]
SAID["-patch-32"] = {"patch_size": 32.0, "num_vl_tokens": 61.0}
SAID["-patch-8"] = {"patch_size": 8.0, "num_vl_tokens": 241.0}
SAID["-two-cameras"] = {"num_cameras": 2.0, "num_vl_tokens": 74.0}
SAID |= {f"-vlsa-{blocks}": {"vl_num_layers": float(blocks)} for blocks in (0, 4)}
FIRST_SEEDS, NEW_SEEDS = range(6), range(6, 12)  # of the recipes that end in -long the new ones are tested


def minus(a: str, b: str) -> Contrast:
    """The difference of two recipes."""
    return f"{a} - {b}", {a: 1, b: -1}


def less(a: Contrast, b: Contrast) -> Contrast:
    """The difference of two contrasts that have no recipe in common."""
    return f"({a[0]}) - ({b[0]})", a[1] | {recipe: -weight for recipe, weight in b[1].items()}


def slope() -> Contrast:
    """The least-squares slope of success over log2(N + 1), which is a weighted sum of the successes."""
    xs = [math.log2(n + 1) for n in COUNTS]
    offsets = [x - statistics.fmean(xs) for x in xs]
    squares = sum(offset**2 for offset in offsets)
    weights = {f"n-{n}-scaled": offset / squares for n, offset in zip(COUNTS, offsets, strict=True)}
    return "slope over log2(N + 1)", weights


def contrasts(stage: str) -> list[Contrast]:
    """The contrasts of a stage."""
    none, four, many = BASE
    if stage == "scaled":
        pairs = [(many, none), (many, four), (four, none)]
        return [*(minus(*pair) for pair in pairs), less(minus(many, none), minus("n-32", "n-0"))]
    if stage == "alignment":
        pairs = [("n-32-aligned", many), ("n-4-aligned", four), ("n-32-aligned", "n-4-aligned")]
        return [minus(*pair) for pair in (*pairs, ("n-32-aligned", none))]
    if stage == "aligned-again":
        return [minus("n-32-aligned-again", "n-4-aligned-again")]
    if stage == "numbers":
        pairs = [("n-1-scaled", none), ("n-16-scaled", four), ("n-64-scaled", many)]
        pairs += [("n-64-scaled", none), ("n-64-scaled", "n-1-scaled")]
        return [*(minus(*pair) for pair in pairs), slope()]
    if stage == "compute":
        pairs = [(many, "n-0-wide"), (many, "n-0-long"), ("n-0-wide", none), ("n-0-long", none)]
        pairs += [("n-32-long", many), ("n-32-long", "n-0-long")]
        longer = less(minus("n-32-long", "n-0-long"), minus(many, none))
        return [*(minus(*pair) for pair in pairs), longer]
    found = []
    for kind in ("vlsa-0", "vlsa-4") if stage == VLSA else (stage,):
        mine = minus(f"n-32-{kind}", f"n-4-{kind}")
        found += [mine, less(mine, minus(many, four))]
        found += [minus(f"n-32-{kind}", many), minus(f"n-4-{kind}", four)]
    return found


def in_arm(recipe: str, arm: str) -> str:
    """The name of a recipe's policies in an arm; in the arm "plain", it is the recipe's."""
    return recipe if arm in ("", "plain") else f"{recipe} in {arm}"


def arm_contrasts(end: str, arm: str) -> list[Contrast]:
    """For the recipes with the same end of the name: an arm against plain, and, with another number of Euler
    steps, N against N in both.
    """
    recipes = {n: f"n-{n}{end}" for n in COUNTS}
    found = [minus(in_arm(recipe, arm), recipe) for recipe in recipes.values()]
    for base in (0, 4) if arm in EULER else ():
        there, plain = (minus(in_arm(recipes[32], a), in_arm(recipes[base], a)) for a in (arm, "plain"))
        found += [there, less(there, plain)]
    return found


def exact_interval(values: Sequence[float], level: float = 0.05) -> tuple[float, float] | None:
    """The interval that inverts the sign-flip test of the mean exactly, or None where it has no ends.

    Turning the signs of a subset of values - shift leaves their sum at least as far from zero exactly if the
    shift lies between the means of the subset and of the others. The mean of all always lies there. So each
    subset's mean that a shift passes on its way to it adds two assignments to the two that always count.
    """
    rank = math.floor(level * 2 ** (len(values) - 1))  # the least with 2 + 2 rank > level 2^n
    if rank == 0:
        return None
    subsets = (chosen for k in range(len(values)) for chosen in itertools.combinations(values, k + 1))
    means = sorted(math.fsum(subset) / len(subset) for subset in subsets)
    return means[rank - 1], means[-rank]


def verified(values: Sequence[float], ends: tuple[float, float], step: float = 1e-4) -> bool:
    """Whether the test rejects just outside the ends only, and reanalysis.py has the same for 12 pairs."""
    (low, high), inner = ends, min(step, (ends[1] - ends[0]) / 2)
    shifts = {low - step: False, high + step: False, low: True, high: True}
    shifts |= {low + inner: True, high - inner: True}
    right = all((sign_flip([v - s for v in values]) > 0.05) == within for s, within in shifts.items())
    if right and len(values) == 12:
        return all(abs(a - b) < 1e-6 for a, b in zip(interval(values), ends, strict=True))
    return right


def policy(row: Row) -> Policy:
    """The recipe, with the arm if that is not "plain", and the training seed of a row."""
    return in_arm(row["recipe"], row["arm"]), integer(row["training_seed"])


def named(policies: Iterable[Policy]) -> str:
    """The recipes and training seeds of policies, in words."""
    groups = itertools.groupby(sorted(policies), key=lambda one: one[0])
    return "; ".join(f"{name} of {[seed for _, seed in group]}" for name, group in groups) or "none"


class Table:
    """The policies of core and stages, and how many episodes those solved that ran all of them."""

    def __init__(self, rows: list[Row]) -> None:
        mine = [row for row in rows if row["stage"] in ("core", *STAGES)]
        self.trained = [row for row in mine if row["kind"] == "training"]
        arms = ("plain", *EULER, *CHANGES)
        self.episodes = [row for row in mine if row["kind"] == "episodes" and row["arm"] in arms]
        wanted = Counter((task, episode) for task in TASKS for episode in range(EPISODES))
        ran = {policy(row): Counter[tuple[str, int]]() for row in (*self.trained, *self.episodes)}
        for row in self.episodes:
            ran[policy(row)][row["task"], integer(row["seed"])] += 1
        self.partial = {one for one, episodes in ran.items() if episodes != wanted}
        # What a policy did in an arm counts only if it ran all episodes in the arm "plain", too.
        plain = {policy(row): (row["recipe"], integer(row["training_seed"])) for row in self.episodes}
        self.partial |= {one for one, same in plain.items() if same in self.partial or same not in ran}
        self.whole = ran.keys() - self.partial
        self.won = Counter((policy(r), r["task"]) for r in self.episodes if r["success"] == "True")

    def seeds(self, recipes: Iterable[str]) -> list[int]:
        """The training seeds of which all recipes have policies that ran all episodes."""
        return sorted(set.intersection(*({s for name, s in self.whole if name == r} for r in recipes)))

    def rate(self, one: Policy, tasks: Sequence[str]) -> float:
        """A policy's success in %, the mean over tasks."""
        return 100 * sum(self.won[one, task] for task in tasks) / (EPISODES * len(tasks))

    def values(self, weights: dict[str, float], tasks: Sequence[str]) -> list[float]:
        """The weighted sum of the recipes' success for each training seed that all of them have."""
        rates = [[k * self.rate((r, s), tasks) for r, k in weights.items()] for s in self.seeds(weights)]
        return [math.fsum(of_seed) for of_seed in rates]


def differing(rows: list[Row], may: set[str]) -> set[str]:
    """The columns in which rows differ, without those that may."""
    return {name for name in rows[0] if len({row[name] for row in rows}) > 1} - may


def planned(row: Row) -> bool:
    """Whether a policy's settings are the README's, as far as it and the recipe's name say them."""
    number = integer(row["recipe"].split("-")[1])
    settings: dict[str, float] = {**PLAN, "num_future_tokens": number, "steps": 1000}
    settings |= {"num_cameras": 3, "num_vl_tokens": 97}
    for end, values in SAID.items():
        settings |= values if row["recipe"].endswith(end) else {}
    width = float(row["width"])
    first_weights = abs(float(row["category_std"]) - 0.02 * math.sqrt(1536 / width)) < 0.0005
    language = (float(row["language_width"]) or width) == 64  # 0 stands for the head's width
    as_said = all(float(row[name]) == value for name, value in settings.items())
    return as_said and first_weights and language


def check_all(table: Table, rows: list[Row]) -> None:
    """Compare what these stages and the core share with what the README says of it."""
    print("Check of the data of all these stages, and of the core")
    expect("success is True or False", {row["success"] for row in table.episodes} <= {"True", "False"})
    failed = {integer(row["control_steps"]) for row in table.episodes if row["success"] == "False"}
    expect("every failure ran 100 steps", failed <= {100})
    ran = {(integer(row["control_steps"]), integer(row["chunks"])) for row in table.episodes}
    expect("a chunk is 8 steps", all(chunks == math.ceil(steps / 8) for steps, chunks in ran))
    names = {(r["policy"], r["recipe"], r["training_seed"]) for r in (*table.trained, *table.episodes)}
    right = all(name == f"{recipe}-seed-{integer(seed)}" for name, recipe, seed in names)
    expect("a policy's name is its recipe and seed", right)
    hashes = [row["checkpoint_sha256"] for row in rows if row["kind"] == "training"]
    expect(f"{len(hashes)} different checkpoints, with core and pilots", len(set(hashes)) == len(hashes))
    expect("one settings_sha256 in the table", len({row["settings_sha256"] for row in rows}) == 1)
    sources = [*table.trained, *(row for row in rows if row["kind"] == "backbone")]
    for cameras, patch in sorted({(row["num_cameras"], row["patch_size"]) for row in table.trained}):
        alike = [row for row in sources if (row["num_cameras"], row["patch_size"]) == (cameras, patch)]
        starts = {row["start_sha256"][:12] for row in alike if row["kind"] == "training"}
        used = {row["demonstrations_sha256"][:12] for row in alike}
        what = f"{integer(cameras)} cameras, {integer(patch)} px: one start, one set of demonstrations"
        expect(f"{what}: {sorted(starts)}, {sorted(used)}", len(starts) == len(used) == 1)


def check_stage(table: Table, stage: str, trained: list[Row]) -> None:
    """Compare the policies of one stage with what the README says of it."""
    recipes = {name for _, weights in contrasts(stage) for name in weights}
    recipes -= set(CORE) if stage == "scaled" else set(BASE)
    twelve = {name for name in recipes if stage == "scaled" or name.endswith("-long")}
    wanted = {(name, seed) for name in recipes for seed in range(12 if name in twelve else 6)}
    found = Counter(map(policy, trained))
    missing, others = wanted - set(found), set(found) - wanted
    expect(f"{len(wanted)} policies are there, but for: {named(missing)}", not missing)
    expect(f"each once, and beside them: {named(others)}", not others and set(found.values()) == {1})
    judged = {policy(row) for row in table.episodes if row["stage"] == stage and row["arm"] == "plain"}
    expect(f"episodes only of those, but for: {named(judged - set(found))}", judged <= set(found))
    left = table.partial & (judged | set(found))
    expect(f"each ran episodes 0 to 74 of both tasks once; left out: {named(left)}", not left)
    may = RESULTS | VARIED[stage]
    odd = differing(trained, may)
    expect(f"no columns differ that should not, but for: {sorted(odd)}", not odd)
    may |= APART[stage]
    odd = differing([*trained, *(row for row in table.trained if row["stage"] == "scaled")], may)
    apart = sorted(APART[stage] - {"stage"})
    expect(f"nor from scaled, beside {apart}, but for: {sorted(odd)}", not odd)
    expect("settings are the README's", all(map(planned, trained)))


def describe(table: Table, trained: list[Row]) -> None:
    """Print each recipe's success in %, and the range of its held-out losses."""
    for recipe in sorted(
        {row["recipe"] for row in trained}, key=lambda name: (name.split("-")[2:], len(name), name)
    ):
        rates = {part: table.values({recipe: 1}, tasks) for part, tasks in PARTS.items()}
        seeds = table.seeds([recipe])
        success = ", ".join(f"{part} {statistics.fmean(got):.4f}" for part, got in rates.items() if got)
        losses = [float(row["validation_loss"]) for row in trained if row["recipe"] == recipe]
        print(f"  {recipe}: success of {len(seeds)}: {success or 'none yet'};", end=" ")
        rated = list(zip(seeds, rates["both tasks"], strict=True))
        halves = [[rate for seed, rate in rated if (seed in NEW_SEEDS) == new] for new in (False, True)]
        shown = [f"{statistics.fmean(half):.4f}" for half in halves if half]
        print(f"of seeds 0 to 5{' and 6 to 11' if len(shown) == 2 else ''}: {' and '.join(shown)};", end=" ")
        print(f"held-out loss of {len(losses)}: {min(losses):.4f} to {max(losses):.4f}")


def differences(table: Table, wanted: Sequence[Contrast]) -> None:
    """Print the contrasts whose recipes are there, for both tasks and for each, and check their intervals."""
    right, there = True, {recipe for recipe, _ in table.whole}
    for name, weights in (contrast for contrast in wanted if set(contrast[1]) <= there):
        print(f"  {name}: {len(table.seeds(weights))} pairs, training seeds {table.seeds(weights)}")
        for part, tasks in PARTS.items() if table.seeds(weights) else ():
            values = table.values(weights, tasks)
            ends = exact_interval(values)
            numbers = [statistics.fmean(values), *(ends or ())]
            mean, *shown = (f"{round(number, 4) + 0.0:+.4f}" for number in numbers)
            print(f"    {part:<13} {mean:>9}  {f'95 % [{shown[0]}, {shown[1]}]' if shown else 'no interval'}")
            right &= ends is None or verified(values, ends)
    expect("the sign-flip test confirms every interval, and reanalysis.py's those of 12 pairs", right)


def test_new(table: Table) -> None:
    """Print N = 32 minus N = 0 with more steps: of the first pairs, and the test of the new ones."""
    recipes = ("n-32-long", "n-0-long")
    for name, seeds in (("first pairs", FIRST_SEEDS), ("new pairs, the test", NEW_SEEDS)):
        print(f"\nN = 32 minus N = 0 with more steps, training seeds {seeds[0]} to {seeds[-1]}: {name}")
        if not set(seeds) <= set(table.seeds(recipes)):
            print("  not all of them are there")
            continue
        for part, tasks in PARTS.items():
            values = [table.rate((recipes[0], s), tasks) - table.rate((recipes[1], s), tasks) for s in seeds]
            low, high = exact_interval(values) or (math.nan, math.nan)
            print(f"  {part:<13} {statistics.fmean(values):+.4f}  95 % [{low:+.4f}, {high:+.4f}]", end="")
            tested = seeds == NEW_SEEDS and part == "both tasks"
            print(f"  p = {float(sign_flip(values)):.6f}" if tested else "", [round(v, 2) for v in values])


def under_arm(table: Table, arm: str) -> None:
    """Print what an arm does to the same policies, recipes of one kind together."""
    mine = [row for row in table.episodes if row["arm"] == arm]
    print(
        f"\n{arm} in the same policies{', where plain is 4' * (arm in EULER)}"
        if mine
        else f"\n{arm}: no rows"
    )
    if not mine:
        return
    left = {policy(row) for row in mine} & table.partial
    print(f"  left out, since they did not run all episodes in both arms: {named(left)}")
    expect(
        "only of policies that were trained",
        {r["policy"] for r in mine} <= {r["policy"] for r in table.trained},
    )
    plain = {(r["policy"], r["task"], r["seed"]): r for r in table.episodes if r["arm"] == "plain"}
    keyed = [(row, (row["policy"], row["task"], row["seed"])) for row in mine]
    pairs = [(row, plain[episode]) for row, episode in keyed if episode in plain]
    for name in ("success", "control_steps"):
        print(f"  {name} differs in {sum(a[name] != b[name] for a, b in pairs)} of {len(pairs)} episodes")
    commits = [sorted({row["saccade"] for row in side}) for side in zip(*pairs, strict=True)]
    print(f"  commits of the arm and of plain: {commits}")
    for end in sorted({"".join(f"-{part}" for part in row["recipe"].split("-")[2:]) for row in mine}):
        print(f"  recipes n-N{end}")
        for recipe in (f"n-{n}{end}" for n in COUNTS):
            seeds = table.seeds([in_arm(recipe, arm)])
            for name in (in_arm(recipe, arm), recipe) if seeds else ():
                rates = [[table.rate((name, seed), tasks) for seed in seeds] for tasks in PARTS.values()]
                means = map(statistics.fmean, rates)
                shown = ", ".join(f"{part} {mean:.4f}" for part, mean in zip(PARTS, means, strict=True))
                print(f"  {name}: success of {len(seeds)}: {shown}")
            ends = Counter((a["success"], b["success"]) for a, b in pairs if a["recipe"] == recipe and seeds)
            if seeds:
                won, lost = ends["True", "False"], ends["False", "True"]
                print(f"  of {ends.total()} episodes {won} succeed in the arm only, {lost} in plain only")
        differences(table, arm_contrasts(end, arm))


def main() -> None:
    """Print everything."""
    path = Path(__file__).with_name("answer.csv.xz")
    with lzma.open(path, "rt", newline="", encoding="utf-8") as file:
        rows: list[Row] = list(csv.DictReader(file))
    table = Table(rows)
    check_all(table, rows)
    for stage in STAGES:
        trained = [row for row in table.trained if row["stage"] == stage]
        print(f"\n{stage}" if trained else f"\n{stage}: no rows")
        if trained:
            check_stage(table, stage, trained)
            describe(table, trained)
            differences(table, contrasts(stage))
    test_new(table)
    for arm in (*EULER, *CHANGES):
        under_arm(table, arm)


if __name__ == "__main__":
    main()
