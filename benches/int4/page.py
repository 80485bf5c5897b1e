"""The page of docs about int4."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from benches.int4.size import MEASURED
from saccade_lab.study.statistics import paired_difference, scaled, verdict
from saccade_lab.timing import quartiles
from saccade_lab.training.settings import TrainingSettings

RUNS = ("bfloat16", "int8", "int4", "int4, calibrated")

ABOUT = """\
Errors are differences from float32 on the same noise, as the root of the sum of squares relative to that of
float32: of normalised actions, and of the backbone's features. Calibrated weights were rounded for other
observations than those that errors are measured on, of trained policies in other episodes. Random models
have planted outliers where trained ones have them (`saccade_lab.random_checkpoint`), and their images are
random. Weights are rounded for {calibrated} observations, and errors are those on {measured}. "× int8" is
the error of the actions over that of int8."""

ABOUT_GROUPS = """\
Errors of actions if the weights of one group of layers are rounded to four bits, and all others and all
inputs of layers are exact. The groups with the largest errors would gain most from more bits."""

ABOUT_LOOP = """\
Backbone and head at each precision, on the same episodes as float32: seeds that neither training nor
calibration used, an equal number of each task. Differences are in percentage points, with Tango's 95 %
intervals; "no worse" means that the interval contains zero and excludes a loss of 5 points."""

ABOUT_LIBERO = """\
Two [policies](../libero.md#the-policies-of-this-repository), at each precision on episodes that float32 ran
too, with the same noise. A name behind a precision is that of a checkpoint that `saccade quantize` made,
calibrated on 20 demonstrations. Differences and verdicts are as above."""

RAN_LIBERO = """\
(`{name}`, checkpoint {sha256}: `saccade libero --protocol {protocol}`, {start}; {cpu}, {instruction_set},
saccade {saccade}; paired by `python -m benches.int4 libero`.)"""

ABOUT_SIZE = """\
A whole policy of N1.5's published size with random weights, planted outliers and one embodiment, loaded from
what `saccade quantize` wrote, each load in a process of its own with the page cache dropped: medians. Peak
memory includes the interpreter and its libraries."""

ABOUT_TIME = """\
The same policies, one observation at a time, by turns in one process: medians, and the median of the ratios
of one round with its quartiles. The first part is from images to the context of the head, the second a chunk
from a held context."""

ABOUT_BENCH = """\
N1.5's head at its published size with random weights, in runs of `saccade bench --precisions int8 int4
--profile --json`: each precision by turns, ratios as above. A rented machine may change its speed within a
run, so that the median of the ratios says more than the ratio of the medians."""

RAN_BENCH = """\
In the profile of a sample, kernels read weights at {int8:.0f} GB/s in int8 and at {int4:.0f} GB/s in int4, of
{peak:.0f} GB/s that these threads can read. ({family}, {isa}, {num_threads} threads, {num_vl_tokens}
vision-language tokens, saccade {saccade}; kept by `python -m benches.int4 bench`.)"""

NAME = "outliers, N1.5 at its published size"
SIZES = ("file, GB", "weights, GB", "peak at loading, GB", "peak with a call, GB", "loading, s", "reading, s")


def document(record: Mapping[str, Any]) -> str:
    """Markdown of a record, which has what was measured and on what machine, by the word of the command."""
    parts = [
        "# int4: errors, closed loop, memory and time",
        "Written by `python -m benches.int4 report --write` from `benches/int4/results.json`, which "
        "`python -m benches.int4` measured, with the word that each section names.",
    ]
    for word, section in SECTIONS.items():
        if word in record:
            parts += section(record[word])
    return "\n\n".join(parts) + "\n"


def here(word: str, record: Mapping[str, Any]) -> str:
    """What command measured, and on what machine."""
    machine = record["machine"]
    where = f"{machine['cpu']} ({machine['family']}, {machine['isa']}), {machine['cores']} cores"
    return f"(`python -m benches.int4 {word}`: {where}; commit {machine['commit']}.)"


def errors_section(record: Mapping[str, Any]) -> list[str]:
    """Errors by precision, and by group of layers."""
    measured = record["measured"]
    about = ABOUT.format_map(measured["observations"])
    parts = ["## Errors by precision", about, *map(recipe, *zip(*measured["policies"].items(), strict=True))]
    parts.append(errors(measured["models"]))
    parts += ["## One group of layers at a time", ABOUT_GROUPS, groups(measured["groups"])]
    return [*parts, here("errors", record)]


def recipe(name: str, policy: Mapping[str, Any]) -> str:
    """How a policy was trained, in words of the commands."""
    weights = f"{name[0].upper()}{name[1:]}: checkpoint {policy['sha256'][:16]}"
    settings = policy["settings"]
    if settings is None:
        return f"{weights}."
    episodes = ", ".join(
        f"`saccade demos --tasks {task} --episodes {count}`"
        for task, count in settings["demonstrations"]["tasks"].items()
    )
    defaults = TrainingSettings().to_dict()
    other = {name: value for name, value in settings.items() if value != defaults.get(name, value)}
    flags = {"steps": "training_steps"}
    train = " ".join(f"--{flags.get(name, name).replace('_', '-')} {value}" for name, value in other.items())
    return f"{weights}; {episodes}, then `saccade train {train}`, which has the seed {settings['seed']}."


def loop_section(record: Mapping[str, Any]) -> list[str]:
    """Success in closed loop."""
    return ["## Closed loop", ABOUT_LOOP, loops(record["measured"]), here("loop", record)]


def libero_section(record: Mapping[str, Any]) -> list[str]:
    """Success on LIBERO, in runs of other processes than the one that read their results."""
    parts = ["## Closed loop on LIBERO", ABOUT_LIBERO]
    for policy in record["measured"]:
        source = RAN_LIBERO.format(
            name=policy["checkpoint"]["name"],
            sha256=policy["checkpoint"]["sha256"][:16],
            protocol=policy["protocol"]["name"],
            start=policy["protocol"]["start"],
            cpu=policy["machine"]["cpu"],
            instruction_set=policy["instruction_set"],
            saccade=policy["saccade"],
        )
        parts += [loops(policy["runs"]), source]
    return parts


def full_section(record: Mapping[str, Any]) -> list[str]:
    """Memory, loading and time at published size."""
    measured = record["measured"]
    parts = ["## Memory and loading", ABOUT_SIZE, size(measured["size"])]
    return [*parts, "## Time", ABOUT_TIME, times(measured["time"]), here("full", record)]


def bench_section(record: Mapping[str, Any]) -> list[str]:
    """Times of the head on other machines, in runs of `saccade bench`."""
    parts = ["## Time of the head on another machine", ABOUT_BENCH]
    for run in record["measured"]:
        rates = {name: rate / 1e9 for name, rate in run["read"].items()}
        parts += [times(run["time"]), RAN_BENCH.format_map({**run, **run["machine"], **rates})]
    return parts


def calibration_section(record: Mapping[str, Any]) -> list[str]:
    """How long calibration takes."""
    measured = record["measured"]
    words = (
        f"`saccade quantize --calibrate` of the same policy, for {measured['observations']} observations "
        f"({measured['weights']} weights): {measured['seconds'] / 60:.1f} minutes, and at most "
        f"{measured['peak'] / 1e9:.1f} GB of memory."
    )
    return [
        "## Calibration",
        words,
        f"Errors as above, on {MEASURED} other random observations:",
        errors({NAME: measured["errors"]}),
        here("calibrate", record),
    ]


SECTIONS: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "errors": errors_section,
    "loop": loop_section,
    "libero": libero_section,
    "full": full_section,
    "bench": bench_section,
    "calibrate": calibration_section,
}


def errors(measured: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """A row for each model and precision."""
    rows = ["| | actions | × int8 | features |", "|---|---|---|---|"]
    for model, runs in measured.items():
        rows.append(f"| **{model}** | | | |")
        for name in RUNS:
            one, ratio = runs[name], runs[name]["actions"] / runs["int8"]["actions"]
            rows.append(f"| {name} | {one['actions']:.1e} | {ratio:.2f} | {one['features']:.1e} |")
        rows.append(f"| float32, other noise | {runs['other noise']['actions']:.1e} | | |")
    return "\n".join(rows)


def groups(measured: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """A table for each model."""
    tables = []
    for model, rows in measured.items():
        lines = [f"| {model} | plain | calibrated |", "|---|---|---|"]
        lines += [
            f"| {group} | {kinds['int4']:.1e} | {kinds['int4, calibrated']:.1e} |"
            for group, kinds in rows.items()
        ]
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def loops(measured: Mapping[str, Any]) -> str:
    """A row for each policy and precision."""
    rows = ["| | success | difference, points | verdict |", "|---|---|---|---|"]
    for policy, found in measured.items():
        rows.append(f"| **{policy}**: {', '.join(found['tasks'])} | | | |")
        exact = found["success"]["float32"]
        for name, success in found["success"].items():
            cells = [name, f"{sum(success)} of {len(success)}", "", ""]
            if name != "float32":
                difference = paired_difference(success, exact).difference
                points = scaled(difference)
                cells[2:] = [
                    f"{points.value:.1f} ({points.low:.1f} to {points.high:.1f})",
                    verdict(difference),
                ]
            rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def times(measured: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """A row for each part of a call."""
    rows = ["| | int8, ms | int4, ms | int4 over int8 |", "|---|---|---|---|"]
    for part, found in measured.items():
        ratios = [four / eight for four, eight in zip(found["int4"], found["int8"], strict=True)]
        low, middle, high = quartiles(ratios)
        medians = [f"{1e3 * statistics.median(found[name]):.0f}" for name in ("int8", "int4")]
        rows.append(f"| {part} | {' | '.join(medians)} | {middle:.2f} ({low:.2f} to {high:.2f}) |")
    return "\n".join(rows)


def size(measured: Mapping[str, Any]) -> str:
    """A row for each precision, and the ratio."""
    rows = [f"| | {' | '.join(SIZES)} |", "|---" * (len(SIZES) + 1) + "|"]
    table = {}
    for precision, one in measured.items():
        loads = one["loads"]

        def median(key: str, loads: list[dict[str, float]] = loads) -> float:
            return statistics.median(load[key] for load in loads)

        giga = [one["file_bytes"], *(median(key) for key in ("nbytes", "loaded", "called"))]
        table[precision] = [*(value / 1e9 for value in giga), median("load"), median("read")]
        rows.append(f"| {precision} | {' | '.join(f'{value:.2f}' for value in table[precision])} |")
    ratios = [four / eight for four, eight in zip(table["int4"], table["int8"], strict=True)]
    return "\n".join([*rows, f"| int4 over int8 | {' | '.join(f'{value:.2f}' for value in ratios)} |"])
