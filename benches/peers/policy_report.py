"""The report of the whole policy: Markdown of one run, and docs/results/policy-speed.md of all machines."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from benches.files import write_text
from benches.pages.report import require_commit
from benches.peers import results as kept
from benches.peers.cases import RELEASES, Case
from benches.peers.contenders import CONTENDERS
from benches.peers.goals import Goal, reached
from benches.peers.report import demoted, joined, said_of
from benches.peers.results import Results, records
from benches.peers.text import number, plural, table, usual
from saccade_lab.timing import quartiles

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "policy-speed.md"
NOTES = Path(__file__).with_name("policy_notes.md")
RECORDS = kept.RECORDS / "policy"
"""A folder for each release, with a JSON file per CPU family."""

LEROBOT_BF16 = ("policy-lerobot-bfloat16-pure", "policy-lerobot-bfloat16")
LEROBOT_F32 = "policy-lerobot-float32"
OVERVIEW = (
    "policy-lerobot-default",
    "policy-lerobot-bfloat16-pure",
    "policy-compile-bfloat16",
    "policy-vla-bfloat16",
    "policy-openvino-bfloat16",
    "policy-openvino-int8",
    "policy-onnxruntime-int8",
    "policy-saccade-float32",
    "policy-saccade-bfloat16",
    "policy-saccade-int8",
    "policy-saccade-int4",
)
"""The rows of README's table."""
GOALS = tuple(
    Goal(f"{what}, {work}", "policy", work, LEROBOT_BF16, ours, least, beyond)
    for what, ours, least, beyond in (
        ("images + instruction to a chunk, int8", "policy-saccade-int8", 3.0, 4.5),
        ("images + instruction to a chunk, bfloat16", "policy-saccade-bfloat16", 1.7, 2.5),
        ("accelerate(policy, backbone=True), bfloat16", "policy-accelerate-bfloat16", 1.6, 2.3),
    )
    for work in Case("policy", 1).works
)


def command(results: Results, args: argparse.Namespace) -> int:
    """`python -m benches.peers report --only policy`."""
    if args.write:
        measured = recorded(args.record)
        for each in measured:
            require_commit(each.data, each.path)
        write_text(PAGE, page(measured))
        print(PAGE)
        return 0
    if not results.data["machine"]:
        raise SystemExit(
            f"bench-peers: {args.results} has no measurements; run "
            '`make bench-peers PEERS_ARGS="--only policy"`'
        )
    write(results, args.results.parent)
    return 0


def write(results: Results, folder: Path) -> None:
    """Writes `policy-report-RELEASE.md` into the folder of the JSON file."""
    path = folder / f"policy-report-{release_of(results)}.md"
    write_text(path, joined([f"# The whole policy, {title(results)}", *of_run(results), notes()]))
    print(path)


def recorded(folder: Path = RECORDS) -> list[Results]:
    """The committed measurements by name of the CPU, then by release."""
    found = [results for release in RELEASES for results in records(folder / release)]
    return sorted(found, key=lambda results: (results.cpu, release_of(results)))


def release_of(results: Results) -> str:
    """The release that was measured; each has files of its own."""
    (release,) = {case.release for case in results.cases}
    return release


def title(results: Results) -> str:
    """`Zen 4, N1.5`."""
    return f"{results.cpu}, {release_of(results).upper()}"


def page(measured: list[Results]) -> str:
    """docs/results/policy-speed.md: all machines and releases, one after the other."""
    parts = [
        "# Speed of the whole policy",
        "From camera images and an instruction to a chunk of actions: N1.5 and N1.7 at their published sizes "
        "with seeded random weights. "
        '`make bench-peers PEERS_ARGS="--only policy"` measures a machine and keeps the numbers in '
        "`benches/peers/results/policy/`, one file per release and CPU family; "
        "`python -m benches.peers report --only policy --write` writes this page from these files.",
    ]
    for results in measured:
        parts += [f"## {title(results)}", *(demoted(part) for part in of_run(results))]
    return joined([*parts, notes()])


def overview(measured: list[Results]) -> str:
    """The table of README: medians on two threads, one group of columns for each release."""
    head = ["ms"]
    rows = [[CONTENDERS[name].label] for name in OVERVIEW]
    for results in measured:
        release = release_of(results)
        case = Case("policy", 2, release=release)
        head += [*(f"{release.upper()}, {work}" for work in case.works), "error"]
        for name, row in zip(OVERVIEW, rows, strict=True):
            if name not in results.names(case):
                row += [""] * (len(case.works) + 1)
                continue
            error, scale = results.error(case, name)
            row += [number(quartiles(results.seconds(case, name, work))[1]) for work in case.works]
            row.append(f"{error / scale:.1e}")
    return table(head, rows)


def notes() -> str:
    """How it was measured."""
    return NOTES.read_text().strip()


def of_run(results: Results) -> list[str]:
    """What was measured of one release on one machine."""
    cases = usual(results, "policy", release_of(results))
    return [
        machine(results),
        *(["## Targets", goals(results)] if goals(results) else []),
        said_of(results),
        *(part for case in cases for part in section(results, case)),
    ]


def machine(results: Results) -> str:
    """The machine in a few sentences, with its peaks."""
    held = results.data["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in held["versions"].items() if version)
    parts = [
        f"{held['cpu']} ({held['family']}, {held['isa']}), {held['cores']} cores, {held['memory_gb']} GB, "
        f"Linux {held['kernel']}; flags {', '.join(held['flags'])}. {versions}; commit {held['commit']}."
    ]
    for threads in sorted({entry["threads"] for entry in results.data["peaks"]}):
        rates = {kind: results.peak(threads, held["isa"], kind) for kind in ("float32", "bfloat16", "int8")}
        known = ", ".join(f"{kind} {rate / 1e9:.0f}" for kind, rate in rates.items() if rate)
        bandwidth = results.bandwidth(threads)
        read = "" if bandwidth is None else f", {bandwidth / 1e9:.0f} GB/s"
        parts.append(f"Peaks of {plural(threads)}: {known} GMAC/s{read}.")
    return " ".join(parts)


def goals(results: Results) -> str:
    """The table of targets, and whether each was reached. They are those of N1.5."""
    rows = [
        row for case in usual(results, "policy") for goal in GOALS for row in goal_row(results, case, goal)
    ]
    head = ["", "against", "threads", "target (exceeded at)", "times as fast (quartiles)", "reached"]
    return table(head, rows) if rows else ""


def goal_row(results: Results, case: Case, goal: Goal) -> Iterator[list[str]]:
    """A target against the fastest correct of its peers; nothing if it was not measured."""
    measured = results.names(case)
    peers = [name for name in goal.peers if name in measured and results.is_correct(case, name)]
    if not peers or goal.ours not in measured:
        return
    peer = min(peers, key=lambda name: quartiles(results.seconds(case, name, goal.work))[1])
    compared = results.ratio(case, peer, goal.ours, goal.work)
    assert compared is not None
    low, median, high = compared
    correct = results.is_correct(case, goal.ours)
    yield [
        goal.what,
        CONTENDERS[peer].label,
        str(case.threads),
        f"{goal.least} x ({goal.beyond} x)",
        f"{in_turn(results, case, peer, goal.ours, goal.work)}{median:.2f} x ({low:.2f} to {high:.2f})",
        reached(median, goal.least, goal.beyond) if correct else "**not correct**",
    ]


def section(results: Results, case: Case) -> list[str]:
    """Times of every contender, and relative to lerobot's fastest bfloat16."""
    names = sorted(results.names(case), key=list(CONTENDERS).index)
    rows = []
    for name in names:
        cells = [CONTENDERS[name].label]
        for work in case.works:
            low, median, high = quartiles(results.seconds(case, name, work))
            cells.append(f"{number(median)} ({number(low)} to {number(high)})")
            cells.append(speed_up(results, case, name, work))
        error, scale = results.error(case, name)
        cells.append(f"{error / scale:.1e}" + ("" if results.is_correct(case, name) else ", **not correct**"))
        rows.append(cells)
    head = ["ms"]
    for work in case.works:
        head += [f"{work}: median (quartiles)", "against lerobot, eager"]
    failed = {
        CONTENDERS[name].label: entry[how]
        for record in results.records(case)
        for name, entry in record["contenders"].items()
        for how in ("failed", "killed")
        if how in entry and name not in results.names(case)
    }
    said = [f"- {label} could not run: {reason}" for label, reason in failed.items()]
    notes = {CONTENDERS[name].label: results.notes(case, name) for name in names}
    said += [f"- {label}: {note}." for label, note in notes.items() if note]
    threads = plural(case.threads).capitalize()
    return [f"## {threads}", table([*head, "error"], rows), faster_in_float32(results, case), "\n".join(said)]


def faster_in_float32(results: Results, case: Case) -> str:
    """How saccade compares with lerobot float32, if in every work that is faster than lerobot's bfloat16."""
    if LEROBOT_F32 not in results.names(case) or not results.is_correct(case, LEROBOT_F32):
        return ""
    for work in case.works:
        peer = fastest_bfloat16(results, case, work)
        median = quartiles(results.seconds(case, LEROBOT_F32, work))[1]
        if peer is None or median >= quartiles(results.seconds(case, peer, work))[1]:
            return ""
    said = []
    for name in ("policy-saccade-float32", "policy-saccade-bfloat16", "policy-saccade-int8"):
        if name in results.names(case) and results.is_correct(case, name):
            ratios = [ratio_to(results, case, LEROBOT_F32, name, work) for work in case.works]
            said.append(f"{CONTENDERS[name].label} {' and '.join(ratios)}")
    if not said:
        return ""
    return (
        "Here lerobot is faster in float32 than in bfloat16 without `torch.compile`. Against lerobot float32 "
        f"({' and '.join(case.works)}): {'; '.join(said)}."
    )


def fastest_bfloat16(results: Results, case: Case, work: str) -> str | None:
    """lerobot's fastest correct bfloat16 setting without torch.compile, or None."""
    peers = [peer for peer in LEROBOT_BF16 if peer in results.names(case) and results.is_correct(case, peer)]
    return min(peers, key=lambda each: quartiles(results.seconds(case, each, work))[1], default=None)


def speed_up(results: Results, case: Case, name: str, work: str) -> str:
    """How many times as fast as lerobot's fastest correct bfloat16."""
    peer = fastest_bfloat16(results, case, work)
    return "" if peer is None else ratio_to(results, case, peer, name, work)


def ratio_to(results: Results, case: Case, peer: str, name: str, work: str) -> str:
    """How many times as fast as a peer, the median, marked if the times are not from the same rounds."""
    compared = results.ratio(case, peer, name, work)
    assert compared is not None
    return f"{in_turn(results, case, peer, name, work)}{compared[1]:.2f} x"


def in_turn(results: Results, case: Case, peer: str, name: str, work: str) -> str:
    """The mark of a ratio of times that are not from the same rounds."""
    return "" if results.ratios(case, peer, name, work) else "~"
