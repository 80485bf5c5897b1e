"""A second analysis of the core of this study, from its table and the README alone.

`python studies/why-32/reanalysis.py` prints the check of the data, the primary and secondary tests,
robustness checks, and what is odd. It shares no code with `why_32`. All differences are in
percentage points; the slope is in points per unit of log2(N + 1).
"""

import csv
import itertools
import lzma
import math
import operator
import random
import statistics
from collections import Counter
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Row = dict[str, str]
Test = tuple[str, list[float]]

NUMBERS = (0, 4, 32)
SEEDS = tuple(range(12))
TASKS = ("stereo-reach", "two-goals")
EPISODES = 75
# A head with a held-out loss below this has left the plateau at 0.29. Chosen after the losses were seen.
LEARNED = 0.15
T_11 = 2.200985160  # the 97.5 % quantile of Student's t with 11 degrees of freedom
# Columns of a training row that may differ between policies. All others are settings or shared inputs.
RESULTS = {"policy", "training_seed", "num_future_tokens", "recipe", "checkpoint_sha256", "policy_bytes"}
RESULTS |= {"loss", "validation_loss", "seconds", "chunk_multiply_adds", "training_multiply_adds"}
PLAN = {"steps": 1400, "batch_size": 16, "learning_rate": 0.002, "ema_decay": 0.995, "alignment_weight": 0}
PLAN |= {"width": 64, "num_layers": 4, "num_heads": 4, "vl_num_layers": 1, "horizon": 16, "execute_steps": 8}
PLAN |= {"vision_width": 64, "vision_layers": 3, "language_layers": 2, "num_steps": 4, "patch_size": 16}


def integer(text: str) -> int:
    """A whole number, which the table writes as 4.0."""
    value = float(text)
    if value != int(value):
        raise ValueError(f"{text} is no whole number")
    return int(value)


def key(row: Row) -> tuple[int, int]:
    """The number of future tokens and the training seed of a row."""
    return integer(row["num_future_tokens"]), integer(row["training_seed"])


def expect(what: str, holds: bool) -> None:
    """Print one line of the check of the data."""
    print(f"  {'ok ' if holds else 'BAD'} {what}")


def check(rows: list[Row], trained: list[Row], episodes: list[Row]) -> None:
    """Compare the table with what the README says of it."""
    print("1. Check of the data")
    print(f"  kinds: {dict(Counter(row['kind'] for row in rows))}")
    policies = {(n, seed) for n in NUMBERS for seed in SEEDS}
    expect("36 policies, one for each N and seed", sorted(map(key, trained)) == sorted(policies))
    wanted = {(n, seed, task, e) for n, seed in policies for task in TASKS for e in range(EPISODES)}
    found = Counter((*key(row), row["task"], integer(row["seed"])) for row in episodes)
    expect("each runs episodes 0 to 74 of both tasks", set(found) == wanted)
    expect("no episode twice", set(found.values()) == {1})
    names = {key(row): row["policy"] for row in trained}
    expect("episodes name their policy", all(names[key(row)] == row["policy"] for row in episodes))
    expect("success is True or False", {row["success"] for row in episodes} == {"True", "False"})
    lengths = [(row["success"] == "True", integer(row["control_steps"])) for row in episodes]
    expect("every failure ran 100 steps", all(success or steps == 100 for success, steps in lengths))
    chunks = [integer(row["chunks"]) for row in episodes]
    eights = all(n == math.ceil(steps / 8) for n, (_, steps) in zip(chunks, lengths, strict=True))
    expect("a chunk is 8 steps", eights)
    differ = sorted(name for name in trained[0] if len({row[name] for row in trained}) > 1)
    expect(f"only the results and N differ between policies: {', '.join(differ)}", set(differ) <= RESULTS)
    expect("36 different checkpoints", len({row["checkpoint_sha256"] for row in trained}) == 36)
    planned = all(float(row[name]) == value for row in trained for name, value in PLAN.items())
    expect("settings are the README's", planned)
    (backbone,) = (row for row in rows if row["kind"] == row["policy"] == "backbone")
    recorded = trained[0]["recording"]  # later stages have recordings of their own
    (recording,) = (row for row in rows if row["kind"] == "recording" and row["recording"] == recorded)
    starts = {row["start_sha256"] for row in trained}
    expect(f"one start for all: {next(iter(starts))[:12]}", len(starts) == 1)
    print(f"      the backbone's own row has checkpoint {backbone['checkpoint_sha256'][:12]}")
    demonstrations = {row["demonstrations_sha256"] for row in (*trained, backbone, recording)}
    expect(f"same demonstrations: {next(iter(demonstrations))[:12]}", len(demonstrations) == 1)
    expect("one settings_sha256 in all rows", len({row["settings_sha256"] for row in rows}) == 1)


def sign_sums(values: Sequence[float]) -> Array:
    """For each of the 2^n assignments of signs: the signed sum of the values, and the sum of the signs."""
    assignments = itertools.product((1, -1), repeat=len(values))
    sums = [(math.fsum(map(operator.mul, signs, values)), sum(signs)) for signs in assignments]
    return np.array(sums).T


def extreme(sums: Array, shift: float = 0.0) -> int:
    """How many assignments give values - shift a sum at least as far from zero as the observed one."""
    totals, signs = sums
    distances = np.abs(totals - shift * signs)
    return int((distances >= distances[0] - 1e-9).sum())  # the first assignment is all plus


def interval(values: Sequence[float], level: float = 0.05) -> tuple[float, float]:
    """The shifts that the sign-flip test of values - shift does not reject, by a grid and then bisection."""
    sums = sign_sums(values)
    mean = statistics.fmean(values)
    reach = max(abs(v - mean) for v in values)

    def accepts(shift: float) -> bool:
        return extreme(sums, shift) > level * len(sums.T)

    grid = [mean + reach * step / 200 for step in range(-201, 202)]
    inside = [accepts(shift) for shift in grid]
    first, last = inside.index(True), len(grid) - 1 - inside[::-1].index(True)
    if not all(inside[first : last + 1]) or first == 0 or last == len(grid) - 1:
        raise ValueError("the shifts that are not rejected are no interval within the grid")

    def edge(outside: float, within: float) -> float:
        for _ in range(50):
            middle = (outside + within) / 2
            outside, within = (outside, middle) if accepts(middle) else (middle, within)
        return within

    return edge(grid[first - 1], grid[first]), edge(grid[last + 1], grid[last])


def holm(p_values: Sequence[Fraction]) -> list[Fraction]:
    """Holm's adjusted p values."""
    adjusted = [Fraction(0)] * len(p_values)
    running = Fraction(0)
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        running = max(running, min(Fraction(1), p_values[index] * (len(p_values) - rank)))
        adjusted[index] = running
    return adjusted


def slope(ys: Sequence[float]) -> float:
    """The least-squares slope of three success rates over log2(N + 1)."""
    xs = [math.log2(n + 1) for n in NUMBERS]
    middle = statistics.fmean(xs)
    return sum((x - middle) * y for x, y in zip(xs, ys, strict=True)) / sum((x - middle) ** 2 for x in xs)


def comparisons(rate: Callable[[int, int], float]) -> list[Test]:
    """The three comparisons: one number for each training seed. rate(N, seed) is in points."""
    return [
        ("N=32 - N=0", [rate(32, seed) - rate(0, seed) for seed in SEEDS]),
        ("N=32 - N=4", [rate(32, seed) - rate(4, seed) for seed in SEEDS]),
        ("slope", [slope([rate(n, seed) for n in NUMBERS]) for seed in SEEDS]),
    ]


def sign_flip(values: Sequence[float]) -> Fraction:
    """The exact two-sided p value of the sign-flip test."""
    return Fraction(extreme(sign_sums(values)), 2 ** len(values))


def report(tests: list[Test], corrected: bool = False) -> None:
    """Print the sign-flip test and its interval, with Holm's correction if these are the registered tests."""
    p_values = [sign_flip(values) for _, values in tests]
    for (name, values), p, p_holm in zip(tests, p_values, holm(p_values), strict=True):
        low, high = interval(values)
        print(
            f"  {name:<11} mean {statistics.fmean(values):+8.4f}  SD {statistics.stdev(values):7.4f}",
            f" 95 % [{low:+.4f}, {high:+.4f}]  p = {int(p * 4096)}/4096 = {float(p):.6f}",
            end=f"  Holm {float(p_holm):.6f}\n" if corrected else "\n",
        )


def t_tail(t: float, degrees: int) -> float:
    """The two-sided p value of Student's t, by Simpson's rule over the density from 0 to |t|."""
    scale = math.exp(math.lgamma((degrees + 1) / 2) - math.lgamma(degrees / 2)) / math.sqrt(degrees * math.pi)
    steps = 2000
    width = abs(t) / steps
    heights = [scale * (1 + (i * width) ** 2 / degrees) ** (-(degrees + 1) / 2) for i in range(steps + 1)]
    area = width / 3 * (heights[0] + heights[-1] + 4 * sum(heights[1:-1:2]) + 2 * sum(heights[2:-1:2]))
    return float(1 - 2 * area)


def t_test(values: Sequence[float]) -> str:
    """Mean, 95 % interval and p value of a paired t test with 12 pairs."""
    mean, error = statistics.fmean(values), statistics.stdev(values) / math.sqrt(len(values))
    low, high = mean - T_11 * error, mean + T_11 * error
    return f"[{low:+.4f}, {high:+.4f}] p = {t_tail(mean / error, len(values) - 1):.6f}"


def ranks(values: Sequence[float]) -> list[float]:
    """Ranks from 1; equal values share their mean rank."""
    ordered = sorted(values)
    return [ordered.index(v) + (ordered.count(v) + 1) / 2 for v in values]


def wilcoxon(values: Sequence[float]) -> float:
    """The exact two-sided p value of the signed-rank test: zeros dropped, ties share their mean rank."""
    kept = [round(v, 9) for v in values if abs(v) > 1e-9]
    signed = map(math.copysign, ranks([abs(v) for v in kept]), kept)
    return float(sign_flip(list(signed)))


def percentiles(draws: list[float]) -> str:
    """The middle 95 % of bootstrap draws."""
    ordered = sorted(draws)
    return f"[{ordered[round(0.025 * len(ordered))]:+.2f}, {ordered[round(0.975 * len(ordered)) - 1]:+.2f}]"


def bootstrap(values: Sequence[float], draws: int = 20000) -> str:
    """The percentile interval of the mean over resampled training seeds."""
    generator = random.Random(0)
    return percentiles([statistics.fmean(generator.choices(values, k=len(values))) for _ in range(draws)])


class Core:
    """The judged policies: what each episode's result was, and each head's held-out loss."""

    def __init__(self, trained: list[Row], episodes: list[Row]) -> None:
        self.loss = {key(row): float(row["validation_loss"]) for row in trained}
        self.won = {(*key(r), r["task"], integer(r["seed"])): r["success"] == "True" for r in episodes}

    def wins(self, n: int, seed: int, task: str) -> int:
        """How many of the 75 episodes of a task a policy solved."""
        return sum(self.won[n, seed, task, episode] for episode in range(EPISODES))

    def rate(self, n: int, seed: int) -> float:
        """A policy's result in points. Both tasks have 75 episodes, so the mean over tasks is that of all."""
        return 100 * sum(self.wins(n, seed, task) for task in TASKS) / (EPISODES * len(TASKS))

    def logit(self, n: int, seed: int) -> float:
        """The mean of the two tasks' empirical log-odds."""
        wins = [self.wins(n, seed, task) for task in TASKS]
        return statistics.fmean(math.log((w + 0.5) / (EPISODES - w + 0.5)) for w in wins)


def describe(core: Core) -> None:
    """Print the success of each policy and of each N."""
    print("\n2. Success in % (successes of 75 in stereo-reach / two-goals, held-out loss)")
    for seed in SEEDS:
        line = f"  seed {seed:2}"
        for n in NUMBERS:
            solved = "/".join(f"{core.wins(n, seed, task):2}" for task in TASKS)
            line += f"   N={n}: {core.rate(n, seed):.2f} ({solved}, {core.loss[n, seed]:.3f})"
        print(line)
    for n in NUMBERS:
        rates = [core.rate(n, seed) for seed in SEEDS]
        line = f"  N={n:<2} mean {statistics.fmean(rates):.4f}  SD over seeds {statistics.stdev(rates):.4f}"
        for task in TASKS:
            solved_all = sum(core.wins(n, seed, task) for seed in SEEDS)
            line += f"  {task} {100 * solved_all / (EPISODES * len(SEEDS)):.4f}"
        print(line)


def crossed(core: Core, base: int, draws: int = 1000) -> str:
    """The percentile interval of N = 32 minus base, training seeds and episodes resampled together."""
    generator = random.Random(1)
    means = []
    for _ in range(draws):
        seeds = generator.choices(SEEDS, k=len(SEEDS))
        chosen = [(task, e) for task in TASKS for e in generator.choices(range(EPISODES), k=EPISODES)]
        ahead = sum(core.won[32, s, t, e] - core.won[base, s, t, e] for s in seeds for t, e in chosen)
        means.append(100 * ahead / (len(seeds) * len(chosen)))
    return percentiles(means)


def robustness(core: Core, tests: list[Test]) -> None:
    """Print other tests and intervals of the same comparisons."""
    print("\n4. Robustness checks, which are not registered")
    for name, values in tests:
        signs = [sum(v > 0 for v in values), sum(v < 0 for v in values), sum(v == 0 for v in values)]
        print(
            f"  {name:<11} paired t {t_test(values)}; signed-rank p = {wilcoxon(values):.6f};",
            f"bootstrap over seeds {bootstrap(values)}; median {statistics.median(values):+.4f};",
            f"{signs[0]} up, {signs[1]} down, {signs[2]} equal",
        )
    print("  Mean of the two tasks' log-odds (differences are in log-odds):")
    report(comparisons(core.logit))
    print("  Training seeds and episodes resampled together (other layouts as well as another training):")
    for base in (0, 4):
        print(f"  N=32 - N={base:<4} {crossed(core, base)}")
    for task in TASKS:
        solved = {(n, seed): 100 * core.wins(n, seed, task) / EPISODES for n in NUMBERS for seed in SEEDS}
        print(f"  {task} alone:")
        report(comparisons(lambda n, seed, solved=solved: solved[n, seed]))  # type: ignore[misc]
    print("  N = 4 minus N = 0, for which no test was planned:")
    report([("N=4 - N=0", [core.rate(4, seed) - core.rate(0, seed) for seed in SEEDS])])


def influence(core: Core, tests: list[Test]) -> None:
    """Print what single seeds and the order of the seeds do."""
    for name, values in tests:
        without = [[v for other, v in zip(SEEDS, values, strict=True) if other != seed] for seed in SEEDS]
        means = sorted((statistics.fmean(rest), seed) for seed, rest in zip(SEEDS, without, strict=True))
        p_values = sorted((float(sign_flip(rest)), seed) for seed, rest in zip(SEEDS, without, strict=True))
        print(
            f"  {name:<11} one seed left out: mean {means[0][0]:+.4f} (seed {means[0][1]})",
            f"to {means[-1][0]:+.4f} (seed {means[-1][1]}); p {p_values[0][0]:.6f} (seed {p_values[0][1]})",
            f"to {p_values[-1][0]:.6f} (seed {p_values[-1][1]}); correlation with the seed's number",
            f"{statistics.correlation(SEEDS, values):+.3f}",
        )
    rates = {n: [core.rate(n, seed) for seed in SEEDS] for n in NUMBERS}
    for a, b in itertools.combinations(NUMBERS, 2):
        print(
            f"  correlation over seeds of N={a} and N={b}: {statistics.correlation(rates[a], rates[b]):+.3f}"
        )
    seeds = [statistics.fmean(three) for three in zip(*rates.values(), strict=True)]
    print(
        f"  a seed's number and its mean success: correlation {statistics.correlation(SEEDS, seeds):+.3f};",
        f"seeds 0-5 {statistics.fmean(seeds[:6]):.2f}, 6-11 {statistics.fmean(seeds[6:]):.2f}",
    )


def plateau(core: Core) -> None:
    """Print which heads have left the plateau of the loss, and what they succeed in."""
    print(f"  held-out losses, sorted: {' '.join(f'{value:.3f}' for value in sorted(core.loss.values()))}")
    policies = sorted(core.loss)
    losses, rates = [core.loss[k] for k in policies], [core.rate(*k) for k in policies]
    print(f"  rank correlation with success: {statistics.correlation(ranks(losses), ranks(rates)):+.3f}")
    learned = {n: [seed for seed in SEEDS if core.loss[n, seed] < LEARNED] for n in NUMBERS}
    for n in NUMBERS:
        yes = statistics.fmean(core.rate(n, seed) for seed in learned[n])
        no = statistics.fmean(core.rate(n, seed) for seed in SEEDS if seed not in learned[n])
        print(
            f"  N={n:<2} held-out loss below {LEARNED}: {len(learned[n])} of 12, seeds {learned[n]}:",
            f"success {yes:.2f}, the others {no:.2f}",
        )
    for a, b in ((0, 32), (4, 32), (0, 4)):
        only_b = [seed for seed in learned[b] if seed not in learned[a]]
        only_a = [seed for seed in learned[a] if seed not in learned[b]]
        both = [seed for seed in learned[a] if seed in learned[b]]
        neither = [seed for seed in SEEDS if seed not in learned[a] + learned[b]]
        gains = [core.rate(b, seed) - core.rate(a, seed) for seed in SEEDS]
        parts = {f"only N={b}": only_b, f"only N={a}": only_a, "both": both, "neither": neither}
        text = [
            f"{name} {part} {sum(gains[s] for s in part) / len(SEEDS):+.2f}" for name, part in parts.items()
        ]
        print(f"  parts of the mean of N={b} - N={a}, by who is below it: {'; '.join(text)}")


def floors(core: Core) -> None:
    """Print which episodes say nothing, and how far the policies are from 0 and 100 %."""
    for task in TASKS:
        solved = [sum(core.won[n, s, task, e] for n in NUMBERS for s in SEEDS) for e in range(EPISODES)]
        wins = [core.wins(n, seed, task) for n in NUMBERS for seed in SEEDS]
        print(
            f"  {task}: {solved.count(0)} of 75 episodes fail with all 36 policies,",
            f"{solved.count(36)} succeed with all; {sum(w <= 3 for w in solved)} succeed with 3 or fewer;",
            f"the 37 hardest have {100 * sum(sorted(solved)[:37]) / sum(solved):.1f} % of the successes;",
            f"a policy has {min(wins)} to {max(wins)} successes",
        )


def main() -> None:
    """Print everything."""
    path = Path(__file__).with_name("answer.csv.xz")
    with lzma.open(path, "rt", newline="", encoding="utf-8") as file:
        rows: list[Row] = list(csv.DictReader(file))
    core_rows = [row for row in rows if row["stage"] == "core"]
    trained = [row for row in core_rows if row["kind"] == "training"]
    episodes = [row for row in core_rows if row["kind"] == "episodes" and row["arm"] == "plain"]
    check(rows, trained, episodes)
    core = Core(trained, episodes)
    describe(core)
    print("\n3. The registered tests: exact sign-flip over the 12 training seeds, Holm over the three")
    tests = comparisons(core.rate)
    report(tests, corrected=True)
    robustness(core, tests)
    print("\n5. What is odd")
    influence(core, tests)
    plateau(core)
    floors(core)
    recorded = next(float(row["seconds"]) for row in rows if row["kind"] == "recording")
    print(f"  seconds of the recording's row: {recorded:.3f}")


if __name__ == "__main__":
    main()
