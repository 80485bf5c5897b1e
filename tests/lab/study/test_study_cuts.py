"""The studies of cuts and of patching on the shipped policy, run in MuJoCo."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from saccade import Intervention
from saccade.checkpoints import read_tensors
from saccade.cli import main
from saccade_lab.reference import ActionHead
from saccade_lab.sim import graphics
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.study.questions import cuts
from saccade_lab.study.questions.cuts import ALL_ARMS, ARMS
from saccade_lab.study.questions.cuts_section import arm_results
from saccade_lab.study.questions.patching_section import GROUPS, KINDS
from saccade_lab.study.simulator import Simulator, head_of
from saccade_lab.study.source import changed, episode_rng, unchanged
from saccade_lab.study.table import read_provenance, read_table

CHECKPOINT = str(DEMO_CHECKPOINT)


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


def study(*arguments: str) -> int:
    return main(["study", *arguments])


def test_cuts_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--tasks", "button-press-topdown", "--episodes", "2", "--out", str(tmp_path)]
    assert study("cuts", *arguments, "--arms", "future-shuffled,future-unread") == 0
    printed = capsys.readouterr().out
    assert "Control, future tokens shuffled" in printed
    assert str(tmp_path / "cuts.csv") in printed

    table = read_table(tmp_path / "cuts.csv")
    assert table[["task", "seed", "arm"]].to_numpy().tolist() == [
        ["button-press-topdown", seed, arm]
        for seed in (0, 1)
        for arm in ("future-shuffled", "future-unread", "none")
    ]
    by_arm = table.set_index(["arm", "seed"])
    # The arm "none" is what `saccade rollout` does with the same seeds.
    policy = Policy.from_pretrained(num_threads=1)
    environment = environment_for(policy, "button-press-topdown")
    for seed in (0, 1):
        episode = run_episode(environment, policy, seed)
        row: Any = by_arm.loc[("none", seed)]
        assert (row["success"], row["steps"], row["chunks"]) == (
            episode.success,
            episode.steps,
            episode.chunks,
        )
    environment.close()
    assert (by_arm.loc["none"]["chunk_change"] == 0.0).all()
    # I1: the order of the tokens changes nothing but rounding.
    assert 0 < by_arm.loc["future-shuffled"]["chunk_change_max"].max() < 1e-4
    assert by_arm.loc["future-unread"]["chunk_change"].min() > 1e-3

    provenance = read_provenance(tmp_path / "cuts.json")
    assert provenance.complete
    assert provenance.settings["checkpoint"]["sha256"] == policy.checkpoint_sha256()
    assert str(DEMO_CHECKPOINT) not in (tmp_path / "cuts.json").read_text()  # tables are committed

    # The same again with one more arm does that arm only, and prints the table for programs.
    done = {path: path.stat().st_mtime_ns for path in (tmp_path / "cuts" / "cells").iterdir()}
    assert study("cuts", *arguments, "--arms", "future-zeroed", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["provenance"]["done"] == 8
    assert {row["arm"] for row in found["rows"]} == {
        "none",
        "future-shuffled",
        "future-unread",
        "future-zeroed",
    }
    assert all(path.stat().st_mtime_ns == time for path, time in done.items())


def test_chunks_of_an_arm_are_those_of_the_reference() -> None:
    """The change of the chunk, with the head in torch and the cut of the whole group done by hand: N = 0."""
    policy = Policy.from_pretrained(num_threads=1)
    source = Simulator(CHECKPOINT, ("button-press-topdown",), range(1))
    unread = ARMS["future-unread"].intervention(source.future_tokens, episode_rng("push", 0))
    before = unchanged(source, "button-press-topdown", 0)
    change = np.abs(changed(source, "button-press-topdown", 0, unread) - before.actions)[1, 0]
    given = before.observations[1]

    reference = ActionHead.from_pretrained(DEMO_CHECKPOINT)
    without = ActionHead.from_pretrained(DEMO_CHECKPOINT)
    without.future_tokens.weight.data = without.future_tokens.weight.data[:0]
    assert without.future_tokens.weight.shape[0] == 0

    def chunk(head: ActionHead) -> np.ndarray:
        with torch.no_grad():
            vl_embs = head.encode(given.backbone_features)
            actions = head.sample(vl_embs, given.state, 0, noise=given.noise)[0].numpy()  # type: ignore[arg-type]
        return policy.robot_actions(actions)

    np.testing.assert_allclose(change, np.abs(chunk(without) - chunk(reference)), atol=1e-5)


def test_arms_do_what_they_are_named_for() -> None:
    tokens = np.random.default_rng(0).normal(0.3, 2.0, (6, 500)).astype(np.float32)

    def made(name: str, task: str = "push", seed: int = 0) -> Any:
        return ARMS[name].intervention(tokens, episode_rng(task, seed))

    shuffled = made("future-shuffled").future_tokens
    assert sorted(map(tuple, shuffled)) == sorted(map(tuple, tokens))
    assert not np.array_equal(shuffled, tokens)
    np.testing.assert_allclose(
        made("future-averaged").future_tokens, np.repeat(tokens.mean(0)[None], 6, axis=0)
    )
    assert not made("future-zeroed").future_tokens.any()
    redrawn = made("future-redrawn").future_tokens
    assert redrawn.mean() == pytest.approx(tokens.mean(), abs=0.15)
    assert redrawn.std() == pytest.approx(tokens.std(), rel=0.05)
    assert np.abs(np.corrcoef(redrawn, tokens)[:6, 6:]).max() < 0.2
    # Others in every episode, the same in every run.
    np.testing.assert_array_equal(redrawn, made("future-redrawn").future_tokens)
    for other in (made("future-redrawn", seed=1), made("future-redrawn", task="reach")):
        assert not np.allclose(redrawn, other.future_tokens)
    assert made("none") is None
    assert {name for name, arm in ARMS.items() if arm.why_not(0) is None} == {
        "none",
        "action-blind",
        "all-blind",
    }
    assert all(arm.why_not(1) is None for arm in ALL_ARMS)


@pytest.fixture(scope="module")
def without_future_tokens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped policy with N = 0, as `saccade train --num-future-tokens 0` writes one."""
    from safetensors.numpy import save_file

    directory = tmp_path_factory.mktemp("n0") / "policy"
    shutil.copytree(DEMO_CHECKPOINT, directory)
    config = json.loads((DEMO_CHECKPOINT / "config.json").read_text())
    config["action_head_cfg"]["num_target_vision_tokens"] = 0
    (directory / "config.json").write_text(json.dumps(config))
    tensors = read_tensors(DEMO_CHECKPOINT)
    name = next(name for name in tensors if name.endswith("future_tokens.weight"))
    tensors[name] = tensors[name][:0]
    save_file(tensors, directory / "model.safetensors")
    return directory


def test_without_future_tokens_their_arms_are_not_measured(
    without_future_tokens: Path, tmp_path: Path
) -> None:
    arguments = ["--checkpoint", str(without_future_tokens), "--episodes", "1", "--out", str(tmp_path)]
    arms = "future-unread,future-zeroed,action-blind"
    assert study("cuts", *arguments, "--tasks", "button-press-topdown", "--arms", arms) == 0
    table = read_table(tmp_path / "cuts.csv").set_index("arm")
    assert table.loc[["future-unread", "future-zeroed"], "success"].isna().all()
    assert set(table["note"].dropna()) == {"the checkpoint has no future tokens"}
    assert table.loc[["none", "action-blind"], "success"].notna().all()

    assert study("patching", *arguments, "--tasks", "push", "--kinds", "layout") == 0
    table = read_table(tmp_path / "patching.csv")
    assert table.loc[table["group"] == "future", "note"].tolist() == ["the checkpoint has no future tokens"]
    control = table[(table["group"] == "all rows") & (table["block"] == "all")]
    assert control["toward"].iloc[0] == pytest.approx(control["squared_way"].iloc[0], rel=1e-4)

    assert study("report", str(tmp_path)) == 0
    text = (tmp_path / "report.md").read_text()
    assert "{state, action} <- future cut: not measured, the checkpoint has no future tokens." in text
    assert "layout, future rows: not measured, the checkpoint has no future tokens." in text


def test_patching_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--tasks", "push,drawer-open", "--episodes", "2", "--out", str(tmp_path)]
    assert study("patching", *arguments) == 0
    assert "Control, all rows in all blocks: a share of 1.0000, as expected." in capsys.readouterr().out
    table = read_table(tmp_path / "patching.csv")
    blocks = head_of(CHECKPOINT).config.num_layers
    counts = table[table["note"].isna()].groupby(["kind", "task"]).size().to_dict()
    # Every group, in each block and in all; no other task has the drawer.
    each = 2 * len(GROUPS) * (blocks + 1)
    assert counts == {(kind, "push"): each for kind in KINDS} | {
        ("layout", "drawer-open"): each,
        ("task", "drawer-open"): each,
    }
    noted = table[table["note"].notna()]
    assert noted[["kind", "task"]].drop_duplicates().to_numpy().tolist() == [["words", "drawer-open"]]
    first = table[(table["kind"] == "layout") & (table["task"] == "push")]
    assert first["donor_seed"].sub(first["seed"]).unique().tolist() == [2]
    assert (table[table["kind"] == "words"]["donor_task"].dropna() == "reach").all()

    share = (table["toward"] / table["squared_way"]).where(table["note"].isna())
    # Rows of a group that the action rows do not read any more change nothing; all rows after the last
    # cross-attention block give the donor's chunk.
    last = table["block"] == str(blocks - 1)
    assert (table.loc[last & table["group"].isin(["state", "future"]), "squared_change"] == 0).all()
    whole = (table["group"] == "all rows") & table["block"].isin(["all", str(blocks - 1), str(blocks - 2)])
    np.testing.assert_allclose(share[whole & table["note"].isna()], 1.0, rtol=1e-3)
    # Block 1 makes its rows from those of block 0 alone, so all rows may be given before it or after it.
    of_all = table[(table["group"] == "all rows") & table["note"].isna()].set_index(["kind", "task", "seed"])
    before, after = (of_all.loc[of_all["block"] == block, "toward"] for block in ("0", "1"))
    np.testing.assert_allclose(before, after, rtol=1e-3)


def test_block_zero_of_the_future_rows_holds_vision_alone() -> None:
    """I7: with the same instruction and the same picture there is nothing to follow."""
    source = Simulator(CHECKPOINT, ("reach",), range(1))
    seen = source.first("reach", 0, "reach the green ball")
    receiver = seen.with_noise(np.random.default_rng(0), source.config)
    assert receiver.noise is not None
    donor = dataclasses.replace(receiver, state=1.0 + seen.state, noise=-receiver.noise)
    head = source.head()
    trace = donor.trace(head, record=("hidden",), blocks=0)
    rows = {place: np.asarray(hidden)[0][trace.rows["future"]] for place, hidden in trace.hidden.items()}
    patch = Intervention(patch={place: {"future": row} for place, row in rows.items()})
    np.testing.assert_allclose(receiver.sample(head, intervention=patch), receiver.sample(head), atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("cuts", "--arms", "future-cut"),
            "--arms: unknown name 'future-cut', expected one of none, future-unread",
        ),
        (("cuts", "--arms", ","), "--arms: expected at least one name"),
        (("cuts", "--tasks", "juggle"), "--tasks: unknown name 'juggle'"),
        (("cuts", "--tasks", "two-goals"), "does not know two-goals"),
        (("cuts", "--episodes", "0"), "--episodes: given 0, expected at least 1"),
        (("cuts", "--seed", "1000000"), "expected evaluation seeds, 0 to 999999"),
        (("cuts", "--checkpoint", "nowhere"), "nowhere: no such checkpoint directory"),
        (("cuts", "--jobs", "0"), "--jobs: given 0"),
        (("cuts", "--backend", "dask"), "argument --backend: invalid choice: 'dask'"),
        (
            ("patching", "--kinds", "colour"),
            "--kinds: unknown name 'colour', expected one of layout, words, task",
        ),
        (("patching", "--blocks", "4"), "--blocks: given 4, expected 0 to 3"),
        (("patching", "--steps", "one"), "--steps: given 'one', expected numbers"),
        (("patching", "--seed", "999990", "--episodes", "9"), "expected evaluation seeds, 0 to 999999"),
        (("cut",), "invalid choice: 'cut'"),
        ((), "the following arguments are required: study"),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")] if len(arguments) > 1 else []
    try:
        status = study(*arguments, *out)
    except SystemExit as stopped:
        status = int(str(stopped.code))
    printed = capsys.readouterr().err
    assert status == 2
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_arm_results_pair_by_task_and_seed() -> None:
    """The arm's rows come in another order than those of "none", and one of them has no partner."""
    none = [("a", 0, True), ("a", 1, False), ("b", 0, True), ("b", 1, True)]
    arm = [("b", 1, False), ("b", 0, True), ("a", 1, True), ("c", 0, True)]
    rows = [(*row, "none") for row in none] + [(*row, "future-blind") for row in arm]
    table = pd.DataFrame(rows, columns=["task", "seed", "success", "arm"])
    table["chunk_change"] = 0.1
    table["note"] = math.nan
    baseline, blind = arm_results(table, [*cuts.ARMS])
    assert (baseline.rate.value, baseline.episodes, baseline.pairs) == (0.75, 4, None)
    assert (blind.rate.value, blind.episodes) == (0.75, 4)
    assert blind.pairs is not None
    assert (blind.pairs.pairs, blind.pairs.only_first, blind.pairs.only_second) == (3, 1, 1)
