"""The report docs/results/backbone.md, from one JSON record per machine."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from benches.backbone import memory, reuse
from benches.backbone.work import backbone_work, floor_seconds
from benches.files import write_record, write_text
from benches.pages.report import require_commit
from benches.peers.goals import reached
from benches.peers.results import TOLERANCE, rounded, slug
from benches.peers.text import plural, table
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.timing import Machine, quartiles

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "backbone.md"
RECORDS = Path(__file__).with_name("results")
"""The committed measurements, a JSON file per CPU family."""

#: Contender, the peer that it is compared with, the ratio to reach, and the ratio beyond.
GOALS = (
    ("saccade-bfloat16", "bfloat16", 1.3, 1.8),
    ("saccade-int8", "bfloat16", 2.5, 4.0),
    ("saccade-float32", "float32", 1.2, 1.5),
)

MISSED = ", **missed**"
"""Beside what is beyond its target."""

Results = dict[str, Any]


def record_of(results: Results) -> Path:
    """The record of this CPU's family."""
    return RECORDS / f"{slug(name_of(results))}.json"


def refusal(results: Results) -> str:
    """Why measurements with these sections do not become the record of their machine; or nothing."""
    kept, commit = record_of(results), results["machine"]["commit"]
    before = json.loads(kept.read_text()) if kept.exists() else {}
    lost = [section for section in SECTIONS if section in before and section not in results]
    if lost:
        return f"{kept.name} has {', '.join(lost)} too, which would be lost"
    return f"{commit} is not a commit" if commit.endswith("-dirty") else ""


def keep(results: Results) -> Path:
    """Writes the record of this CPU's family, and returns its file.

    Raises:
        SystemExit: There is a `refusal`.
    """
    refused = refusal(results)
    if refused:
        raise SystemExit(f"benches.backbone: {refused}")
    write_record(record_of(results), rounded(results))
    return record_of(results)


def report(*, write: bool) -> int:
    """Prints the page of the committed records, or writes it. Returns the exit status.

    Raises:
        SystemExit: There are no records.
        UncommittedError: `write`, and a record is of a tree with uncommitted changes.
    """
    found = {path: json.loads(path.read_text()) for path in RECORDS.glob("*.json")}
    if not found:
        raise SystemExit("benches.backbone: nothing measured yet; run python -m benches.backbone")
    text = page(sorted(found.values(), key=name_of))
    if not write:
        print(text, end="")
        return 0
    for path, results in found.items():
        require_commit(results, path)
    write_text(PAGE, text)
    print(PAGE)
    return 0


def page(measured: Sequence[Results]) -> str:
    """The whole page: each section, with every machine that has it."""
    parts = [
        "# The backbone, measured",
        "N1.5 at its published size with seeded random weights. The machines were otherwise idle. "
        "`python -m benches.backbone` measures a machine and keeps the numbers in "
        "`benches/backbone/results/`, one file per CPU family; `python -m benches.backbone report --write` "
        "writes this page from these files.",
        "\n".join(machine(results) for results in measured),
    ]
    for section, (title, what, write) in SECTIONS.items():
        found = [results for results in measured if results.get(section)]
        if found:
            parts += [f"## {title}", what, *(part for results in found for part in write(results))]
    return "\n\n".join(parts) + "\n"


def name_of(results: Results) -> str:
    """The name of the CPU's family."""
    return str(results["machine"]["name"])


def machine(results: Results) -> str:
    """The machine, what was measured on it, and with what."""
    held = results["machine"]
    sections = ", ".join(title.lower() for section, (title, *_) in SECTIONS.items() if results.get(section))
    versions = ", ".join(
        f"{name} {held['versions'][name]}"
        for name in ("saccade", "torch", "transformers", "numpy")
        if held["versions"].get(name)
    )
    return (
        f"- **{held['name']}** ({sections}): {held['cpu']} ({held['family']}, {held['isa']}), "
        f"{held['cores']} cores, {held['memory_gb']} GB, Linux {held['kernel']}; flags "
        f"{', '.join(held['flags'])}. {versions}; commit {held['commit']}."
    )


def speed(results: Results) -> Iterator[str]:
    """Tables by thread count and number of views, and the goals."""
    goals: list[list[str]] = []
    for entry in results["speed"]:
        peak = peaks(entry, results["machine"]["isa"])
        rates = ", ".join(f"{kind} {rate / 1e9:.0f}" for kind, rate in peak.macs_per_second.items())
        group = "" if entry["group"] == "usual" else ", with torch.compile"
        yield f"### {name_of(results)}, {plural(entry['threads'])}{group}"
        yield f"Peaks: {rates} GMAC/s, {peak.read_bytes_per_second / 1e9:.0f} GB/s."
        rows = list(speed_rows(entry, peak))
        yield table(["ms", "views", "median (quartiles)", "share of the floor", "error"], rows)
        failed = [
            f"{name} failed: {works['failed']}."
            for name, works in entry["contenders"].items()
            if "failed" in works
        ]
        if failed:
            yield " ".join(failed)
        goals += goal_rows(entry)
    if goals:
        yield f"### {name_of(results)}, targets"
        yield table(["", "views", "threads", "times as fast", "target (exceeded at)", "reached"], goals)


def peaks(entry: Results, isa: str) -> Machine:
    """The medians of the peaks that were measured between the rounds."""
    kinds = entry["peaks"][0]["macs_per_second"][isa]
    return Machine(
        isa,
        entry["threads"],
        {
            kind: statistics.median(one["macs_per_second"][isa][kind] for one in entry["peaks"])
            for kind in kinds
        },
        statistics.median(one["read_bytes_per_second"] for one in entry["peaks"]),
    )


def speed_rows(entry: Results, peak: Machine) -> Iterator[list[str]]:
    """A row for each piece of each contender, by number of views."""
    pieces = [
        (int(work.split(", ")[-1]), name, work, measured)
        for name, works in entry["contenders"].items()
        if "failed" not in works
        for work, measured in works.items()
    ]
    for views, name, work, measured in sorted(pieces, key=lambda piece: piece[0]):
        seconds = measured["seconds"]
        share = ""
        if name.startswith("saccade"):
            sizes = BackboneSizes.from_config(entry["config"])
            side = round(sizes.vision.num_positions**0.5)
            works = backbone_work(sizes, [(side, side)] * views, entry["tokens"][str(views)])
            floor = floor_seconds(works, peak, name.split("-")[1])
            share = f"{100 * floor / statistics.median(seconds):.0f} %"
        setting = f" ({work.split(', ')[0]})" if ", " in work else ""
        correct = "" if is_correct(name, measured) else ", wrong"
        label = f"{name.replace('-', ' ')}{setting}"
        yield [label, str(views), spread(seconds), share, f"{measured['error']:.0e}{correct}"]


def is_correct(name: str, measured: Results) -> bool:
    """Whether the error is within the tolerance of the arithmetic."""
    return bool(measured["error"] <= TOLERANCE[name.split("-")[1]])


def goal_rows(entry: Results) -> Iterator[list[str]]:
    """How many times as fast as transformers' fastest correct setting of a dtype, in the same rounds.

    Where transformers is faster in float32 than in bfloat16, that is compared with too, without a target.
    """
    contenders = entry["contenders"]
    for ours, dtype, goal, beyond in GOALS:
        if ours not in contenders or "failed" in contenders[ours]:
            continue
        for views in contenders[ours]:
            peer, in_float32 = (fastest(contenders, kind, views) for kind in (dtype, "float32"))
            if peer is None or not is_correct(ours, contenders[ours][views]):
                continue
            median, cells = compared(entry, ours, views, peer)
            yield [*cells, f"{goal} ({beyond})", reached(median, goal, beyond)]
            if in_float32 is not None and in_float32[0] < peer[0]:
                yield [*compared(entry, ours, views, in_float32)[1], "", ""]


def compared(entry: Results, ours: str, views: str, peer: tuple[float, str, str]) -> tuple[float, list[str]]:
    """How many times as fast as a peer: the median, and the first cells of the row."""
    _, name, work = peer
    contenders = entry["contenders"]
    pairs = zip(contenders[name][work]["seconds"], contenders[ours][views]["seconds"], strict=True)
    first, median, third = quartiles(theirs / own for theirs, own in pairs)
    label = f"{ours.replace('-', ' ')} against {name.replace('-', ' ')} ({work.split(', ')[0]})"
    return median, [label, views, str(entry["threads"]), f"{median:.2f} ({first:.2f} to {third:.2f})"]


def fastest(contenders: Results, dtype: str, views: str) -> tuple[float, str, str] | None:
    """The median, the name and the work of transformers' fastest correct setting, or None."""
    return min(
        (
            (statistics.median(measured["seconds"]), name, work)
            for name in (f"transformers-{dtype}", f"compiled-{dtype}")
            if "failed" not in contenders.get(name, {"failed": ""})
            for work, measured in contenders[name].items()
            if work.split(", ")[-1] == views and is_correct(name, measured)
        ),
        default=None,
    )


def unchanged(results: Results) -> Iterator[str]:
    """Time and share of a full step of each kind of step."""
    yield f"### {name_of(results)}, unchanged views"
    rows = []
    for entry in results["reuse"]:
        full = entry["seconds"]["full step"]
        cells = [spread(full)]
        for piece in list(reuse.PIECES)[1:]:
            seconds = entry["seconds"][piece]
            share = quartiles(part / whole for part, whole in zip(seconds, full, strict=True))[1]
            bits = "" if entry["same_bits"][piece] else ", other bits"
            missed = MISSED if share > reuse.GOALS.get(piece, 1.0) else ""
            cells.append(f"{1e3 * statistics.median(seconds):.0f} ({100 * share:.0f} %{bits}){missed}")
        rows.append([f"{entry['precision']}, {plural(entry['threads'])}", *cells])
    rows.append(
        [
            "target",
            "",
            *(
                f"{100 * reuse.GOALS[piece]:.0f} %" if piece in reuse.GOALS else ""
                for piece in list(reuse.PIECES)[1:]
            ),
        ]
    )
    yield table(["ms", *reuse.PIECES], rows)


def loading(results: Results) -> Iterator[str]:
    """Peaks of memory, and cold loads against reading the files."""
    yield f"### {name_of(results)}, memory and loading"
    rows = []
    for entry in results["memory"]:
        runs = entry["runs"]
        held = runs[0]["nbytes"]

        before, loaded, called = (
            max(run[key] for run in runs) / 1e9 for key in ("before", "loaded", "called")
        )
        most = memory.GOALS.get(entry["precision"]) if entry["what"] == "policy" else None
        load, read = ([run[key] for run in runs] for key in ("load", "read"))
        ratio = statistics.median(a / b for a, b in zip(load, read, strict=True))
        rows.append(
            [
                f"{entry['what']}, {entry['precision']}",
                "" if held is None else f"{held / 1e9:.2f}",
                f"{before:.2f}",
                f"{loaded:.2f}{MISSED if most is not None and loaded > most else ''}",
                f"{called:.2f}",
                f"{statistics.median(load):.1f}",
                f"{statistics.median(read):.1f}",
                f"{ratio:.2f}{MISSED if ratio > memory.LOAD_GOAL else ''}",
            ]
        )
    head = ["", "held", "before", "loaded", "after a call", "load, s", "read, s", "load / read"]
    yield table(head, rows)


def errors(results: Results) -> Iterator[str]:
    """Errors against float64."""
    yield f"### {name_of(results)}, errors"
    rows = []
    for entry in results["accuracy"]:
        layers = "" if entry["layers"] is None else f", {entry['layers'][0]} + {entry['layers'][1]} layers"
        for run, measured in entry["runs"].items():
            cells = (
                [measured["failed"], "", ""]
                if "failed" in measured
                else [f"{measured[key]:.1e}" for key in ("largest", "rms", "worst")]
            )
            rows.append([f"{entry['model']}{layers}", run.replace("-", " "), *cells])
    yield table(["model", "", "largest", "rms", "worst token"], rows)


def spread(seconds: list[float]) -> str:
    """Median and quartiles in milliseconds."""
    first, median, third = (1e3 * each for each in quartiles(seconds))
    return f"{median:.0f} ({first:.0f} to {third:.0f})"


#: What was measured, by its key in the records: title, what is measured, and the parts of one machine.
SECTIONS: dict[str, tuple[str, str, Callable[[Results], Iterator[str]]]] = {
    "speed": (
        "Speed",
        "The backbone alone: pixels and token ids in, features out, the prompt `open the drawer`. Times "
        "are medians with quartiles. transformers is SigLIP, a linear layer and Qwen3 with 12 layers, "
        "without logits, pooling head and cache, all tensors in the named dtype. The floor is the longer "
        "of two times: the multiply-adds at the peak of the arithmetic, measured in the same rounds, and "
        "the weights at the memory's bandwidth. The error is the largest difference from the reference in "
        "float32, relative to the largest feature.",
        speed,
    ),
    "reuse": (
        "Unchanged views",
        "A whole policy with two views, head included: `encode` with the previous context and `sample`. The "
        "percentage is the share of a full step in the same round.",
        unchanged,
    ),
    "memory": (
        "Memory and loading",
        "Peak memory of the process (`VmHWM`) in 10^9 bytes, and seconds of loading with the page cache "
        "dropped, against reading all tensor files. The policy holds one embodiment. Targets: "
        + ", ".join(f"{precision} at most {goal} GB" for precision, goal in memory.GOALS.items())
        + f" loaded, and a load of at most {memory.LOAD_GOAL} times the reading. The host of a virtual "
        "machine may hold the files in its own memory; they are then read faster than weights are packed.",
        loading,
    ),
    "accuracy": (
        "Errors",
        'Features of one view against the reference in float64. "Largest" is the largest error over the '
        'largest feature, "rms" the root-mean-square error over that of the features, "worst token" the '
        'largest rms error of a token over the token\'s rms. "Outliers" has four channels of 40 in the '
        "vision tower's residual stream and four inputs of every down projection that are 32 times as large "
        "as the others. transformers in bfloat16 is what the released code computes.",
        errors,
    ),
}
