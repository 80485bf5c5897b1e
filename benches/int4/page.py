"""The page of docs about int4."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

RUNS = ("bfloat16", "int8", "int4", "int4, calibrated")

ABOUT = """\
Errors are differences from float32 on the same noise, as the root of the sum of squares relative to that of
float32: of normalised actions, and of the backbone's features. Calibrated weights were rounded for other
observations than those that errors are measured on, of the bundled policy in other episodes. Random models
have planted outliers where trained ones have them (`saccade_lab.random_checkpoint`), and their images are
random. "× int8" is the error of the actions over that of int8."""

ABOUT_GROUPS = """\
Errors of actions if the weights of one group of layers are rounded to four bits, and all others and all
inputs of layers are exact. The groups with the largest errors would gain most from more bits."""

ABOUT_SIZE = """\
A whole policy of N1.5's published size with random weights and one embodiment, loaded from what
`saccade quantize` wrote, each load in a process of its own with the page cache dropped: medians. Peak memory
includes the interpreter and its libraries."""

SIZES = ("file, GB", "weights, GB", "peak at loading, GB", "peak with a call, GB", "loading, s", "reading, s")


def document(record: Mapping[str, Any]) -> str:
    """Markdown of a record."""
    machine = record["machine"]
    parts = [
        "# int4: errors, sensitive layers, memory",
        "Written by `python -m benches.int4 report --write` from `benches/int4/results.json`, which "
        f"`python -m benches.int4` measured: {machine['cpu']} ({machine['family']}, "
        f"{machine['isa']}), {machine['cores']} cores; commit {machine['commit']}.",
        "## Errors by precision",
        ABOUT,
        errors(record["accuracy"]),
        "## One group of layers at a time",
        ABOUT_GROUPS,
        groups(record["groups"]),
    ]
    if record.get("size"):
        parts += ["## Memory and loading", ABOUT_SIZE, size(record["size"])]
    return "\n\n".join(parts) + "\n"


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
