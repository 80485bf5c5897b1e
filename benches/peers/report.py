"""Tables and figures of what was measured, as Markdown and PNG; README and docs hold the same text."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from benches.peers import inputs
from benches.peers.cases import COST, LINEAR_SHAPES, Case, exact_macs
from benches.peers.contenders import CONTENDERS
from benches.peers.results import Results
from saccade import HeadConfig
from saccade.bench.timing import quartiles

ROOT = Path(__file__).resolve().parents[2]
NOTES = Path(__file__).with_name("notes.md")
PAGE = ROOT / "docs" / "performance.md"
IMAGES = ROOT / "docs" / "images"
COMMITTED = Path(__file__).with_name("results.json")
BEGIN, END = (
    "<!-- performance: written by `python -m benches.peers report --write` -->",
    "<!-- /performance -->",
)
PIECES = {
    "head": "The whole head",
    "blocks": "Four DiT blocks",
    "cross": "The cross-attention of one block",
}
WORK_TITLES = {
    "encode": "encode",
    "sample": "sample on a held context",
    "both": "encode + sample",
}
PART_TITLES = {"held": "on held keys and values", "both": "with its keys and values"}
README_ROWS = (
    "saccade-float32",
    "saccade-bfloat16",
    "saccade-int8",
    "saccade-int8-refresh2",
    "saccade-int8-refresh4",
    "lerobot-float32",
    "lerobot-bfloat16",
    "lerobot-bfloat16-pure",
    "torch-float32",
    "torch-bfloat16",
    "compile-float32",
    "compile-bfloat16",
    "onnxruntime-float32",
    "onnxruntime-int8",
    "openvino-float32",
    "openvino-bfloat16",
)


@dataclass(frozen=True)
class Goal:
    """A ratio to reach: time of the peer over that of saccade."""

    what: str
    piece: str
    work: str
    peers: tuple[str, ...]
    ours: str
    least: float
    beyond: float


LEROBOT_BF16 = ("lerobot-bfloat16", "lerobot-bfloat16-pure")
GOALS = (
    Goal("float32, encode + sample", "head", "both", ("lerobot-float32",), "saccade-float32", 3.7, 4.0),
    Goal(
        "float32, sample on a held context",
        "head",
        "sample",
        ("lerobot-float32",),
        "saccade-float32",
        5.0,
        5.5,
    ),
    Goal("bfloat16, encode + sample", "head", "both", LEROBOT_BF16, "saccade-bfloat16", 1.8, 2.0),
    Goal("bfloat16, sample on a held context", "head", "sample", LEROBOT_BF16, "saccade-bfloat16", 2.5, 2.8),
    Goal(
        "bfloat16, four DiT blocks with their keys and values",
        "blocks",
        "both",
        ("openvino-bfloat16",),
        "saccade-bfloat16",
        1.1,
        1.2,
    ),
    Goal("int8, encode + sample", "head", "both", LEROBOT_BF16, "saccade-int8", 3.2, 3.6),
    *(
        Goal(
            f"int8, future_refresh={refresh}, sample on a held context",
            "head",
            "sample",
            LEROBOT_BF16,
            f"saccade-int8-refresh{refresh}",
            7.0,
            9.0,
        )
        for refresh in (2, 4)
    ),
)
LINEAR_GOALS = {1: ((0.86, 0.94), (0.90, 0.97)), 2: ((0.82, 0.91), (0.90, 0.97))}
"""Threads -> shares of the peak at (49, 296) rows: to reach, and beyond it."""


def command(results: Results, args: argparse.Namespace) -> int:
    """`python -m benches.peers report`."""
    if not results.data["machine"]:
        raise SystemExit(f"bench-peers: {args.results} holds no measurement; `make bench-peers` makes some")
    if args.readme:
        print(readme(results))
    elif args.write:
        page, images = PAGE, IMAGES
        page.write_text(document(results, "images"))
        figures(results, images)
        path = ROOT / "README.md"
        path.write_text(between_markers(path.read_text(), readme(results)))
    else:
        write(results, args.results.parent)
    return 0


def write(results: Results, folder: Path) -> None:
    """`report.md` and its figures, beside the JSON file."""
    figures(results, folder)
    (folder / "report.md").write_text(document(results, "."))
    print(folder / "report.md")


def between_markers(text: str, table: str) -> str:
    """The text with the table between its two markers."""
    pattern = re.compile(f"{re.escape(BEGIN)}\n.*?{re.escape(END)}", re.DOTALL)
    if not pattern.search(text):
        raise SystemExit(f"bench-peers: README.md lacks the lines\n{BEGIN}\n{END}")
    return pattern.sub(lambda _: f"{BEGIN}\n{table}\n{END}", text)


def document(results: Results, images: str) -> str:
    """The whole report; `images` is the folder of the figures as seen from it."""
    parts = [
        "# Performance",
        "Written by `python -m benches.peers report --write` from `benches/peers/results.json`: what "
        "`make bench-peers` left in `out/peers/results.json` on the machine below.",
        readme(results),
        machine(results),
        NOTES.read_text().strip(),
        "## Goals",
        goals(results),
        f"![The whole head, encode + sample, in every engine]({images}/performance.png)",
        *sections(results),
        "## Where a peer is faster",
        faster_peers(results),
        *linear(results),
        *settings(results),
        *cost(results, images),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def readme(results: Results) -> str:
    """The README's table: the whole head at the released size in every engine."""
    cases = usual(results, "head")
    if not cases:
        return "Nothing measured yet."
    threads = [case.threads for case in cases]
    titles = [f"encode + sample, {plural(count)}" for count in threads]
    titles += [f"sample on a held context, {plural(count)}" for count in threads]
    rows = []
    for name in README_ROWS:
        if not any(name in results.names(case) for case in cases):
            continue
        cells = [CONTENDERS[name].label]
        for work in ("both", "sample"):
            cells += [milliseconds(results.seconds(case, name, work)) for case in cases]
        known = [results.error(case, name)[0] for case in cases if name in results.names(case)]
        rows.append([*cells, f"{max(known):.0e}"])
    head = ["ms, N1.5, T_vl 296, 4 steps", *titles, "max abs error"]
    held = results.data["machine"]
    sentence = f"{held['cpu']} ({held['family']}, {held['isa']}), {held['cores']} cores; medians. "
    sentence += "The error is against the reference in float32."
    return f"{table(head, rows)}\n\n{sentence}"


def usual(results: Results, piece: str) -> list[Case]:
    """The measured cases of a piece at the released size, one view, one observation, by threads."""
    return sorted(case for case in results.cases if case == Case(piece, case.threads))


def plural(threads: int) -> str:
    """`1 thread`, `2 threads`."""
    return f"{threads} thread" + ("s" if threads != 1 else "")


def machine(results: Results) -> str:
    """What it was measured on."""
    held = results.data["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in held["versions"].items() if version)
    lines = [
        "## Machine",
        f"{held['cpu']} ({held['family']}), {held['cores']} cores, {held['memory_gb']} GB, "
        f"Linux {held['kernel']}; flags {', '.join(held['flags'])}. {versions}; commit {held['commit']}.",
    ]
    forced = {
        one.environment["SACCADE_ISA"] for one in CONTENDERS.values() if "SACCADE_ISA" in one.environment
    }
    rows = []
    for threads in sorted({entry["threads"] for entry in results.data["peaks"]}):
        for isa in (held["isa"], *sorted(forced)):
            kinds = ("float32", "bfloat16", "int8")
            cells = [results.peak(threads, isa, kind) for kind in kinds]
            if any(cells):
                rates = ["" if rate is None else f"{rate / 1e9:.0f}" for rate in cells]
                rows.append([plural(threads), isa, *rates, gigabytes(results.bandwidth(threads))])
    if rows:
        head = ["", "instruction set", "float32 GMAC/s", "bfloat16 GMAC/s", "int8 GMAC/s", "read GB/s"]
        lines += ["Peaks, from registers, measured in the same runs (medians):", table(head, rows)]
    return "\n\n".join(lines)


def gigabytes(rate: float | None) -> str:
    """A bandwidth in GB/s."""
    return "" if rate is None else f"{rate / 1e9:.0f}"


def goals(results: Results) -> str:
    """What was to be reached, and whether it was."""
    rows = []
    for goal in GOALS:
        for case in usual(results, goal.piece):
            peers = [name for name in goal.peers if name in results.names(case)]
            if not peers or goal.ours not in results.names(case):
                continue
            peer = min(peers, key=lambda name: quartiles(results.seconds(case, name, goal.work))[1])
            measured = results.ratio(case, peer, goal.ours, goal.work)
            if measured is not None:
                rows.append(
                    [
                        f"{goal.what}, beside {CONTENDERS[peer].label}",
                        plural(case.threads),
                        f"{goal.least} x ({goal.beyond} x)",
                        f"{'' if results.ratios(case, peer, goal.ours, goal.work) else '~'}"
                        f"{measured[1]:.2f} x ({measured[0]:.2f}–{measured[2]:.2f})",
                        verdict(measured[1], goal.least, goal.beyond),
                    ]
                )
    for threads, (least, beyond) in LINEAR_GOALS.items():
        for kind in ("float32", "bfloat16", "int8"):
            shares = linear_shares(results, kind, threads)
            if shares:
                met = [verdict(*numbers) for numbers in zip(shares, least, beyond, strict=True)]
                rows.append(
                    [
                        f"linear kernels, {kind}, 49 / 296 rows, of the peak",
                        plural(threads),
                        f"{percent(least)} ({percent(beyond)})",
                        percent(shares),
                        met[0] if met[0] == met[1] else " / ".join(met),
                    ]
                )
    return (
        table(["what", "", "goal (beyond it)", "measured", "reached"], rows)
        if rows
        else "Nothing measured yet."
    )


def verdict(measured: float, least: float, beyond: float) -> str:
    """Whether a goal is reached."""
    return "beyond" if measured >= beyond else "yes" if measured >= least else "**no**"


def percent(shares: Iterable[float]) -> str:
    """`86 / 94 %`."""
    return " / ".join(f"{100 * share:.0f}" for share in shares) + " %"


def linear_shares(results: Results, kind: str, threads: int) -> list[float]:
    """Shares of the peak of the best instruction set: the least of the shapes with 49 rows, that with 296."""
    best = results.data["machine"]["isa"]
    found: dict[int, list[float]] = {49: [], 296: []}
    for rows, inputs_, outputs in LINEAR_SHAPES:
        values = [
            rate["of_peak"]["median"]
            for bench in results.data["linear"]
            for case in bench["cases"]
            if case["case"] == f"{rows} x {inputs_} x {outputs}"
            for rate in case["rates"]
            if rate["threads"] == threads
            and is_linear(rate["name"], best, kind)
            and rate["of_peak"]["samples"]
        ]
        if values:
            found[rows].append(quartiles(values)[1])
    return [min(values) for values in found.values()] if all(found.values()) else []


def is_linear(name: str, isa: str, kind: str) -> bool:
    """Whether `cargo bench --bench linear` means this instruction set and arithmetic by that name."""
    return name in (f"saccade {isa}, {kind}", f"saccade {isa}, {kind} arithmetic")


def sections(results: Results) -> list[str]:
    """A table a case, the usual sizes first."""
    parts = []
    for piece, title in PIECES.items():
        cases = sorted(case for case in results.cases if case.piece == piece and case.size == "full")
        if cases:
            parts.append(f"## {title}")
            first = usual(results, piece)
            parts += [section(results, case) for case in [*first, *(c for c in cases if c not in first)]]
    return parts


def section(results: Results, case: Case) -> str:
    """Times of every contender, beside the first of its group and as a share of the floor."""
    titles = WORK_TITLES if case.piece == "head" else PART_TITLES
    macs = exact_macs(config(case), case)
    floors = ", ".join(f"{titles[work]} {value / 1e9 / calls(case):.1f}" for work, value in macs.items())
    rows = []
    for name in sorted(results.names(case), key=list(CONTENDERS).index):
        cells = [CONTENDERS[name].label]
        for work in case.reported:
            seconds = results.seconds(case, name, work)
            low, median, high = quartiles(seconds) if seconds else (0.0, 0.0, 0.0)
            cells.append(f"{number(median)} ({number(low)}–{number(high)})" if seconds else "")
        ours = f"saccade-{arithmetic(name)}"
        compared = results.ratio(case, name, ours, "both") if ours in results.names(case) else None
        in_turn = bool(results.ratios(case, name, ours, "both"))
        cells.append("" if compared is None else f"{'' if in_turn else '~'}{compared[1]:.2f}")
        cells.append(floor_share(results, case, name, macs["both"] / calls(case)))
        cells.append(error_cell(results, case, name))
        rows.append(cells)
    failed = [
        f"{CONTENDERS[name].label}: {entry['failed']}"
        for record in results.records(case)
        for name, entry in record["contenders"].items()
        if "failed" in entry and results.rounds(case, name) == 1 << 30
    ]
    head = ["ms: median (quartiles)", *(titles[work] for work in case.reported)]
    head += ["times saccade's", "share of the floor", "max abs error"]
    parts = [
        f"### {size(case)}",
        f"Multiply-adds of the exact computation, 1e9: {floors}.",
        table(head, rows),
    ]
    return "\n\n".join(parts + [f"Could not run: {'; '.join(dict.fromkeys(failed))}."] * bool(failed))


def error_cell(results: Results, case: Case, name: str) -> str:
    """Largest difference from the reference, and what is to be said about it."""
    error, scale = results.error(case, name)
    if "future_refresh" in CONTENDERS[name].options:
        return f"{error:.1e}, since it computes less"
    return f"{error:.1e}" + ("" if results.is_correct(case, name) else f" of {scale:.1f}: **not correct**")


def size(case: Case) -> str:
    """The case's sizes in words."""
    parts = [f"T_vl {case.num_vl_tokens}", f"N {case.num_future_tokens}"]
    parts += [f"{case.batch} observations"] * (case.batch > 1) + [f"{case.samples} samples"] * (
        case.samples > 1
    )
    return ", ".join([*parts, plural(case.threads)])


def calls(case: Case) -> int:
    """How many layers a work goes through, of which the time is that of one."""
    return config(case).num_layers // 2 if case.piece == "cross" else 1


def config(case: Case) -> HeadConfig:
    """Of the head that the piece is cut from."""
    return HeadConfig.from_dict(inputs.config_of(case))


def arithmetic(name: str) -> str:
    """`float32`, `bfloat16` or `int8`."""
    return next((kind for kind in ("float32", "int8") if kind in name), "bfloat16")


def floor_share(results: Results, case: Case, name: str, macs: float) -> str:
    """Time that the exact multiply-adds take at the peak of the contender's arithmetic, over its own time."""
    isa = CONTENDERS[name].environment.get("SACCADE_ISA", results.data["machine"]["isa"])
    peak = results.peak(case.threads, isa, arithmetic(name))
    seconds = results.seconds(case, name, "both")
    if peak is None or not seconds or "future_refresh" in CONTENDERS[name].options:
        return ""  # with future_refresh less is computed than the floor counts
    return f"{100 * macs / peak / quartiles(seconds)[1]:.0f} %"


def number(seconds: float) -> str:
    """Milliseconds with four digits at most."""
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 1000 else f"{value:.1f}" if value >= 10 else f"{value:.3f}"


def milliseconds(seconds: list[float]) -> str:
    """The median."""
    return f"{1e3 * quartiles(seconds)[1]:.0f}" if seconds else ""


def faster_peers(results: Results) -> str:
    """Every case in which a correct peer beats saccade in the same arithmetic."""
    lines = []
    for case in results.cases:
        if case.piece not in PIECES or case.size != "full":
            continue
        for work in case.reported:
            for name in results.names(case):
                ours = f"saccade-{arithmetic(name)}"
                if (
                    name.startswith("saccade")
                    or ours not in results.names(case)
                    or not results.is_correct(case, name)
                ):
                    continue
                compared = results.ratio(case, ours, name, work)
                if compared is not None and compared[1] > 1:
                    title = (WORK_TITLES if case.piece == "head" else PART_TITLES)[work]
                    lines.append(
                        f"- {CONTENDERS[name].label}: {PIECES[case.piece].lower()}, {title}, {size(case)}: "
                        f"{compared[1]:.2f} times as fast as {CONTENDERS[ours].label}."
                    )
    return "\n".join(lines) or "Nowhere in what was measured, arithmetic by arithmetic."


def linear(results: Results) -> list[str]:
    """Linear layers as `cargo bench --bench linear` measured them, then the engines timed from here."""
    parts = []
    shapes = Case("linear", 1).works
    benched = {
        rate["threads"]
        for bench in results.data["linear"]
        for case in bench["cases"]
        for rate in case["rates"]
    }
    for threads in sorted(benched | {case.threads for case in usual(results, "linear")}):
        case = Case("linear", threads)
        rows = [[name, *cells] for name, cells in benched_linear(results, threads).items()]
        macs = exact_macs(config(case), case)
        for name in sorted(results.names(case), key=list(CONTENDERS).index):
            rates = [macs[work] / quartiles(results.seconds(case, name, work))[1] / 1e9 for work in shapes]
            error = "" if results.is_correct(case, name) else ": **not correct**"
            rows.append([CONTENDERS[name].label + error, *(f"{rate:.0f}" for rate in rates)])
        parts += [f"### {plural(threads)}", table(["GMAC/s, rows x inputs x outputs", *shapes], rows)]
    how = "`cargo bench --bench linear`; in brackets the share of the peak of the same arithmetic."
    return ["## Linear layers, weights from memory", how, *parts] if parts else []


def benched_linear(results: Results, threads: int) -> dict[str, list[str]]:
    """Rate and share of the peak of the linear layers that `cargo bench` measured, by name and shape."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for bench in results.data["linear"]:
        for case in bench["cases"]:
            for rate in case["rates"]:
                if (
                    not rate["name"].startswith("peak")
                    and rate["threads"] == threads
                    and rate["of_peak"]["samples"]
                ):
                    pair = (rate["gmacs"]["median"], rate["of_peak"]["median"])
                    found.setdefault(rate["name"], {}).setdefault(case["case"], []).append(pair)
    shapes = [f"{rows} x {inputs_} x {outputs}" for rows, inputs_, outputs in LINEAR_SHAPES]
    cells: dict[str, list[str]] = {}
    for name, cases in found.items():
        cells[name] = []
        for shape in shapes:
            pairs = cases.get(shape, [])
            middles = [quartiles(each)[1] for each in zip(*pairs, strict=True)] if pairs else []
            cells[name].append(f"{middles[0]:.0f} ({100 * middles[1]:.0f} %)" if middles else "")
    return cells


def settings(results: Results) -> list[str]:
    """Settings of a peer that were tried and that another one of the same engine beats."""
    tried = {name for name, contender in CONTENDERS.items() if not contender.usual}
    cases = [case for case in results.cases if tried & set(results.names(case))]
    if not cases:
        return []
    rows = []
    for case in cases:
        for name in sorted(tried & set(results.names(case)), key=list(CONTENDERS).index):
            error, _ = results.error(case, name)
            seconds = results.seconds(case, name, "both")
            taken = taken_instead(name)
            other = results.seconds(case, taken, "both")
            if seconds:
                rows.append(
                    [
                        f"{case.piece}, {size(case)}",
                        CONTENDERS[name].label,
                        number(quartiles(seconds)[1]),
                        f"{error:.1e}",
                        CONTENDERS[taken].label,
                        number(quartiles(other)[1]) if other else "",
                    ]
                )
    head = ["piece", "tried", "ms", "max abs error", "taken", "ms"]
    return ["## Settings tried", table(head, rows)]


def taken_instead(name: str) -> str:
    """The usual contender of the engine and arithmetic of one that is not."""
    contender = CONTENDERS[name]
    return next(
        (
            other
            for other, candidate in CONTENDERS.items()
            if candidate.usual
            and candidate.engine == contender.engine
            and arithmetic(other) == arithmetic(name)
            and candidate.options.get("compiled") == contender.options.get("compiled")
        ),
        name,
    )


def cost(results: Results, images: str) -> list[str]:
    """How the time grows with each size, and how near that is to a straight line."""
    rows = []
    for case in [case for case in results.cases if case.piece == "cost" and case.size == "full"]:
        for name in results.names(case):
            for title, points in cost_lines(results, case, name).items():
                slope, start, fit = straight(points)
                rows.append(
                    [
                        CONTENDERS[name].label,
                        plural(case.threads),
                        title,
                        f"{1e3 * start:.1f} + {1e3 * slope:.3g} x",
                        f"{fit:.4f}",
                        ", ".join(f"{value:g}: {number(seconds)}" for value, seconds in points),
                    ]
                )
    if not rows:
        return []
    head = ["", "", "work, x", "ms = ", "R²", "measured, ms"]
    return [
        "## The cost model",
        f"![Time against N, T_vl, steps and samples]({images}/cost.png)",
        "One size varied, the others as released (N 32, T_vl 296, 4 steps, 1 sample); least squares.",
        table(head, rows),
    ]


def cost_lines(results: Results, case: Case, name: str) -> dict[str, list[tuple[float, float]]]:
    """`work, size` -> points (size, median seconds)."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for work in case.works:
        seconds = results.seconds(case, name, work)
        if seconds:
            title, _, value = work.rpartition(" ")
            lines.setdefault(title, []).append((float(value), quartiles(seconds)[1]))
    return lines


def straight(points: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Slope, start and R² of the least-squares line."""
    xs, ys = zip(*points, strict=True)
    middle_x, middle_y = sum(xs) / len(xs), sum(ys) / len(ys)
    spread = sum((x - middle_x) ** 2 for x in xs)
    slope = sum((x - middle_x) * (y - middle_y) for x, y in points) / spread
    start = middle_y - slope * middle_x
    left = sum((y - start - slope * x) ** 2 for x, y in points)
    total = sum((y - middle_y) ** 2 for y in ys)
    return slope, start, 1.0 - left / total if total else 1.0


def table(head: list[str], rows: Iterable[list[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def figures(results: Results, folder: Path) -> None:
    """`performance.png`: the whole head in every engine; `cost.png`: the cost model; where measured."""
    import matplotlib as mpl

    mpl.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    if usual(results, "head"):
        draw_head(results, folder / "performance.png")
    if any(case.piece == "cost" for case in results.cases):
        draw_cost(results, folder / "cost.png")


def draw_head(results: Results, path: Path) -> None:
    """Bars: encode and sample in every engine, one panel a thread count."""
    from matplotlib import pyplot as plt

    cases = usual(results, "head")
    names = [name for name in CONTENDERS if any(name in results.names(case) for case in cases)][::-1]
    figure, axes = plt.subplots(
        1, len(cases), figsize=(5.5 * len(cases), 0.34 * len(names) + 1.2), sharey=True, squeeze=False
    )
    for axis, case in zip(axes[0], cases, strict=True):
        for row, name in enumerate(names):
            if name in results.names(case):
                colour = "#1b6ca8" if name.startswith("saccade") else "#9a9a9a"
                encode, sample = (
                    1e3 * quartiles(results.seconds(case, name, work))[1] for work in ("encode", "sample")
                )
                axis.barh(row, encode, color=colour, alpha=0.55)
                axis.barh(row, sample, left=encode, color=colour)
                axis.text(encode + sample, row, f" {encode + sample:.0f}", va="center", fontsize=8)
        axis.set_title(f"{plural(case.threads)}: encode (light) + sample", fontsize=10)
        axis.set_xlabel("ms")
        axis.margins(x=0.12)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_yticks(range(len(names)), [CONTENDERS[name].label for name in names], fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_cost(results: Results, path: Path) -> None:
    """Points and least-squares lines, one panel a size."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(COST) + 1, figsize=(16, 3.4))
    case = next(case for case in results.cases if case.piece == "cost")
    for name in results.names(case):
        for axis, (title, points) in zip(axes, sorted(cost_lines(results, case, name).items()), strict=True):
            slope, start, fit = straight(points)
            xs = [0.0, max(x for x, _ in points)]
            (line,) = axis.plot(xs, [1e3 * (start + slope * x) for x in xs], linewidth=1)
            label = f"{CONTENDERS[name].label}, R² {fit:.4f}"
            axis.plot(
                [x for x, _ in points], [1e3 * y for _, y in points], "o", color=line.get_color(), label=label
            )
            axis.set_title(f"{title}, {plural(case.threads)}", fontsize=10)
            axis.set_ylim(bottom=0)
            axis.spines[["top", "right"]].set_visible(False)
            axis.legend(fontsize=7, frameon=False)
    axes[0].set_ylabel("ms")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)
