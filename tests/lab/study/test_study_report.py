"""The report: made from tables alone, complete in one file, and clear about what it does not know."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from html import escape, unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from saccade._internal.files import sha256_of
from saccade.cli import main
from saccade.errors import InputError
from saccade_lab.study.questions import cuts
from saccade_lab.study.questions.cuts import ARMS
from saccade_lab.study.questions.patching_section import shares
from saccade_lab.study.report import write_report
from saccade_lab.study.section import Prose
from saccade_lab.study.study import STUDIES
from saccade_lab.study.table import (
    Provenance,
    read_provenance,
    read_table,
    write_provenance,
    write_table,
)

CHECKPOINT = {
    "name": "policy",
    "sha256": "ab" * 32,
    "num_future_tokens": 32,
    "num_layers": 2,
    "num_steps": 4,
    "num_vl_tokens": 57,
}


def write_study(
    out: Path, study: str, rows: list[dict[str, Any]], settings: Mapping[str, Any], **values: Any
) -> None:
    write_table(rows, out / f"{study}.csv")
    if "table_sha256" in values:
        values["table_sha256"] = sha256_of(out / f"{study}.csv")
    known = {"study": study, "settings": {"checkpoint": CHECKPOINT, **settings}, "done": 1, "total": 1}
    write_provenance(Provenance(**{**known, **values}), out / f"{study}.json")


def cut_row(task: str, seed: int, arm: str, success: bool, change: float) -> dict[str, Any]:
    return {
        "task": task,
        "seed": seed,
        "arm": arm,
        "success": success,
        "steps": 50,
        "chunks": 7,
        "num_observations": 7,
        "chunk_change": change,
        "chunk_change_max": 3 * change,
        "note": None,
    }


def write_cuts(out: Path, **values: Any) -> None:
    """Two tasks of ten episodes. Of the arms, one loses half of them, one nothing, one cannot be measured."""
    rows: list[dict[str, Any]] = []
    for task in ("push", "reach"):
        for seed in range(10):
            rows.append(cut_row(task, seed, "none", True, 0.0))
            rows.append(cut_row(task, seed, "future-unread", seed % 2 == 0, 0.1 + 0.01 * seed))
            rows.append(cut_row(task, seed, "future-shuffled", True, 1e-7))
            rows.append(cut_row(task, seed, "future-blind", True, 0.02))
            rows.append(
                {
                    "task": task,
                    "seed": seed,
                    "arm": "rows-blind",
                    "note": "the checkpoint has no future tokens",
                }
            )
    write_study(out, "cuts", rows, {"engine": "rust"}, **values)


def write_patching(out: Path, control: float = 1.0) -> None:
    """Future rows go a fifth of the way, state rows nowhere, all rows together to the end."""
    rows: list[dict[str, Any]] = []
    shares = {"future": 0.2, "state": 0.0, "action": 0.9, "all rows": control}
    for seed in range(8):
        way = 1.0 + seed
        for group, share in shares.items():
            for block in ("all", "0", "1"):
                rows.append(
                    {
                        "kind": "layout",
                        "task": "push",
                        "seed": seed,
                        "donor_task": "push",
                        "donor_seed": seed + 8,
                        "group": group,
                        "block": block,
                        "toward": share * way + (0.01 * (-1) ** seed if group == "state" else 0.0),
                        "squared_change": (share**2 + 0.01) * way,
                        "squared_way": way,
                        "note": None,
                    }
                )
        rows.append(
            {"kind": "words", "task": "push", "seed": seed, "note": "the policy knows no task for it"}
        )
    write_study(out, "patching", rows, {"blocks": [0, 1], "steps": [0, 1, 2, 3]})


class Addresses(HTMLParser):
    """All that a page refers to, and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "data", "srcset")]

    def handle_data(self, data: str) -> None:
        self.text += data


def parse(page: Path) -> Addresses:
    parser = Addresses()
    parser.feed(page.read_text(encoding="utf-8"))
    return parser


def test_report_is_one_file_and_says_what_the_numbers_allow(tmp_path: Path) -> None:
    write_cuts(tmp_path)
    write_patching(tmp_path)
    page, markdown = write_report(tmp_path)
    parsed = parse(page)
    outside = [one for one in parsed.found if not one.startswith(("data:", "#"))]
    assert outside == []
    assert "http" not in re.sub(r"data:[^\"]*", "", page.read_text(encoding="utf-8"))

    # 20 against 10 of 20: 0 won, 10 lost. Newcombe's and Tango's limits both lie near -0.70 and -0.28.
    label = ARMS["future-unread"].label
    assert f"{label}: success: worse, -50.0 points (-70.1 to -25.8)" in parsed.text
    assert "10/20" in parsed.text
    assert "10 / 0" in parsed.text
    assert "0.002" in parsed.text  # McNemar, two-sided: 2 / 2**10
    # Equal results in 20 pairs do not exclude a difference of 16 points, so equality is not claimed.
    label = ARMS["future-blind"].label
    assert f"{label}: success: undecided, 0.0 points (-16.1 to 16.1)" in parsed.text
    assert "future tokens shuffled: the chunk changed by at most 3e-07, as expected." in parsed.text
    assert f"{ARMS['rows-blind'].label}: not measured, the checkpoint has no future tokens." in parsed.text
    # The change of the chunk: mean of 0.10 ... 0.19 by hand.
    assert "0.1450 (" in parsed.text
    assert "actions change by 0.020 (0.020 to 0.020) on average" in parsed.text

    assert "future rows in all blocks: the chunk moves 20.0 %" in parsed.text
    assert "state rows in all blocks: no effect was found" in parsed.text
    assert "Control, all rows in all blocks: a share of 1.0000, as expected." in parsed.text
    assert "words: not measured, the policy knows no task for it (8 receivers: push)." in parsed.text
    assert "Donors of kind words (0 pairs)" in parsed.text
    assert "Donors of kind layout (8 pairs, mean distance between the chunks 2.04)" in parsed.text
    for name in set(STUDIES) - {"cuts", "patching"}:
        assert f"{STUDIES[name][1][1:]} (not measured)" in parsed.text

    text = markdown.read_text(encoding="utf-8")
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert len(pictures) == sum(one.startswith("data:image/svg") for one in parsed.found) == 5
    for picture in pictures:
        with Image.open(tmp_path / picture) as image:
            assert np.asarray(image.convert("L")).std() > 5  # something is drawn
    for line in (line for line in text.splitlines() if line.startswith("|")):
        assert line.count("|") - 2 * line.count("\\|") in (len(line.split(" | ")) + 1,)


def test_page_and_markdown_are_the_same_text(tmp_path: Path) -> None:
    write_cuts(tmp_path)
    write_patching(tmp_path)
    page, markdown = write_report(tmp_path)
    html, text = page.read_text(encoding="utf-8"), markdown.read_text(encoding="utf-8")
    linked = re.findall(r"^- \[.*\]\(#(.*?)\)", text, re.MULTILINE)
    assert len(linked) == len(STUDIES)
    assert linked == re.findall(r'<h2 id="(.*?)"', html) == re.findall(r'href="#(.*?)"', html)
    rows = [line for line in text.splitlines() if line.startswith("| ") and "| --- |" not in line]
    cells = [cell.replace("\\|", "|").strip() for row in rows for cell in re.split(r"(?<!\\)\|", row)[1:-1]]
    shown = [unescape(cell) for cell in re.findall(r"<t[dh]>(.*?)</t[dh]>", html)]
    assert shown == cells
    for line in text.splitlines():
        if line.startswith("- ") and "](#" not in line:
            assert f"<li>{escape(line[2:], quote=False)}</li>" in html


def test_an_interval_that_just_excludes_zero_is_no_finding_among_many_arms(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = []
    for seed in range(75):
        rows.append(cut_row("push", seed, "none", True, 0.0))
        rows.append(cut_row("push", seed, "future-blind", seed >= 6, 0.1))
        rows += [cut_row("push", seed, arm, True, 0.1) for arm in ("future-alone", "future-zeroed")]
    write_study(tmp_path, "cuts", rows, {"engine": "rust"})
    section = cuts.Cuts.summarise(read_table(tmp_path / "cuts.csv"), read_provenance(tmp_path / "cuts.json"))
    line = next(line for line in section.concluded if line.startswith(ARMS["future-blind"].label))
    # McNemar: 2 / 2**6 = 0.031; of three arms, 0.094.
    assert "success: worse, -8.0 points" in line
    assert ", not significant after Holm's correction (p = 0.094);" in line


def test_report_is_made_from_the_tables_alone_and_always_alike(tmp_path: Path) -> None:
    write_cuts(tmp_path)
    files = ["report.html", "report.md", "figures/cuts-success.png", "figures/cuts-difference.png"]
    write_report(tmp_path)
    first = [(tmp_path / name).read_bytes() for name in files]
    for name in files:
        (tmp_path / name).unlink()
    write_report(tmp_path)
    assert [(tmp_path / name).read_bytes() for name in files] == first


@pytest.mark.parametrize("version", ["0.1.0+g0123456789ab", "0.1.0+g0123456789ab.changed"])
def test_a_table_of_uncommitted_changes_is_marked(tmp_path: Path, version: str) -> None:
    write_cuts(tmp_path, packages={"saccade": f"0.1.0 and {version}"})
    marked = "Measured with uncommitted changes" in parse(write_report(tmp_path)[0]).text
    assert marked == version.endswith(".changed")


def test_a_failed_control_is_said(tmp_path: Path) -> None:
    write_patching(tmp_path, control=0.9)
    page, _ = write_report(tmp_path)
    assert "a share of 0.9000, WHICH SHOULD BE 1: do not trust the other rows." in parse(page).text
    rows = [cut_row("push", 0, "none", True, 0.0), cut_row("push", 0, "future-shuffled", True, 0.2)]
    write_study(tmp_path, "cuts", rows, {"engine": "rust"})
    page, _ = write_report(tmp_path)
    assert "MORE THAN ROUNDING: do not trust the other arms" in parse(page).text


def test_half_finished_and_empty_studies_say_so(tmp_path: Path) -> None:
    failed = [{"key": ["reach", 3, "none"], "error": "ValueError: no picture"}]
    write_cuts(tmp_path, done=100, total=120, failed=failed)
    write_study(tmp_path, "patching", [], {"blocks": [0], "steps": [0]}, done=0, total=40)
    text = parse(write_report(tmp_path)[0]).text
    assert "Unfinished: 100 of 120 cells are done" in text
    assert "1 cell failed in the last run. The first is reach 3 none: ValueError: no picture" in text
    assert "Unfinished: 0 of 40 cells are done" in text
    assert f"{STUDIES['patching'][1][1:]}\n\nUnfinished: 0 of 40 cells are done.\n\nNot measured." in text


def test_arms_without_a_partner_are_not_compared(tmp_path: Path) -> None:
    """A half-finished table in which an arm has episodes that the unchanged policy has not yet run."""
    rows = [cut_row("push", 0, "none", True, 0.0), cut_row("push", 1, "future-blind", False, 0.1)]
    write_study(tmp_path, "cuts", rows, {"engine": "rust"}, done=2, total=4)
    section = cuts.Cuts.summarise(read_table(tmp_path / "cuts.csv"), read_provenance(tmp_path / "cuts.json"))
    assert all("success" not in line for line in section.concluded)
    write_report(tmp_path)


def test_attention_sheets_are_put_in(tmp_path: Path) -> None:
    write_cuts(tmp_path)
    (tmp_path / "attention" / "push").mkdir(parents=True)
    Image.new("RGB", (8, 8), (200, 0, 0)).save(tmp_path / "attention" / "push" / "sheet.png")
    (tmp_path / "attention" / "push" / "page.html").write_text("<p>")
    page, markdown = write_report(tmp_path)
    data = base64.b64encode((tmp_path / "attention" / "push" / "sheet.png").read_bytes()).decode()
    assert f"data:image/png;base64,{data}" in parse(page).found
    assert "attention/push/page.html" in parse(page).text
    assert "(attention/push/sheet.png)" in markdown.read_text()


WITHOUT_A_SIMULATOR = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("mujoco", "metaworld", "gymnasium", "OpenGL", "imageio"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from saccade.cli import main
status = main(["study", "report", sys.argv[1]])
sys.exit(status)
"""


def test_the_report_of_every_study_needs_no_simulator(tmp_path: Path) -> None:
    committed = Path(__file__).parents[3] / "studies"
    for name in STUDIES:
        for folder in (committed / "first", committed / "fast"):
            for file in folder.glob(f"{name}.*"):
                shutil.copy(file, tmp_path / file.name)
    command = [sys.executable, "-c", WITHOUT_A_SIMULATOR, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "report.md").read_text(encoding="utf-8").count("(not measured)") == 2  # tvl, vlsa


BARE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[2].split(","):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import importlib.util
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: (
    None if name in sys.argv[2].split(",") else find_spec(name, package)
)
from saccade.cli import main
sys.exit(main(["study", "report", sys.argv[1]]))
"""


def test_without_packages_the_report_asks_for_the_extra_that_it_needs(tmp_path: Path) -> None:
    write_cuts(tmp_path)
    missing = "jinja2,markdown_it,matplotlib,pandas,scipy,joblib,torch,mujoco,gymnasium,metaworld,rich"
    command = [sys.executable, "-c", BARE, str(tmp_path), missing]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert "[study]" in done.stderr
    assert done.stderr.count("\n") == 1
    for name in ("mujoco", "torch", "rich"):
        assert name not in done.stderr


def test_names_are_escaped(tmp_path: Path) -> None:
    write_study(
        tmp_path, "cuts", [cut_row("<script>alert(1)</script>", 0, "none", True, 0.0)], {"engine": "rust"}
    )
    page, _ = write_report(tmp_path)
    assert "<script" not in page.read_text(encoding="utf-8")


def test_shares_pool_pairs_and_keep_what_cannot_be_told() -> None:
    import pandas as pd

    rows = pd.DataFrame(
        {
            "task": ["push"] * 4,
            "seed": range(4),
            "toward": [0.5, 1.0, 1.5, 2.0],
            "squared_way": [1.0, 2.0, 3.0, 4.0],
            "squared_change": [0.25, 0.5, 0.75, 1.0],
        }
    )
    share, size = shares(rows)
    assert (share.value, share.low, share.high, size) == (0.5, 0.5, 0.5, 0.5)
    share, size = shares(rows.assign(squared_way=0.0))
    assert np.isnan([share.value, size]).all()
    following = Prose("patching").line("following", share)
    assert following == "donors and receivers have the same chunks, so there is nothing to follow"


def test_bad_directories_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(path: Path) -> str:
        assert main(["study", "report", str(path)]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    assert "no such directory" in refused(tmp_path / "nowhere")
    assert "contains no study; expected a table such as cuts.csv" in refused(tmp_path)
    write_study(tmp_path, "cuts", [{"task": "push", "seed": 1}], {"engine": "rust"})
    assert "cuts.csv: not written by this study: 'arm' is missing" in refused(tmp_path)
    write_cuts(tmp_path, table_sha256=None)
    assert main(["study", "report", str(tmp_path)]) == 0
    capsys.readouterr()
    with (tmp_path / "cuts.csv").open("rb+") as file:
        file.truncate(600)
    assert "cuts.csv: not as its study wrote it" in refused(tmp_path)
    rows = [
        cut_row("push", 0, "none", True, 0.0),
        {**cut_row("push", 1, "none", True, 0.0), "success": "Fals"},
    ]
    write_study(tmp_path, "cuts", rows, {"engine": "rust"})
    assert "cuts.csv: success: expected True or False in every row, got 'Fals'" in refused(tmp_path)
    rows = [cut_row("push", 0, "none", True, 0.0), cut_row("push", 0, "future-blind", True, 0.0)]
    rows[1]["chunk_change"] = "abc"
    write_study(tmp_path, "cuts", rows, {"engine": "rust"})
    assert "cuts.csv: not written by this study: could not convert" in refused(tmp_path)
    (tmp_path / "cuts.csv").unlink()
    assert "cuts.csv" in refused(tmp_path)
    (tmp_path / "cuts.json").write_text("{}")
    with pytest.raises(InputError, match="not written by a study"):
        write_report(tmp_path)


def test_report_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cuts(tmp_path)
    assert main(["study", "report", str(tmp_path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"html": str(tmp_path / "report.html"), "markdown": str(tmp_path / "report.md")}
    assert main(["study", "report", str(tmp_path)]) == 0
    assert str(tmp_path / "report.html") in capsys.readouterr().out
