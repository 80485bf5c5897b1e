"""Writes the tables of docs/robots.md: data configs, tags, and what is computed or refused for each release.

    python -m benches.pages.robots

Every cell of the last table is tried: a small checkpoint folder of the release, from `tests/data/robots`, is
changed and its robot is loaded and used. `--check` only says whether the page is up to date.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from benches.files import write_text
from saccade.robots import RELEASED, DataConfig
from saccade.robots.embodiments import N15_IDS, N16_IDS, N17_IDS, N17_NAMES

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "robots.md"
DATA = ROOT / "tests" / "data" / "robots"

Json = dict[str, Any]
#: Changes a folder of a release.
Change = Callable[[Path], object]

#: A folder of each release: absolute joints, min-max.
FOLDERS = {
    "N1, N1.5": "n15/03-so100",
    "N1.6": "n16_n17/13-n16-not-relative",
    "N1.7": "n16_n17/09-n17-constants",
    "lerobot N1.5": "lerobot/n15-044-default",
    "lerobot N1.7": "lerobot/n17-native-plain",
}


@dataclass(frozen=True)
class Situation:
    """A row: what it is, and how the folder of each release comes to have it."""

    text: str
    changes: Mapping[str, Change | str]
    options: Json = field(default_factory=dict)


def edit(name: str, change: Callable[[Json], object]) -> Change:
    """A change of a JSON file, which may be in `processor/`."""

    def apply(folder: Path) -> None:
        path = folder / name
        values = json.loads(path.read_text())
        change(values)
        path.write_text(json.dumps(values))

    return apply


def kwargs(change: Callable[[Json], object]) -> Change:
    """A change of the `processor_kwargs`."""
    return edit("processor_config.json", lambda values: change(values["processor_kwargs"]))


def robot(kind: str, change: Callable[[Json], object]) -> Change:
    """A change of the modality config of the first robot's states or actions."""

    def apply(values: Json) -> None:
        change(next(iter(values["modality_configs"].values()))[kind])

    return kwargs(apply)


def step(file: str, start: str, change: Callable[[Json], object]) -> Change:
    """A change of the options of lerobot's step whose name begins with `start`."""

    def apply(values: Json) -> None:
        found = next(one for one in values["steps"] if one["registry_name"].startswith(start))
        change(found["config"])

    return edit(file, apply)


def add_step(file: str, given: Json) -> Change:
    """One more step of lerobot's pipeline."""
    return edit(file, lambda values: values["steps"].insert(len(values["steps"]) - 1, given))


def config_of(change: Callable[[Json], object]) -> Change:
    """A change of the data config, which is a file of the folder."""

    def apply(folder: Path) -> None:
        known = RELEASED["so100"]
        values = {name: _plain(value) for name, value in vars(known).items()}
        change(values)
        (folder / "config-of-test.json").write_text(json.dumps(values))

    return apply


def _plain(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else list(value)


def unused_nan(values: Json) -> None:
    """NaN in statistics that nothing reads: deviations."""
    for one in _statistics(values):
        one["std"] = _with_nan(one["std"])


def used_nan(values: Json) -> None:
    """NaN in statistics that are read: bounds."""
    for one in _statistics(values):
        for name in ("min", "q01"):
            if name in one:
                one[name] = _with_nan(one[name])


def _with_nan(row: Any) -> Any:
    return [_with_nan(one) for one in row] if isinstance(row, list) else math.nan


def _statistics(values: Any) -> Iterator[Json]:
    """Statistics of keys anywhere in a JSON value."""
    if isinstance(values, dict):
        if "std" in values:
            yield values
        else:
            for one in values.values():
                yield from _statistics(one)
    elif isinstance(values, list):
        for one in values:
            yield from _statistics(one)


ISAAC = "experiment_cfg/metadata.json"
BEFORE, AFTER = "policy_preprocessor.json", "policy_postprocessor.json"
UNKNOWN = {"registry_name": "my_step_v1", "config": {"scale": 2}}
OFF = {"registry_name": "my_step_v1", "config": {"enabled": False}}


def absolute_step(folder: Path) -> None:
    """The generic relative actions of lerobot 0.5, enabled."""
    add_step(BEFORE, {"registry_name": "delta_actions_processor", "config": {"enabled": True}})(folder)
    add_step(AFTER, {"registry_name": "absolute_actions_processor", "config": {"enabled": True}})(folder)


def long_chunk(values: Json) -> None:
    """A chunk of more steps than any head of the release."""
    values["delta_indices"] = list(range(80))


SITUATIONS = (
    Situation("as it was saved", dict.fromkeys(FOLDERS, lambda folder: None)),
    Situation(
        "files of the processor in `processor/`",
        {"N1.6": "n16_n17/11-n16-bridge-real", "N1.7": "n16_n17/02-n17-droid-real"},
    ),
    Situation(
        "no data config, joints only (with a warning)",
        {"N1, N1.5": lambda folder: (folder / "config-of-test.json").unlink()},
    ),
    Situation("no data config, `gr1`", {"N1, N1.5": "n15/02-gr1-arms-waist"}, {"data_config": None}),
    Situation("rotations that are converted", {"N1, N1.5": "n15/12-rotations"}),
    Situation("a rotation whose kind the file does not say", {"N1, N1.5": "n15/16-refuse-no-rotation-type"}),
    Situation("`scale` for an action", {"N1, N1.5": "n15/18-refuse-scale-action"}),
    Situation(
        "means and deviations", {"N1, N1.5": "n15/10-libero-mean-std", "N1.7": "n16_n17/06-n17-mean-std"}
    ),
    Situation(
        "sines and cosines of states", {"N1, N1.5": "n15/01-gr1-arms-only", "N1.7": "n16_n17/07-n17-sincos"}
    ),
    Situation(
        "several states in an observation",
        {
            "N1, N1.5": "n15/13-history",
            "N1.6": "n16_n17/14-n16-history",
            "N1.7": "n16_n17/05-n17-rotvec-history",
        },
    ),
    Situation(
        "joints relative to the state, statistics by step",
        {
            "N1.6": "n16_n17/10-n16-g1",
            "N1.7": "n16_n17/03-n17-so100-real",
            "lerobot N1.7": "lerobot/n17-native-relative",
        },
    ),
    Situation(
        "relative poses `XYZ_ROT6D`",
        {
            "N1.6": "n16_n17/12-n16-eef",
            "N1.7": "n16_n17/04-n17-bimanual-rot6d",
            "lerobot N1.7": "lerobot/n17-native-eef",
        },
    ),
    Situation(
        "relative poses `XYZ_ROTVEC`", {"N1.6": "n16_n17/12-n16-eef", "N1.7": "n16_n17/05-n17-rotvec-history"}
    ),
    Situation("relative poses as matrices (`EEF`, `DEFAULT`)", {"N1.7": "n16_n17_refused/matrix"}),
    Situation(
        "`exclude_state`",
        {
            "N1.6": kwargs(lambda values: values.update(exclude_state=True)),
            "N1.7": "n16_n17/08-n17-exclude-state",
        },
    ),
    Situation(
        "lerobot's generic relative actions",
        {"lerobot N1.7": "lerobot/n17-generic-relative", "lerobot N1.5": absolute_step},
    ),
    Situation("LIBERO's gripper, as `config.json` decides", {"lerobot N1.7": "lerobot/n17-native-libero"}),
    Situation("a `rename_map`", {"lerobot N1.7": "lerobot/n17-rename"}),
    Situation(
        "a chunk longer than the release allows",
        {"N1.6": robot("action", long_chunk), "N1.7": robot("action", long_chunk)},
    ),
    Situation(
        "a state wider than the head's", {"N1, N1.5": "n15/14-wide", "N1.7": "n16_n17_refused/state-too-wide"}
    ),
    Situation(
        "NaN in statistics that are not used",
        {
            "N1, N1.5": edit(ISAAC, unused_nan),
            "N1.6": edit("statistics.json", unused_nan),
            "N1.7": edit("statistics.json", unused_nan),
            "lerobot N1.5": "lerobot/n15-044-default",
            "lerobot N1.7": edit(AFTER, unused_nan),
        },
    ),
    Situation(
        "NaN in statistics that are used",
        {
            "N1, N1.5": edit(ISAAC, used_nan),
            "N1.6": edit("statistics.json", used_nan),
            "N1.7": edit("statistics.json", used_nan),
            "lerobot N1.7": edit(AFTER, used_nan),
        },
    ),
    Situation(
        "an unknown option",
        {
            "N1, N1.5": config_of(lambda values: values.update(surprise=1)),
            "N1.6": kwargs(lambda values: values.update(surprise=1)),
            "N1.7": kwargs(lambda values: values.update(surprise=1)),
            "lerobot N1.5": step(BEFORE, "groot_pack", lambda values: values.update(surprise=1)),
            "lerobot N1.7": step(BEFORE, "groot_n1_7_pack", lambda values: values.update(surprise=1)),
        },
    ),
    Situation(
        "an unknown option that is null or false",
        {
            "N1.6": kwargs(lambda values: values.update(surprise=None)),
            "N1.7": kwargs(lambda values: values.update(surprise=False)),
            "lerobot N1.5": step(BEFORE, "groot_pack", lambda values: values.update(surprise=None)),
            "lerobot N1.7": step(BEFORE, "groot_n1_7_pack", lambda values: values.update(surprise=[])),
        },
    ),
    Situation(
        "an unknown representation",
        {
            "N1, N1.5": config_of(
                lambda values: values["target_rotations"].update({"state.single_arm": "matrix"})
            ),
            "N1.7": "n16_n17_refused/unknown-format",
        },
    ),
    Situation(
        "an unknown step",
        {"lerobot N1.5": add_step(AFTER, UNKNOWN), "lerobot N1.7": add_step(AFTER, UNKNOWN)},
    ),
    Situation(
        "an unknown step that is not enabled",
        {"lerobot N1.5": add_step(AFTER, OFF), "lerobot N1.7": add_step(AFTER, OFF)},
    ),
)


def outcome(release: str, change: Change | str, options: Json) -> str:
    """Whether a robot of the folder can be used: `computed`, or why it is refused."""
    source = DATA / (change if isinstance(change, str) else FOLDERS[release])
    with tempfile.TemporaryDirectory() as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(temporary, "checkpoint")
        shutil.copytree(source, folder)
        case = json.loads((folder / "case.json").read_text())
        given = {"data_config": case.get("data_config"), **options}
        if not isinstance(change, str):
            if release == "N1, N1.5":
                config_of(lambda values: None)(folder)
            change(folder)
            own = folder / "config-of-test.json"
            given["data_config"] = str(own) if own.is_file() else None
        elif given["data_config"] is not None and given["data_config"].endswith(".json"):
            given["data_config"] = str(folder / given["data_config"])
        try:
            use(saccade.Normalizer.from_pretrained(folder, case["embodiment"], **given))
        except saccade.SaccadeError as error:
            return f"refused: {reason(str(error), folder)}"
    return "computed"


def use(normalizer: saccade.Normalizer) -> None:
    """Converts a state and a chunk, which may show that a robot cannot be used."""
    rng = np.random.default_rng(0)
    state = rng.random((1, normalizer.state_history or 1, normalizer.state_width), np.float32)
    normalizer.state(state)
    chunk = np.full((1, normalizer.action_horizon or 16, normalizer.action_dim), 0.3, np.float32)
    normalizer.actions(chunk, state)


def reason(message: str, folder: Path) -> str:
    """The first problem that a message names, without the path."""
    text = message.replace(str(folder), "").lstrip("/")
    first = text.split("; ")[0]
    return first.replace("|", "/")[:160]


def table_of_situations() -> list[str]:
    """What is computed and what is refused, tried."""
    lines = ["| situation | " + " | ".join(FOLDERS) + " |", "|---" * (1 + len(FOLDERS)) + "|"]
    notes: list[str] = []
    for situation in SITUATIONS:
        cells = []
        for release in FOLDERS:
            change = situation.changes.get(release)
            if change is None:
                cells.append("-")
                continue
            found = outcome(release, change, situation.options)
            if found.startswith("refused: "):
                notes.append(f"{situation.text}, {release}: `{found.removeprefix('refused: ')}`")
                found = f"refused ({len(notes)})"
            cells.append(found)
        lines.append(f"| {situation.text} | " + " | ".join(cells) + " |")
    return [*lines, "", "What the refusals say:", "", *(f"{n}. {text}" for n, text in enumerate(notes, 1))]


def table_of_configs() -> list[str]:
    """The released data configs."""
    lines = ["| name | cameras | state | action |", "|---|---|---|---|"]
    for name, config in RELEASED.items():
        cells = [", ".join(config.keys("video")), _keys(config, "state"), _keys(config, "action")]
        lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    return lines


def _keys(config: DataConfig, kind: str) -> str:
    """Keys with what is done with them; a mode of all of them stands in front."""
    modes = config.state_modes if kind == "state" else config.action_modes
    names = getattr(config, f"{kind}_keys")
    ways = []
    for name in names:
        target = config.target_rotations.get(name)
        ways.append(modes.get(name, "unchanged") + ("" if target is None else f", to {target}"))
    shown = [name.partition(".")[2] for name in names]
    if len(set(ways)) == 1:
        return f"{ways[0]}: {', '.join(shown)}"
    return ", ".join(f"{name} ({way})" for name, way in zip(shown, ways, strict=True))


def table_of_tags() -> list[str]:
    """Tags and ids by release."""
    lines = ["| tag | N1, N1.5 | N1.6 | N1.7 | other names in N1.7 |", "|---|---|---|---|---|"]
    names: dict[str, list[str]] = {}
    for name, tag in N17_NAMES.items():
        names.setdefault(tag, []).append(name.upper())
    for tag in sorted({*N15_IDS, *N16_IDS, *N17_IDS}):
        ids = [str(table.get(tag, "-")) for table in (N15_IDS, N16_IDS, N17_IDS)]
        lines.append(f"| `{tag}` | " + " | ".join(ids) + f" | {', '.join(names.get(tag, [])) or '-'} |")
    return lines


TABLES = {"data configs": table_of_configs, "tags": table_of_tags, "situations": table_of_situations}


def page() -> str:
    """The page with its tables written anew."""
    text = PAGE.read_text(encoding="utf-8")
    for name, make in TABLES.items():
        begin = f"<!-- {name}: written by python -m benches.pages.robots -->\n"
        end = f"<!-- end of {name} -->"
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise SystemExit(f"{PAGE}: expected the marks of {name}")
        text = before + begin + "\n".join(make()) + "\n" + end + after
    return text


def main() -> int:
    """Writes the page, or checks it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="only say whether the page is up to date")
    args = parser.parse_args()
    text = page()
    if args.check:
        is_new = text == PAGE.read_text(encoding="utf-8")
        print(f"{PAGE.name}: {'up to date' if is_new else 'stale: run python -m benches.pages.robots'}")
        return int(not is_new)
    write_text(PAGE, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
