"""The report of `make bench-peers`: Markdown and figures of one machine; the page of all machines."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from benches.files import write_text
from benches.pages.report import require_commit
from benches.peers.cases import LINEAR_SHAPES, Case, exact_macs
from benches.peers.contenders import CONTENDERS
from benches.peers.figures import cost_lines, straight, write_figures
from benches.peers.floors import floor
from benches.peers.goals import goals
from benches.peers.results import Results, records
from benches.peers.text import (
    PART_TITLES,
    PIECES,
    WORK_TITLES,
    arithmetic,
    calls,
    config,
    number,
    plural,
    size,
    table,
    usual,
)
from benches.peers.throughput import throughput
from saccade_lab.timing import quartiles

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "performance.md"
IMAGES = PAGE.parent
NOTES = Path(__file__).with_name("notes.md")
OVERVIEW_ROWS = (
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


def command(results: Results, args: argparse.Namespace) -> int:
    """`python -m benches.peers report`."""
    if args.write:
        measured = records(args.record)
        for each in measured:
            require_commit(each.data, each.path)
        write_text(PAGE, page(measured))
        for each in measured:
            write_figures(each, IMAGES)
        return 0
    if not results.data["machine"]:
        raise SystemExit(f"bench-peers: {args.results} has no measurements; run `make bench-peers`")
    write(results, args.results.parent)
    return 0


def write(results: Results, folder: Path) -> None:
    """Writes `report.md` and its figures into the folder of the JSON file."""
    write_figures(results, folder)
    write_text(folder / "report.md", document(results))
    print(folder / "report.md")


def document(results: Results) -> str:
    """The report of one machine, beside its figures."""
    return joined([f"# Performance, {results.cpu}", *of_machine(results, "."), NOTES.read_text().strip()])


def page(measured: list[Results]) -> str:
    """docs/results/performance.md: all machines, one after the other."""
    names = "; ".join(results.cpu for results in measured)  # names have commas
    parts = [
        "# Speed of the action head",
        f"CPUs measured: {names}. A number of one CPU says little about another. `make bench-peers` measures "
        "a machine in half an hour and keeps the numbers in `benches/peers/results/`, one file per CPU "
        "family; `python -m benches.peers report --write` writes this page from these files.",
        across(measured),
    ]
    for results in measured:
        parts += [f"## {results.cpu}", *(demoted(part) for part in of_machine(results, "."))]
    return joined([*parts, NOTES.read_text().strip()])


def of_machine(results: Results, images: str) -> list[str]:
    """What was measured on one machine; `images` is the folder of the figures, relative to the text."""
    return [
        overview(results),
        machine(results),
        "## Targets",
        goals(results),
        said_of(results),
        f"![The whole head, encode + sample, in every engine]({images}/performance-{results.slug}.png)",
        *sections(results),
        "## Where a peer is faster",
        faster_peers(results),
        *linear(results),
        *throughput(results),
        *settings(results),
        *cost(results, images),
    ]


def said_of(results: Results) -> str:
    """What is to be said about the numbers: the Markdown file beside them, if there is one."""
    path = results.path.with_suffix(".md")
    return path.read_text().strip() if path.exists() else ""


def demoted(text: str) -> str:
    """Headings one level lower."""
    return re.sub(r"^#", "##", text, flags=re.MULTILINE)


def joined(parts: list[str]) -> str:
    """Paragraphs, without empty ones."""
    return "\n\n".join(part for part in parts if part) + "\n"


def across(measured: list[Results]) -> str:
    """A table of the whole head on two threads, one column per CPU; empty if there is only one."""
    case = Case("head", 2)
    rows = []
    for name in OVERVIEW_ROWS:
        cells = [
            " / ".join(milliseconds(results.seconds(case, name, work)) for work in ("both", "sample"))
            if name in results.names(case)
            else ""
            for results in measured
        ]
        if any(cells):
            rows.append([CONTENDERS[name].label, *cells])
    head = ["ms: encode + sample / sample from a cached context, 2 threads", *(each.cpu for each in measured)]
    return table(head, rows) if len(measured) > 1 else ""


def overview(results: Results) -> str:
    """A table of the whole head at the released size in every engine."""
    cases = usual(results, "head")
    if not cases:
        return "Nothing measured yet."
    threads = [case.threads for case in cases]
    titles = [f"encode + sample, {plural(count)}" for count in threads]
    titles += [f"sample from a cached context, {plural(count)}" for count in threads]
    rows = []
    for name in OVERVIEW_ROWS:
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


def machine(results: Results) -> str:
    """The machine and the peaks measured on it."""
    held = results.data["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in held["versions"].items() if version)
    lines = [
        "## Machine",
        f"{held['cpu']} ({held['family']}), {held['cores']} cores, {held['memory_gb']} GB, "
        f"Linux {held['kernel']}; flags {', '.join(held['flags'])}. {versions}; commit {held['commit']}.",
    ]
    forced = {
        one.environment["SACCADE_ISA"] for one in CONTENDERS.values() if "SACCADE_ISA" in one.environment
    } - {held["isa"]}
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
        lines += ["Peaks of arithmetic on registers, measured in the same runs (medians):", table(head, rows)]
    return "\n\n".join(lines)


def gigabytes(rate: float | None) -> str:
    """A bandwidth in GB/s; empty if it was not measured."""
    return "" if rate is None else f"{rate / 1e9:.0f}"


def sections(results: Results) -> list[str]:
    """One table per case, the usual sizes first."""
    parts = []
    for piece, title in PIECES.items():
        cases = sorted(case for case in results.cases if case.piece == piece and case.size == "full")
        if cases:
            parts.append(f"## {title}")
            first = usual(results, piece)
            parts += [section(results, case) for case in [*first, *(c for c in cases if c not in first)]]
    return parts


def section(results: Results, case: Case) -> str:
    """Times of every contender, relative to saccade's in the same arithmetic and as a share of the floor."""
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
        cells.append(floor_share(results, case, name))
        cells.append(error_cell(results, case, name))
        rows.append(cells)
    measured = results.names(case)
    failed = [
        f"{CONTENDERS[name].label}: {entry[how]}"
        for record in results.records(case)
        for name, entry in record["contenders"].items()
        for how in ("failed", "killed")
        if how in entry and name not in measured
    ]
    head = ["ms: median (quartiles)", *(titles[work] for work in case.reported)]
    head += ["times saccade's", "share of the floor", "max abs error"]
    parts = [
        f"### {size(case)}",
        f"Multiply-adds of the exact computation, in 1e9: {floors}.",
        table(head, rows),
    ]
    return "\n\n".join(parts + [f"Could not run: {'; '.join(dict.fromkeys(failed))}."] * bool(failed))


def error_cell(results: Results, case: Case, name: str) -> str:
    """Largest difference from the reference, marked if the result is not correct."""
    error, scale = results.error(case, name)
    if "future_refresh" in CONTENDERS[name].options:
        return f"{error:.1e}, since it computes less"
    return f"{error:.1e}" + ("" if results.is_correct(case, name) else f" of {scale:.1f}: **not correct**")


def floor_share(results: Results, case: Case, name: str) -> str:
    """The least time of the exact computation in the contender's arithmetic, divided by its own time."""
    least, seconds = floor(results, case, name), results.seconds(case, name, "both")
    if least is None or not seconds or "future_refresh" in CONTENDERS[name].options:
        return ""  # with future_refresh less is computed than the floor counts
    return f"{100 * least / quartiles(seconds)[1]:.0f} %"


def milliseconds(seconds: list[float]) -> str:
    """The median in milliseconds; empty if it was not measured."""
    return f"{1e3 * quartiles(seconds)[1]:.0f}" if seconds else ""


def faster_peers(results: Results) -> str:
    """Every case in which a peer with a correct result is faster than saccade in the same arithmetic."""
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
    return "\n".join(lines) or "In none of the measured cases, compared within each arithmetic."


def linear(results: Results) -> list[str]:
    """Linear layers as `cargo bench --bench linear` measured them, then those of the engines timed here."""
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
    how = "Measured by `cargo bench --bench linear`. Brackets: share of the peak of the same arithmetic."
    return ["## Linear layers, weights from memory", how, *parts] if parts else []


def benched_linear(results: Results, threads: int) -> dict[str, list[str]]:
    """Rates and shares of the peak of the linear layers that `cargo bench` measured, by name and shape."""
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
    """Settings of a peer that were tried and are slower than another setting of the same engine."""
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
    """The usual contender with the same engine and arithmetic; compiled if this one is and there is one."""
    contender = CONTENDERS[name]
    usual_ones = [
        other
        for other, candidate in CONTENDERS.items()
        if candidate.usual and candidate.engine == contender.engine and arithmetic(other) == arithmetic(name)
    ]
    is_alike = [
        CONTENDERS[other].options.get("compiled") == contender.options.get("compiled") for other in usual_ones
    ]
    alike = [other for other, same in zip(usual_ones, is_alike, strict=True) if same]
    return next(iter([*alike, *usual_ones]), name)


def cost(results: Results, images: str) -> list[str]:
    """How the time grows with each size, and how well a straight line describes it."""
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
        f"![Time against N, T_vl, steps and samples]({images}/cost-{results.slug}.png)",
        "One size varies, the others are as released (N 32, T_vl 296, 4 steps, 1 sample); least squares.",
        table(head, rows),
    ]
