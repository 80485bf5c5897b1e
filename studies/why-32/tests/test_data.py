"""The packed files of the study: they unpack to what the commands had written, and give the same numbers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import reanalysis
import reanalysis_stages
import unpack

from saccade.errors import InputError
from saccade_lab.files import checkpoint_identity
from saccade_lab.study.cell import Cell
from saccade_lab.study.table import read_study, read_table
from why_32.__main__ import ALLOW_CHANGED, main
from why_32.report import require_commits
from why_32.results import confirmed, judged
from why_32.study import Answer

STUDY = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """The table; reading it compares its hash."""
    return read_study(STUDY, "answer")[0]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `unpack.py` writes."""
    out = tmp_path_factory.mktemp("unpacked")
    assert unpack.unpack(out) == ["n-0-seed-0", "n-32-seed-0", "n-4-seed-0"]
    return out


def test_the_report_is_what_its_command_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'report.md'}\n"
    assert (tmp_path / "report.md").read_text() == (STUDY / "report.md").read_text()
    figures = [{path.name for path in (folder / "figures").iterdir()} for folder in (tmp_path, STUDY)]
    assert figures[0] == figures[1]


def test_rows_of_uncommitted_changes_are_refused_unless_their_stage_is_disclosed(table: pd.DataFrame) -> None:
    require_commits(table, allow_changed=ALLOW_CHANGED)
    with pytest.raises(InputError, match="uncommitted changes: two-cameras; expected at most none"):
        require_commits(table, allow_changed=())


def test_a_table_without_the_whole_core_has_no_report(table: pd.DataFrame) -> None:
    """Nothing is judged before; nor are sentences written about what was not measured."""
    provenance = read_study(STUDY, "answer")[1]
    some = table[table["stage"].isin(("core", "scaled", "compute")) | table["stage"].isna()]
    with pytest.raises(InputError, match=r"35 policies of the core with all episodes, expected 36"):
        Answer.summarise(some[some["policy"] != "n-4-seed-3"], provenance)
    cut = some["arm"] == "future-unread"
    with pytest.raises(InputError, match=r"the table lacks n-4 future-unread, n-32 future-unread, measures"):
        Answer.summarise(some[~cut], provenance)


def test_the_second_analysis_finds_the_same(table: pd.DataFrame, capsys: pytest.CaptureFixture[str]) -> None:
    """The planned tests, computed by both; the other one also checks what the README says of the data."""
    reanalysis.main()
    printed = capsys.readouterr().out
    assert "BAD" not in printed
    wanted = printed.split("3. The registered tests")[1].splitlines()[1:4]
    found = confirmed(judged(table, ("stereo-reach", "two-goals"), range(75)))
    assert len(found) == len(wanted)
    for one, line in zip(found, wanted, strict=True):
        assert one.test is not None
        assert one.corrected is not None
        difference = one.test.difference
        words = line.replace("[", "").replace("]", "").replace(",", "").split()
        for name, value in (("mean", 100 * difference.value), ("%", 100 * difference.low)):
            assert float(words[words.index(name) + 1]) == pytest.approx(value, abs=1e-3), line
        assert float(words[words.index("Holm") + 1]) == pytest.approx(one.corrected, abs=1e-6)


@pytest.mark.slow
def test_the_second_analysis_of_the_stages(capsys: pytest.CaptureFixture[str]) -> None:
    reanalysis_stages.main()
    bad = [line for line in capsys.readouterr().out.splitlines() if line.lstrip().startswith("BAD")]
    # Ten of twelve policies of aligned-again were not trained, which the results say.
    assert [line.split(":")[0].strip() for line in bad] == ["BAD 12 policies are there, but for"]


def test_cells_and_policies_unpack(unpacked: Path, table: pd.DataFrame) -> None:
    assert read_table(unpacked / "answer.csv").equals(table)
    paths = sorted((unpacked / "answer" / "cells").iterdir())
    assert len(paths) == 1623
    rows: list[dict[str, Any]] = []
    for path in paths:
        cell = json.loads(path.read_text())
        assert path.stem == Cell(tuple(cell["key"]), cell["settings"]).digest
        if cell["key"][0] == "episodes":
            rows += cell["rows"]
    episodes = table[table["kind"] == "episodes"]
    assert len(rows) == len(episodes)
    assert sum(row["control_steps"] for row in rows) == episodes["control_steps"].sum()
    trained = table[table["kind"] == "training"].set_index("policy")["checkpoint_sha256"]
    for policy in (unpacked / "answer" / "policies").iterdir():
        assert checkpoint_identity(policy)["sha256"] == trained[policy.name]


def test_hashes_of_all_that_was_trained_are_kept(table: pd.DataFrame) -> None:
    known = {record["directory"]: record for record in unpack.records(STUDY / "trained.jsonl.xz")}
    assert len(known) == 66
    trained = table[table["kind"] == "training"].set_index("policy")
    for directory, record in known.items():
        kind, name = directory.split("/")
        assert len(record["sha256"]["model.safetensors"]) == 64
        if kind == "policies":
            loss = record["files"]["history.json"][-1]["validation_loss"]
            assert loss == pytest.approx(trained.loc[name, "validation_loss"])


def test_weights_that_are_not_those_of_the_study_are_refused(tmp_path: Path) -> None:
    for name in ("trained.jsonl.xz", "policies"):
        (shutil.copytree if name == "policies" else shutil.copy)(STUDY / name, tmp_path / name)
    policies = tmp_path / "policies"
    shutil.copy(policies / "n-4-seed-0.safetensors.xz", policies / "n-0-seed-0.safetensors.xz")
    with pytest.raises(ValueError, match=r"n-0-seed-0/model\.safetensors: has the SHA-256 .*, expected"):
        unpack.write_policies(tmp_path, tmp_path / "out")


def test_intervals_of_the_second_analysis() -> None:
    """Turning signs of six differences: the interval is their range; of five there is none."""
    values = [1.0, 3.0, 2.0, 5.0, 4.0, 7.0]
    assert reanalysis_stages.exact_interval(values) == (1.0, 7.0)
    assert reanalysis_stages.exact_interval(values[:5]) is None
    assert float(reanalysis.sign_flip(values)) == 2 / 64
