"""The measurements, a JSON file that grows from run to run, and their statistics."""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benches.files import write_record
from benches.peers.cases import Case
from saccade_lab.timing import quartiles

FORMAT = 1
RECORDS = Path(__file__).with_name("results")
"""The committed measurements: a JSON file per CPU family, and what to say about it in a Markdown file of the
same name.
"""
TOLERANCE = {"float32": 1e-4, "bfloat16": 5e-2, "int8": 1e-1, "int4": 5e-1}
"""Tolerances relative to the reference's largest absolute value; larger differences are not ranked."""


class Results:
    """The measurements of one machine.

    Attributes: path: The file; written after every round. data: Its content: `machine`, `peaks` (one entry
    per run and thread count), `linear` (the output of `cargo bench --bench linear`), and `records`: a case,
    and the seconds of contenders that ran in the same rounds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        empty: dict[str, Any] = {"format": FORMAT, "machine": {}, "peaks": [], "linear": [], "records": []}
        self.data = json.loads(path.read_text()) if path.exists() else empty
        if self.data["format"] != FORMAT:
            raise SystemExit(f"bench-peers: {path} has format {self.data['format']}, expected {FORMAT}")

    def begin(self, machine: dict[str, Any]) -> bool:
        """Names the machine of what is measured from now on. Measurements that are not comparable are
        `set_aside`: no table mixes them. Whether there were any.
        """
        other = set_aside(self.path, self.data["machine"], machine)
        if other:
            self.data = {"format": FORMAT, "machine": {}, "peaks": [], "linear": [], "records": []}
        self.data["machine"] = machine
        return other

    def save(self, path: Path | None = None) -> None:
        """Writes the file, or a copy to `path`."""
        path = path or self.path
        path.parent.mkdir(parents=True, exist_ok=True)
        write_record(path, rounded(self.data))

    @property
    def cpu(self) -> str:
        """The name of the CPU's family, such as `Zen 4`."""
        return str(self.data["machine"]["name"])

    @property
    def slug(self) -> str:
        """`cpu` as a file name, such as `zen-4`."""
        return slug(self.cpu)

    @property
    def cases(self) -> list[Case]:
        """The cases with a record, in the order in which they were first measured."""
        return list(dict.fromkeys(Case(**record["case"]) for record in self.data["records"]))

    def records(self, case: Case) -> Iterator[dict[str, Any]]:
        """The records of a case, oldest first."""
        return (record for record in self.data["records"] if Case(**record["case"]) == case)

    def open(self, case: Case) -> dict[str, Any]:
        """A new record."""
        record: dict[str, Any] = {"case": case.as_dict(), "contenders": {}}
        self.data["records"].append(record)
        return record

    def entries(self, case: Case, name: str) -> Iterator[dict[str, Any]]:
        """The recorded entries of a contender."""
        for record in self.records(case):
            if name in record["contenders"]:
                yield record["contenders"][name]

    def rounds(self, case: Case, name: str) -> int:
        """Number of finished rounds of a contender; one that failed counts as finished, one that was killed
        does not.
        """
        entries = list(self.entries(case, name))
        if entries and "failed" in entries[-1]:
            return 1 << 30
        return sum(len(next(iter(entry.get("seconds", {}).values()), [])) for entry in entries)

    def seconds(self, case: Case, name: str, work: str) -> list[float]:
        """All times of one work."""
        return [value for entry in self.entries(case, name) for value in times(entry, work)]

    def names(self, case: Case) -> list[str]:
        """Contenders of a case with at least one round."""
        names = dict.fromkeys(name for record in self.records(case) for name in record["contenders"])
        return [name for name in names if 0 < self.rounds(case, name) < 1 << 30]

    def error(self, case: Case, name: str) -> tuple[float, float]:
        """Largest absolute difference from the reference, and the reference's largest absolute value."""
        entry = [entry for entry in self.entries(case, name) if "error" in entry][-1]
        return entry["error"], entry["scale"]

    def notes(self, case: Case, name: str) -> str:
        """What the engine said of its settings."""
        return str([entry for entry in self.entries(case, name) if "error" in entry][-1]["notes"])

    def is_correct(self, case: Case, name: str) -> bool:
        """Whether the contender's result is within the tolerance of its arithmetic."""
        error, scale = self.error(case, name)
        arithmetic = next((kind for kind in TOLERANCE if kind in name), "bfloat16")
        return error <= TOLERANCE[arithmetic] * scale

    def ratios(self, case: Case, slower: str, faster: str, work: str) -> list[float]:
        """Time of `slower` divided by that of `faster`, for each round that both did."""
        pairs: list[float] = []
        for record in self.records(case):
            both = [times(record["contenders"].get(name, {}), work) for name in (slower, faster)]
            pairs += [above / below for above, below in zip(*both, strict=False)]
        return pairs

    def ratio(self, case: Case, slower: str, faster: str, work: str) -> tuple[float, float, float] | None:
        """Quartiles of `ratios`, or of all pairs of times if the two never ran in the same round."""
        pairs = self.ratios(case, slower, faster, work)
        if not pairs:
            both = [self.seconds(case, name, work) for name in (slower, faster)]
            pairs = [above / below for above in both[0] for below in both[1]]
        return quartiles(pairs) if pairs else None

    def peak(self, threads: int, isa: str, arithmetic: str) -> float | None:
        """Multiply-adds per second from registers, the median over the runs; None if not measured."""
        values = [
            entry["macs_per_second"].get(isa, {}).get(arithmetic)
            for entry in self.data["peaks"]
            if entry["threads"] == threads
        ]
        known = [value for value in values if value]
        return statistics.median(known) if known else None

    def bandwidth(self, threads: int) -> float | None:
        """Bytes per second read from memory, the median over the runs; None if not measured."""
        values = [
            entry["read_bytes_per_second"] for entry in self.data["peaks"] if entry["threads"] == threads
        ]
        known = [value for value in values if value]
        return statistics.median(known) if known else None


def set_aside(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Gives the file of measurements another name if they are of another machine than `now`.

    Measurements of another CPU, commit, build or version of an engine, or that were timed in another way, are
    not mixed with new ones.

    Args:
        path: The file.
        before: The machine of its measurements; empty if there are none.
        now: The machine of what is measured from now on.

    Returns:
        Whether they are.
    """
    same = ("cpu", "build", "versions", "timing", "commit")
    other = bool(before) and any(before.get(key) != now.get(key) for key in same)
    if other:
        number = sum(1 for _ in path.parent.glob(f"{path.stem}-{before['commit']}-*"))
        path.replace(path.with_name(f"{path.stem}-{before['commit']}-{number}{path.suffix}"))
    return other


def slug(cpu: str) -> str:
    """The name of a CPU's family as a file name: `zen-4` of `Zen 4`."""
    return re.sub(r"[^a-z0-9]+", "-", cpu.lower()).strip("-")


def times(entry: dict[str, Any], work: str) -> list[float]:
    """A contender's times in one record, one per round; `both` of the whole head is the sum of its works."""
    seconds = entry.get("seconds", {})
    if work == "both" and "encode" in seconds:
        return [sum(pair) for pair in zip(seconds["encode"], seconds["sample"], strict=True)]
    return list(seconds.get(work, []))


def rounded(value: Any) -> Any:
    """Numbers rounded to six digits, more than the measurements resolve."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def records(folder: Path = RECORDS) -> list[Results]:
    """The committed measurements, by name of the CPU."""
    return sorted((Results(path) for path in folder.glob("*.json")), key=lambda results: results.cpu)
