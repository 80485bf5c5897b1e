"""Sources of studies, arms and metrics of one's own, and machines that cannot draw."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from saccade.checkpoints import resize
from saccade.cli import main
from saccade.errors import InputError
from saccade.head.intervention import Intervention
from saccade_lab.reference import ActionHead
from saccade_lab.study.arms import METRICS, Arm, Metric
from saccade_lab.study.cell import Cell
from saccade_lab.study.questions.cuts import ARMS, Cuts
from saccade_lab.study.questions.resized import arms_of, merge
from saccade_lab.study.recording import Recording
from saccade_lab.study.run import run
from saccade_lab.study.study import STUDIES, Study, load_study
from saccade_lab.study.table import read_provenance
from tests.lab.sim.test_sim_rollout_opengl import run_without_opengl
from tests.lab.study.test_study_features import reference_chunk, study, write_case

EXAMPLE = Path(__file__).parents[3] / "examples" / "own_study.py"
BARE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("mujoco", "metaworld", "gymnasium", "OpenGL", "imageio"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from saccade.cli import main
sys.exit(main(sys.argv[1:]))
"""


def first_action(before: np.ndarray, after: np.ndarray) -> float:
    return float(np.abs(after - before)[:, :, 0].mean())


def doubled(factor: float) -> Arm:
    return Arm(
        "future-doubled",
        intervention=lambda tokens, rng: Intervention(future_tokens=factor * tokens),
        settings={"factor": factor},
    )


def test_an_arm_and_a_metric_of_ones_own(tmp_path: Path) -> None:
    """Against the torch reference with its tokens doubled by hand."""
    checkpoint, file = write_case(tmp_path, without=())
    source = Recording(str(checkpoint), str(file))
    metrics = (*METRICS, Metric("first_action", first_action))
    table = run(Cuts(source, (doubled(2.0),), metrics), tmp_path / "out")
    assert set(table["arm"]) == {"none", "future-doubled"}
    arrays = np.load(file)
    whole = ActionHead.from_pretrained(checkpoint, dtype=torch.float64)
    other = ActionHead.from_pretrained(checkpoint, dtype=torch.float64)
    other.future_tokens.weight.data *= 2
    by_arm = table.set_index(["arm", "seed"])
    for row in range(5):
        noise = arrays["noise"][row : row + 1]
        change = np.abs(
            reference_chunk(other, arrays, row, noise) - reference_chunk(whole, arrays, row, noise)
        )
        found: Any = by_arm.loc[("future-doubled", row)]
        assert found["chunk_change"] == pytest.approx(change.mean(), rel=1e-3)
        assert found["first_action"] == pytest.approx(change[0].mean(), rel=1e-3)
    provenance = read_provenance(tmp_path / "out" / "cuts.json")
    assert provenance.settings["metrics"] == ["first_action"]
    section = Cuts.summarise(table, provenance)
    assert any("future-doubled: actions change by" in line for line in section.concluded)


def test_the_example_runs_on_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint, file = write_case(tmp_path)
    given = ["--checkpoint", str(checkpoint), "--features", str(file), "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["own_study.py", *given])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    printed = capsys.readouterr().out
    assert "without-longest: actions change by" in printed
    assert "The first action moves by" in printed
    assert main(["study", "report", str(tmp_path / "out")]) == 0
    assert "without-longest" in (tmp_path / "out" / "report.md").read_text()


def test_a_changed_arm_is_measured_again(tmp_path: Path) -> None:
    checkpoint, file = write_case(tmp_path, without=())
    source = Recording(str(checkpoint), str(file))
    done: list[str] = []

    def measured(factor: float) -> pd.DataFrame:
        done.clear()
        return run(
            Cuts(source, (doubled(factor),)),
            tmp_path / "out",
            on_done=lambda finished, *_: done.append(finished.cell.name),
        )

    once = measured(2.0)
    assert len(done) == 10
    measured(2.0)
    assert done == []
    other = measured(3.0)
    assert done == [f"{Recording.task} {row} future-doubled" for row in range(5)]
    assert not np.allclose(once["chunk_change"], other["chunk_change"])


def test_two_arms_of_one_name_are_refused(tmp_path: Path) -> None:
    source = Recording("checkpoint", "looks.npz")
    with pytest.raises(InputError, match="arms: given same, same, expected distinct names"):
        Cuts(source, (Arm("same"), Arm("same")))


def test_every_study_of_the_table_is_one() -> None:
    for name in STUDIES:
        study = load_study(name)
        assert issubclass(study, Study)
        assert study.name == name


def test_what_is_no_study_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STUDIES, "cell", ("saccade_lab.study.cell:Cell", "no study"))
    with pytest.raises(TypeError, match=r"saccade_lab\.study\.cell\.Cell: expected a subclass of Study"):
        load_study("cell")
    assert Cell(("a",)).name == "a"


def test_merging_is_that_of_resize(tmp_path: Path) -> None:
    """The tokens of the arms are those that `saccade resize` writes into a checkpoint."""
    checkpoint, file = write_case(tmp_path)
    tokens = Recording(str(checkpoint), str(file)).future_tokens
    for size in (1, 2, 3):
        out = tmp_path / f"resized-{size}"
        resize(checkpoint, out, num_future_tokens=size)
        written = Recording(str(out), str(file))
        found = merge(tokens, size)
        np.testing.assert_array_equal(np.asarray(found.future_tokens), written.future_tokens)
        bias = written.config.future_key_bias
        assert found.key_bias is not None
        (given,) = found.key_bias.values()
        np.testing.assert_allclose(np.asarray(given), 0.0 if bias is None else bias, rtol=1e-6)
    assert [arm.settings for arm in arms_of((2,)) if arm.name == "2 merged"] == [{"rule": "resize"}]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drop_vl": np.ones((5, 6), bool)}, "drop_vl: row 0 drops every position"),
        ({"attention_mask": np.zeros((5, 6), bool)}, "attention_mask: false entries"),
    ],
)
def test_resize_refuses_the_observations_that_study_refuses(
    changes: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint, file = write_case(tmp_path, **changes)
    arguments = ["--num-future-tokens", "2", "--features", str(file), "--out", str(tmp_path / "resized")]
    assert main(["resize", str(checkpoint), *arguments]) == 2
    by_resize = capsys.readouterr().err
    assert study("cuts", checkpoint, file, tmp_path / "out") == 2
    by_study = capsys.readouterr().err
    assert message in by_resize
    assert by_resize == by_study


def test_an_arm_that_the_head_cannot_have_is_not_measured(tmp_path: Path) -> None:
    checkpoint, file = write_case(tmp_path, without=())
    arms = (
        Arm(
            "nowhere",  # block 1 is a self-attention block, which reads no vision-language tokens
            intervention=lambda tokens, rng: Intervention(cut=[("action", "vl")], blocks=[1]),
        ),
        Arm("late", intervention=lambda tokens, rng: Intervention(cut=[("action", "future")], blocks=[99])),
        ARMS["future-zeroed"],
    )
    table = run(Cuts(Recording(str(checkpoint), str(file)), arms), tmp_path / "out")
    assert table[table["arm"] == "late"]["note"].str.contains("blocks: expected 0 to 3, got 99").all()
    nowhere = table[table["arm"] == "nowhere"]["note"]
    assert nowhere.str.contains("cut: action reads vl in cross-attention blocks only").all()
    assert table[table["arm"].isin(["none", "future-zeroed"])]["note"].isna().all()
    section = Cuts.summarise(table, read_provenance(tmp_path / "out" / "cuts.json"))
    assert any(line.startswith("late: not measured, intervention: blocks") for line in section.concluded)


def test_cuts_in_the_simulator_are_one_line_without_opengl(tmp_path: Path) -> None:
    done = run_without_opengl(tmp_path, "-m", "saccade", "study", "cuts", "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert "OpenGL cannot draw" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_recording_needs_no_simulator(tmp_path: Path) -> None:
    checkpoint, file = write_case(tmp_path)
    given = ["--checkpoint", str(checkpoint), "--features", str(file), "--out", str(tmp_path / "out")]
    for name in ("cuts", "patching", "n-runtime"):
        done = run_without_opengl(tmp_path, "-c", BARE, "study", name, *given)
        assert done.returncode == 0, done.stderr
    done = run_without_opengl(tmp_path, "-c", BARE, "study", "report", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.md").is_file()
