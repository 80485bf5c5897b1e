"""Studies on a file of features: any checkpoint, no simulator, numbers against the torch reference."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade.cli import main
from saccade_lab.reference import ActionHead
from saccade_lab.reference.random_weights import random_inputs, write_checkpoint
from saccade_lab.study import changes as changes_of_recordings
from saccade_lab.study import derivatives
from saccade_lab.study.statistics import bootstrap_ratio
from saccade_lab.study.table import read_provenance, read_table
from tests.helpers.reference_cases import small_config
from tests.helpers.released import load_released

EPISODES = [7, 7, 3, 3, 7]
STUDIES = ("cuts", "patching", "gradients", "n-runtime")


def write_case(folder: Path, *, without: tuple[str, ...] = ("noise",), **changes: Any) -> tuple[Path, Path]:
    """A random head in the released layout, and five observations for it."""
    config = small_config(**{name: changes.pop(name) for name in ("num_future_tokens",) if name in changes})
    checkpoint = folder / "checkpoint"
    checkpoint.mkdir()
    write_checkpoint(checkpoint, config, seed=1)
    inputs = random_inputs(saccade.HeadConfig.from_dict(config), 2, batch=5, num_vl_tokens=6)
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in inputs.items()}
    arrays |= {"embodiment_id": np.array([0, 2, 2, 2, 0]), "episode": np.array(EPISODES)}
    for name, value in changes.items():
        arrays[name] = value(arrays) if callable(value) else value
    for name in without:
        del arrays[name]
    np.savez(folder / "looks.npz", **arrays)
    return checkpoint, folder / "looks.npz"


def study(name: str, checkpoint: Path, file: Path, out: Path, *more: str) -> int:
    return main(
        ["study", name, "--checkpoint", str(checkpoint), "--features", str(file), "--out", str(out), *more]
    )


def reference_chunk(head: ActionHead, arrays: Any, row: int, noise: np.ndarray, **options: Any) -> np.ndarray:
    """One chunk in float64."""
    dropped = None if "drop_vl" not in arrays else torch.from_numpy(arrays["drop_vl"][row : row + 1])
    with torch.no_grad():
        vl_embs = head.encode(arrays["backbone_features"][row : row + 1], drop_vl=dropped)
        actions = head.sample(
            vl_embs,
            arrays["state"][row : row + 1],
            int(arrays["embodiment_id"][row]),
            noise=noise,
            drop_vl=dropped,
            **options,
        )
    found: np.ndarray = actions[0].numpy()
    return found


def test_cuts_are_those_of_the_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dropped = np.zeros((5, 6), bool)
    dropped[1, :2] = True
    checkpoint, file = write_case(tmp_path, drop_vl=dropped)
    arms = "future-unread,future-shuffled,future-zeroed"
    assert study("cuts", checkpoint, file, tmp_path / "out", "--arms", arms, "--seed", "4") == 0
    printed = capsys.readouterr().out
    assert "Success: not measured, a file of features has no closed loop." in printed
    assert "Control, future tokens shuffled" in printed
    assert "as expected" in printed

    table = read_table(tmp_path / "out" / "cuts.csv")
    assert set(table["task"]) == {"features"}
    assert table["success"].isna().all()
    by_arm = table.set_index(["arm", "seed"])
    arrays = np.load(file)
    whole = ActionHead.from_pretrained(checkpoint, dtype=torch.float64)
    without = ActionHead.from_pretrained(checkpoint, dtype=torch.float64)
    without.future_tokens.weight.data = without.future_tokens.weight.data[:0]  # N = 0 instead of a cut
    zeroed = ActionHead.from_pretrained(checkpoint, dtype=torch.float64)
    zeroed.future_tokens.weight.data.zero_()
    for row in range(5):
        noise = np.random.default_rng([4, row]).standard_normal((1, 4, 5, 3), dtype=np.float32)

        def draws(head: ActionHead, row: int = row, noise: np.ndarray = noise) -> np.ndarray:
            return np.stack([reference_chunk(head, arrays, row, noise[:, draw]) for draw in range(4)])

        chunks = draws(whole)
        for arm, head in (("future-unread", without), ("future-zeroed", zeroed)):
            expected = np.abs(draws(head) - chunks)
            found: Any = by_arm.loc[(arm, row)]
            assert found["chunk_change"] == pytest.approx(expected.mean(), rel=1e-3)
            assert found["chunk_change_max"] == pytest.approx(expected.max(), rel=1e-3)
        pairs = [np.abs(chunks[i] - chunks[j]).mean() for i in range(4) for j in range(i)]
        assert by_arm.loc[("none", row), "noise_change"] == pytest.approx(np.mean(pairs), rel=1e-3)
        assert by_arm.loc[("none", row), "chunk_change"] == 0.0

    # Intervals are drawn by episode: of five observations there are two.
    unread = changes_of_recordings.arm_changes(table, ["future-unread"])["future-unread"]
    values = table[table["arm"] == "future-unread"]["chunk_change"].to_numpy()
    assert unread.change == bootstrap_ratio(values, np.ones(5), EPISODES)
    assert "Only 2 independent observations or episodes" in printed

    provenance = read_provenance(tmp_path / "out" / "cuts.json")
    assert provenance.settings["features"]["episodes"] == 2
    assert len(provenance.settings["features"]["sha256"]) == 64
    assert str(tmp_path) not in (tmp_path / "out" / "cuts.json").read_text()
    # Another file is another study.
    np.savez(file, **{**arrays, "state": arrays["state"] + 1})
    assert study("cuts", checkpoint, file, tmp_path / "out", "--arms", arms, "--seed", "4") == 2
    assert "other settings" in capsys.readouterr().err


def test_released_weights_in_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The checkpoint is one .safetensors file with its config elsewhere, and brings its inputs and noise."""
    given = load_released("n15_tiny")
    (tmp_path / "c.json").write_text(json.dumps(given.config))
    arguments = ("--config", str(tmp_path / "c.json"), "--arms", "future-unread")
    assert study("cuts", given.path, given.path, tmp_path / "out", *arguments) == 0
    printed = capsys.readouterr().out
    assert "It is not known which episode" in printed
    assert "another noise" not in printed
    table = read_table(tmp_path / "out" / "cuts.csv").set_index(["arm", "seed"])
    without = ActionHead.from_pretrained(given.path, config=given.config, dtype=torch.float64)
    without.future_tokens.weight.data = without.future_tokens.weight.data[:0]
    for row in range(2):
        chunk = reference_chunk(without, vars(given), row, given.noise[row : row + 1])
        expected = np.abs(chunk - given.actions_f64[row]).mean()
        assert table.loc[("future-unread", row), "chunk_change"] == pytest.approx(expected, rel=1e-3)


def test_patching_pairs_and_numbers(tmp_path: Path) -> None:
    checkpoint, file = write_case(tmp_path, without=())
    assert study("patching", checkpoint, file, tmp_path / "out", "--blocks", "0,1") == 0
    table = read_table(tmp_path / "out" / "patching.csv")
    # The next one, going round, of another episode with the same embodiment; 0 and 4 are of one episode.
    donors = table.groupby("seed")["donor_seed"].first()
    assert donors[[1, 2, 3]].tolist() == [2, 1, 1]
    assert table[table["seed"].isin([0, 4])]["note"].str.startswith("there is no donor").all()
    # Everything the donor's run had after every step's last patched block, by the reference.
    arrays, head = np.load(file), ActionHead.from_pretrained(checkpoint, dtype=torch.float64)
    noise = arrays["noise"][1:2]
    after, before = (reference_chunk(head, arrays, row, noise) for row in (2, 1))
    row = table[(table["seed"] == 1) & (table["group"] == "future") & (table["block"] == "all")].iloc[0]
    assert row["squared_way"] == pytest.approx(((after - before) ** 2).sum(), rel=1e-3)
    with torch.no_grad():
        vl_embs = head.encode(torch.from_numpy(arrays["backbone_features"]))
        state = torch.from_numpy(arrays["state"])
        trace = head.trace(vl_embs[2:3], state[2:3], 2, noise=torch.from_numpy(noise), record=("hidden",))
    rows = trace.rows["future"]
    patch: dict[tuple[int, int], dict[Any, np.ndarray]] = {
        (step, block): {"future": trace.hidden[step, block][0, rows].numpy().astype(np.float32)}
        for step in range(3)
        for block in (0, 1)
    }
    change = reference_chunk(head, arrays, 1, noise, intervention=saccade.Intervention(patch=patch)) - before
    assert row["toward"] == pytest.approx((change * (after - before)).sum(), rel=1e-3)


def test_patching_everything_gives_the_donors_chunk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint, file = write_case(tmp_path, embodiment_id=np.array(1))
    assert study("patching", checkpoint, file, tmp_path / "out") == 0
    assert "Control, all rows in all blocks: a share of 1.0000, as expected." in capsys.readouterr().out


def test_gradients_are_those_of_all_projections_at_once(tmp_path: Path) -> None:
    checkpoint, file = write_case(tmp_path, without=())
    assert study("gradients", checkpoint, file, tmp_path / "out", "--projections", "3") == 0
    table = read_table(tmp_path / "out" / "gradients.csv")
    head, arrays = ActionHead.from_pretrained(checkpoint), np.load(file)
    seed = int(np.random.default_rng((0, 1)).integers(2**31))
    cotangents = torch.randn((3, 5, 3), generator=torch.Generator().manual_seed(seed))
    vl_embs = head.encode(arrays["backbone_features"][1:2]).detach()
    state, noise = (torch.from_numpy(arrays[name][1:2]) for name in ("state", "noise"))
    leaf = vl_embs.repeat(3, 1, 1).requires_grad_()
    whole, direct = (
        torch.autograd.grad(
            (
                head.sample(
                    leaf,
                    state.expand(3, -1, -1),
                    2,
                    noise=noise.expand(3, -1, -1),
                    stop_gradient=stopped,
                )
                * cotangents
            ).sum(),
            leaf,
        )[0]
        for stopped in ((), derivatives.LEAVING_FUTURE)
    )
    row = table[(table["seed"] == 1) & (table["path"] == "direct") & table["share"].notna()].iloc[0]
    assert row["share"] == pytest.approx(float((direct * whole).sum() / (whole * whole).sum()), rel=1e-3)
    assert row["length"] == pytest.approx(float(direct.norm() / whole.norm()), rel=1e-3)
    shares = table[(table["seed"] == 1) & table["share"].notna()]["share"]
    assert shares.sum() == pytest.approx(1.0, abs=1e-4)
    pairs = derivatives.action_sensitivity(head, vl_embs, state, noise, cotangents, embodiment_id=2)
    future = table[(table["seed"] == 1) & (table["group"] == "future") & (table["block"] == 2)].iloc[0]
    assert future["norm"] == pytest.approx(float(pairs[3][0][1:5].square().mean().sqrt()), rel=1e-3)
    assert future["relative"] == pytest.approx(float(pairs[3][1][1:5].square().mean().sqrt()), rel=1e-3)


def test_n_at_run_time_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, file = write_case(tmp_path, without=("noise", "episode"))
    out = tmp_path / "out"
    assert study("n-runtime", checkpoint, file, out) == 0
    printed = capsys.readouterr().out
    assert "Control, every token twice, equal mass" in printed
    table = read_table(out / "n-runtime.csv")
    assert set(table["arm"]) == {
        "as learned",
        *(f"{size} {how}" for size in (1, 2) for how in ("drawn", "drawn, equal mass", "merged")),
        "every token twice",
        "every token twice, equal mass",
    }
    assert table[table["arm"] == "every token twice"]["chunk_change"].min() > 1e-4
    assert study("cuts", checkpoint, file, out, "--arms", "future-averaged") == 0
    assert main(["study", "report", str(out)]) == 0
    report = (out / "report.md").read_text()
    headings = [line for line in report.splitlines() if line.startswith("## ")]
    assert sum("on recorded observations" in heading for heading in headings) == 2
    assert "success, %" not in report
    assert "times as much as with another noise" in report


@pytest.mark.parametrize("name", STUDIES)
def test_a_head_without_future_tokens(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, file = write_case(tmp_path, num_future_tokens=0)
    more = ("--projections", "2") if name == "gradients" else ()
    assert study(name, checkpoint, file, tmp_path / "out", *more) == 0
    assert "not measured, the checkpoint has no future tokens" in capsys.readouterr().out.lower()
    assert main(["study", "report", str(tmp_path / "out")]) == 0


def test_every_arm_that_needs_no_future_tokens_is_measured_without_them(tmp_path: Path) -> None:
    checkpoint, file = write_case(tmp_path, num_future_tokens=0)
    assert study("cuts", checkpoint, file, tmp_path / "out") == 0
    assert study("patching", checkpoint, file, tmp_path / "out") == 0
    table = read_table(tmp_path / "out" / "cuts.csv")
    measured = table[table["note"].isna()]
    assert set(measured["arm"]) == {"none", "action-blind", "all-blind"}
    head, arrays = saccade.ActionHead.from_pretrained(checkpoint), np.load(file)
    state, embodiment = arrays["state"], arrays["embodiment_id"]
    noise = np.stack(
        [np.random.default_rng([0, row]).standard_normal((4, 5, 3), dtype=np.float32) for row in range(5)]
    )
    seen = np.asarray(head(arrays["backbone_features"], state, embodiment, noise=noise, num_samples=4))
    other = head(-arrays["backbone_features"], state, embodiment, noise=noise, num_samples=4)
    cut = saccade.Intervention(cut=[("state", "vl"), ("action", "vl")])
    context = head.encode(-arrays["backbone_features"])
    unseen = head.sample(context, state, embodiment, noise=noise, num_samples=4, intervention=cut)
    assert np.abs(np.asarray(other) - seen).max() > 1e-3  # the features matter, unless they are cut
    change = np.abs(np.asarray(unseen) - seen).mean(axis=(1, 2, 3))
    found = measured[measured["arm"] == "all-blind"].sort_values("seed")["chunk_change"]
    np.testing.assert_allclose(found, change, rtol=1e-5)


def spoiled(name: str, value: float) -> Callable[[dict[str, Any]], np.ndarray]:
    def change(arrays: dict[str, Any]) -> np.ndarray:
        array: np.ndarray = arrays[name].copy()
        array[1].flat[0] = value
        return array

    return change


FILES: list[tuple[dict[str, Any], tuple[str, ...], str]] = [
    ({"backbone_features": np.zeros((5, 6, 9), np.float32)}, (), "expects (batch, T_vl, 10)"),
    ({"backbone_features": spoiled("backbone_features", np.nan)}, (), "NaN or infinity in row 1"),
    ({"state": spoiled("state", np.inf)}, (), "state: NaN or infinity in row 1"),
    ({"state": np.zeros((4, 6), np.float32)}, (), "state: shape (4, 6), expected (5, 6)"),
    ({"embodiment_id": np.full(5, 3)}, (), "embodiment_id: given 3 to 3, the checkpoint has 0 to 2"),
    ({"episode": np.zeros(4, int)}, (), "episode: int64 of shape (4,), expected integers, (5,)"),
    ({"episode": np.zeros(5)}, (), "episode: float64"),
    ({"attention_mask": np.tri(5, 6, dtype=bool)}, (), "expected no attention_mask, or drop_vl"),
    ({"drop_vl": np.ones((5, 6), bool)}, (), "drop_vl: row 0 drops every position"),
    ({"drop_vl": np.ones((5, 7), bool)}, (), "drop_vl: shape (5, 7), expected (5, 6)"),
    ({"noise": np.zeros((5, 5, 4), np.float32)}, (), "noise: shape (5, 5, 4), expected (5, 5, 3)"),
    ({}, ("state", "noise"), "no state; there are"),
]


@pytest.mark.parametrize(("changes", "without", "message"), FILES)
def test_files_that_do_not_fit(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, Any],
    without: tuple[str, ...],
    message: str,
) -> None:
    checkpoint, file = write_case(tmp_path, without=without, **changes)
    assert study("cuts", checkpoint, file, tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert message in error
    assert str(file) in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_arguments_that_mean_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, file = write_case(tmp_path)
    for name, arguments, message in (
        ("cuts", ("--tasks", "push", "--episodes", "3"), "--tasks, --episodes: not with --features"),
        ("cuts", ("--engine", "torch"), "--engine: not with --features"),
        ("patching", ("--kinds", "layout"), "--kinds: not with --features"),
        (
            "gradients",
            ("--num-observations", "3", "--demos", "x"),
            "--num-observations, --demos: not with --features",
        ),
        ("n-runtime", ("--seed", "-1"), "--seed: given -1"),
        ("n-runtime", ("--num-future-tokens", "4"), "expected 1 to 3"),
        ("patching", ("--blocks", "4"), "expected 0 to 3"),
        ("probes", (), "this study needs the simulator"),
    ):
        assert study(name, checkpoint, file, tmp_path / "out", *arguments) == 2
        assert message in capsys.readouterr().err
    assert study("cuts", checkpoint, tmp_path / "none.npz", tmp_path / "out") == 2
    assert "none.npz: no such file" in capsys.readouterr().err
    assert study("cuts", tmp_path / "nothing", file, tmp_path / "out") == 2
    assert "nothing" in capsys.readouterr().err
    assert main(["study", "cuts", "--config", str(file), "--out", str(tmp_path / "out")]) == 2
    assert "--config: only with --features" in capsys.readouterr().err
