"""Pages are written from measurements of committed trees only."""

from __future__ import annotations

import errno
import json
import re
from pathlib import Path
from typing import Any

import pytest

from benches import unchanged_views
from benches.backbone import report as backbone
from benches.files import write_record
from benches.pages.report import UncommittedError, report, require_commit
from benches.peers import __main__ as peers
from benches.peers.results import RECORDS, Results
from benches.records import COMMANDS, RESULTS

ROOT = Path(__file__).resolve().parents[2]
DIRTY = {"demo": {"machine": {"commit": "0123abc"}}, "full": [{"machine": {"commit": "4567def-dirty"}}]}


def test_a_record_of_a_tree_with_uncommitted_changes_is_refused(tmp_path: Path) -> None:
    measured, kept, page = tmp_path / "measured.json", tmp_path / "kept.json", tmp_path / "page.md"

    def written(results: Any, write: bool) -> int:
        measured.write_text(json.dumps(results))
        return report(measured, kept, page, str, program="benches.x", write=write)

    assert written(DIRTY, False) == 0  # may be printed
    with pytest.raises(UncommittedError, match="4567def-dirty, with uncommitted changes"):
        written(DIRTY, True)
    assert not page.exists()
    assert not kept.exists()
    assert written({"demo": DIRTY["demo"]}, True) == 0
    assert page.exists()


def test_what_is_measured_is_written_whole_and_as_the_committed_records_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in (RECORDS / "zen-5.json", RESULTS / "parity.json", backbone.RECORDS / "zen-4.json"):
        committed, copy = path.read_bytes(), tmp_path / path.name
        write_record(copy, json.loads(committed))
        assert copy.read_bytes() == committed
        with monkeypatch.context() as patch:
            patch.setattr(Path, "write_text", half_of_it)
            with pytest.raises(OSError, match=re.escape(str(copy))):
                write_record(copy, {"machine": {}})
        assert copy.read_bytes() == committed
    assert len(list(tmp_path.iterdir())) == 3


def half_of_it(path: Path, text: str, encoding: str) -> None:
    """Writes as on a disk that becomes full."""
    path.write_bytes(text.encode(encoding)[: len(text) // 2])
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("version", [{"commit": "4567def-dirty"}, {"saccade": "0.1.0+g4567def.changed"}])
def test_both_ways_to_name_a_changed_tree_are_known(version: dict[str, str]) -> None:
    with pytest.raises(UncommittedError, match="4567def"):
        require_commit({"runs": [{"machine": version}]}, Path("record.json"))


def test_peers_write_no_page_of_such_a_record(tmp_path: Path) -> None:
    data = json.loads((RECORDS / "zen-5.json").read_text())
    data["machine"]["commit"] += "-dirty"
    (tmp_path / "n1.5").mkdir()
    for folder in (tmp_path, tmp_path / "n1.5"):
        (folder / "zen-5.json").write_text(json.dumps(data))
    for more in ([], ["--only", "policy"]):
        with pytest.raises(UncommittedError):
            peers.main(["report", "--write", "--record", str(tmp_path), *more])
    with pytest.raises(UncommittedError):
        peers.keep(Results(tmp_path / "zen-5.json"), tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize("path", sorted((ROOT / "benches").rglob("*.json")), ids=lambda path: path.name)
def test_committed_records_are_of_committed_trees(path: Path) -> None:
    require_commit(json.loads(path.read_text()), path)


def test_the_records_of_guides_are_those_that_their_commands_write() -> None:
    # Written by programs of benches, and compared in their tests.
    rates = RESULTS.glob("libero-*rates.json")
    programs = {unchanged_views.RECORD, RESULTS / "libero.json", *rates}
    assert {path.stem for path in RESULTS.iterdir() if path not in programs} == set(COMMANDS)
    for name, command in COMMANDS.items():
        assert json.loads((RESULTS / f"{name}.json").read_text())["command"] == f"saccade {command} --json"


def test_the_table_of_simulated_episodes_has_the_numbers_of_its_records() -> None:
    page = (ROOT / "docs" / "simulation.md").read_text()
    engines = [
        json.loads((RESULTS / f"simulation-{engine}.json").read_text())["printed"]["summary"]
        for engine in ("rust", "torch")
    ]
    for rust, torch in zip(*engines, strict=True):
        counts = [f"{each['successes']}/{each['episodes']}" for each in (rust, torch)]
        (row,) = (line for line in page.splitlines() if line.startswith(f"| {rust['task']} | {counts[0]}"))
        assert row.endswith(f" | {counts[1]} | {rust['median_steps']:.0f} |")
