"""The sweeps over trained policies and the study of resized ones: real runs of a few steps, known numbers."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
import torch
from scipy import stats

from saccade import ActionHead, Context, InputError, Intervention
from saccade.cli import main
from saccade_lab.sim import demos, graphics
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.study import runs
from saccade_lab.study.questions import resized, sweeps, sweeps_cost, sweeps_results
from saccade_lab.study.questions.resized_section import BASELINE, TWICE, TWICE_EQUAL
from saccade_lab.study.questions.sweeps import FutureTokens, VlSelfAttention, VlTokens
from saccade_lab.study.questions.sweeps_results import PLAIN
from saccade_lab.study.run import run
from saccade_lab.study.statistics import paired_difference
from saccade_lab.study.table import read_provenance, read_table
from saccade_lab.training import train
from saccade_lab.training.settings import TrainingSettings

TASK = "button-press-topdown"
TINY = TrainingSettings(
    steps=2, batch_size=2, width=8, num_layers=2, num_heads=1, language_layers=1, patch_size=8
)


NAMES = FutureTokens.varied.names
RUNS: dict[str, dict[str, Any]] = {
    "n2-seed0": {"num_future_tokens": 2},
    "n2-seed1": {"num_future_tokens": 2, "seed": 1},
    "n4-seed0": {"num_future_tokens": 4},
    "n4-aligned-seed0": {"num_future_tokens": 4, "alignment_weight": 0.2},
}


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


@pytest.fixture(autouse=True, scope="module")
def quick() -> Iterator[None]:
    """Training without its picture, few frames held out, and few rounds of timing."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "plot_history", lambda history, path: None)
        patch.setattr(train, "VALIDATION_FRAMES", 2)
        patch.setattr(sweeps_cost, "ROUNDS", 3)
        yield


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations of one task with small pictures."""
    out = tmp_path_factory.mktemp("demos")
    settings = demos.RecordingSettings(image_size=16, frame_stride=12, cameras=DEFAULT_CAMERAS[:1])
    demos.record_tasks({TASK: 2}, out, settings, lambda task: None)
    return out


@pytest.fixture(scope="module")
def policies(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """N = 2 and 4, the latter also aligned; two training seeds of the first."""
    out = tmp_path_factory.mktemp("policies")
    for name, changes in RUNS.items():
        settings = TrainingSettings(**{**vars(TINY), **changes})
        train.train(recording, out / name, settings, lambda progress: None)
    return out


def study(name: str, *arguments: str) -> int:
    return main(["study", name, *arguments])


def shipped() -> tuple[ActionHead, Context, npt.NDArray[np.float32]]:
    """The shipped head, and a random observation and state."""
    head = ActionHead.from_pretrained(DEMO_CHECKPOINT, num_threads=1)
    rng = np.random.default_rng(0)
    context = head.encode(rng.standard_normal((1, 9, head.config.context_dim), dtype=np.float32))
    return head, context, rng.standard_normal((1, head.config.state_dim), dtype=np.float32)


def test_a_sweep_over_trained_policies(
    policies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--policies", str(policies), "--episodes", "1", "--out", str(tmp_path)]
    assert study("n", *arguments) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("Detectable with 80 % power at the 5 % level:")
    assert "N = 4 compared with N = 2. These policies: success: undecided, too few episodes" in printed.out
    assert "N = 4, aligned (0.2) compared with N = 4." in printed.out
    assert "N = 4, aligned (0.2) compared with N = 2." not in printed.out  # differs in two respects
    table: Any = read_table(tmp_path / "n.csv")
    provenance = read_provenance(tmp_path / "n.json")
    assert provenance.complete
    assert set(table["kind"]) == {"before", "training", "episode", "cost"}

    history = json.loads((policies / "n4-seed0" / "history.json").read_text())
    by_policy = table[table["kind"] == "training"].set_index("policy")
    assert by_policy.loc["n4-seed0", "validation_loss"] == history[-1]["validation_loss"]
    assert by_policy.loc["n4-aligned-seed0", "alignment_weight"] == 0.2
    checkpoint = Policy.from_pretrained(policies / "n4-seed0").checkpoint_sha256()
    assert set(table.loc[table["policy"] == "n4-seed0", "checkpoint_sha256"]) == {checkpoint}
    assert provenance.settings["training"]["steps"] == TINY.steps

    episodes = table[table["kind"] == "episode"].set_index(["policy", "arm"])
    policy = Policy.from_pretrained(policies / "n2-seed1", num_threads=1)
    environment = environment_for(policy, TASK)
    plain = run_episode(environment, policy, 0)
    heavier = run_episode(environment, policy, 0, intervention=sweeps.equal_mass(2, 4))
    environment.close()
    for arm, episode in ((PLAIN, plain), ("mass of 4", heavier)):
        row = episodes.loc[("n2-seed1", arm)]
        assert (row["success"], row["steps"]) == (episode.success, episode.steps)
    assert set(episodes.loc["n4-seed0"].index) == {PLAIN, "mass of 2"}

    cost = table[table["kind"] == "cost"].set_index("policy")
    assert list(cost.index) == ["n2-seed0", "n4-seed0", "n4-aligned-seed0"]
    assert cost.loc["n2-seed0", "sample_ratio"] == 1.0
    head = ActionHead.from_pretrained(policies / "n4-seed0")
    assert cost.loc["n4-seed0", "head_bytes"] == head.nbytes
    assert cost.loc["n4-seed0", "context_bytes"] == cost.loc["n2-seed0", "context_bytes"]

    section = FutureTokens.summarise(table, provenance)
    assert [grid.caption.split(":")[0] for grid in section.grids][:1] == ["Every policy"]
    assert len(section.grids) == 4
    # The same command again does nothing but read.
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("n/cells/*")}
    assert study("n", *arguments) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("n/cells/*")} == before


def test_a_sweep_that_trains(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "--demos",
        str(recording),
        "--patch-size",
        "8,16",
        "--training-seeds",
        "0",
        "--training-steps",
        "1",
    ]
    assert study("tvl", *arguments, "--episodes", "1", "--out", str(tmp_path)) == 0
    assert "Over training runs (1 and 1): no interval." in capsys.readouterr().out
    table: Any = read_table(tmp_path / "tvl.csv")
    assert list(table[table["kind"] == "training"]["policy"]) == [
        "patch-size-16-seed-0",
        "patch-size-8-seed-0",
    ]
    cost = table[table["kind"] == "cost"].set_index("patch_size")
    assert cost.loc[8, "num_vl_tokens"] - cost.loc[16, "num_vl_tokens"] == 3  # 4 patches instead of 1
    section = VlTokens.summarise(table, read_provenance(tmp_path / "tvl.json"))
    assert "1 cameras, 16 px, patches of 8 px" in section.grids[0].rows[0][0]


def test_policies_that_differ_in_more_are_refused(policies: Path, tmp_path: Path) -> None:
    found = runs.find_runs([policies], NAMES)
    FutureTokens.check_comparable(found)
    assert [run.name for run in found[:2]] == ["n2-seed0", "n2-seed1"]
    with pytest.raises(
        InputError, match=r"alignment_weight: .*\. num_future_tokens: 2 \(n2-seed0, n2-seed1\); 4 \("
    ):
        VlSelfAttention.check_comparable(runs.find_runs([policies], VlSelfAttention.varied.names))

    mixed = tmp_path / "mixed"
    shutil.copytree(policies, mixed)
    changed = json.loads((mixed / "n4-seed0" / "settings.json").read_text())
    changed |= {"learning_rate": 0.5, "demonstrations": {**changed["demonstrations"], "sha256": "other"}}
    (mixed / "n4-seed0" / "settings.json").write_text(json.dumps(changed))
    with pytest.raises(InputError, match=r"learning_rate: .* 0.5 \(n4-seed0\)\. demonstrations: .*other"):
        FutureTokens.check_comparable(runs.find_runs([mixed], NAMES))
    shutil.copytree(policies / "n2-seed0", mixed / "again")
    shutil.rmtree(mixed / "n4-seed0")
    with pytest.raises(InputError, match="again and n2-seed0 are the same point with the same seed"):
        FutureTokens.check_comparable(runs.find_runs([mixed], NAMES))


def test_a_run_in_training_is_not_measured(policies: Path, tmp_path: Path) -> None:
    some = tmp_path / "policies"
    for name in ("n2-seed0", "n4-seed0"):
        shutil.copytree(policies / name, some / name)
    history = json.loads((some / "n4-seed0" / "history.json").read_text())
    (some / "n4-seed0" / "history.json").write_text(json.dumps([{**history[-1], "step": 1}]))
    assert study("n", "--policies", str(some), "--episodes", "1", "--out", str(tmp_path)) == 0
    table: Any = read_table(tmp_path / "n.csv")
    provenance = read_provenance(tmp_path / "n.json")
    assert not provenance.complete
    assert set(table[table["kind"] == "episode"]["policy"]) == {"n2-seed0"}
    concluded = FutureTokens.summarise(table, provenance).concluded
    assert "n4-seed0: not measured, in training, step 1 of 2." in concluded
    assert "Only N = 2 was measured, so there is nothing to compare." in concluded


def test_equal_mass_is_repeated_tokens() -> None:
    """Tokens with the weight of twice as many are each token twice (spec, I2)."""
    head, context, state = shipped()
    tokens = head.future_tokens
    assert tokens is not None
    twice = resized.repeated(tokens)
    plain, heavier, repeated = (
        np.asarray(head.sample(context, state, 0, seed=1, intervention=change))
        for change in (None, sweeps.equal_mass(len(tokens), 2 * len(tokens)), twice)
    )
    np.testing.assert_allclose(heavier, repeated, atol=1e-5)
    assert np.abs(heavier - plain).max() > 1e-2


def test_difference_between_runs_is_student_s() -> None:
    first, second = [0.3, 0.4], [0.55, 0.7]
    expected = stats.ttest_ind(second, first, equal_var=True).confidence_interval()
    found = sweeps_results.between_runs(first, second, episodes=1000)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert found.value == pytest.approx(0.275)
    # Runs that happen to agree still vary by their episodes.
    agreeing = sweeps_results.between_runs([0.5, 0.5], [0.5, 0.5], episodes=100)
    half = stats.t.ppf(0.975, 2) * math.sqrt(2 * 0.25 / 100 / 2)
    assert (agreeing.low, agreeing.high) == pytest.approx((-half, half))
    assert math.isnan(sweeps_results.between_runs([0.5], [0.2, 0.3], episodes=100).low)
    assert math.isnan(sweeps_results.between_runs([1.0, 1.0], [1.0, 1.0], episodes=100).low)


def test_difference_of_these_policies_is_paired() -> None:
    def rows(successes: list[list[bool]]) -> pd.DataFrame:
        return pd.DataFrame(
            [
                {"policy": str(run), "task": "reach", "seed": seed, "success": float(success)}
                for run, found in enumerate(successes)
                for seed, success in enumerate(found)
            ]
        )

    alternating = [True, False] * 10
    found = sweeps_results.same_policies(rows([alternating] * 2), rows([[True] * 20, alternating]))
    assert found.value == 0.25
    assert 0.04 < found.low < 0.25 < found.high < 0.48
    # Policies that agree in all of twenty episodes may differ in the twenty-first: z^2 / (n + z^2).
    agreeing = sweeps_results.same_policies(rows([alternating] * 2), rows([alternating] * 2))
    assert agreeing.high == pytest.approx(1.959964**2 / (20 + 1.959964**2))
    assert agreeing.low == -agreeing.high
    # One run a point, one episode lost: Tango's interval, which does not exclude a loss of 5 points.
    lost = sweeps_results.same_policies(rows([[True] * 100]), rows([[False] + [True] * 99]))
    known = paired_difference([False] + [True] * 99, [True] * 100).difference
    assert (lost.low, lost.high) == pytest.approx((known.low, known.high))
    assert lost.low < -0.05
    few = sweeps_results.same_policies(rows([[True] * 9]), rows([[False] * 9]))
    assert (few.value, math.isnan(few.low), math.isnan(few.high)) == (-1.0, True, True)


def test_policies_with_episodes_missing_are_left_out() -> None:
    plain = pd.DataFrame(
        {"policy": ["one"] * 3 + ["other"] * 2, "task": ["a", "a", "b", "a", "b"], "seed": [0, 1, 0, 0, 0]}
    )
    assert sweeps_results.complete_policies(plain) == (["one"], [("other", 2, 3)])
    other_tasks = plain.assign(task=["a", "a", "a", "b", "b"])
    assert sweeps_results.complete_policies(other_tasks)[0] == []


def test_one_directory_holds_policies_that_may_be_compared(policies: Path, tmp_path: Path) -> None:
    first = tmp_path / "first"
    shutil.copytree(policies / "n2-seed0", first / "n2-seed0")
    arguments = ["--episodes", "1", "--out", str(tmp_path / "out")]
    assert study("n", "--policies", str(first), *arguments) == 0
    second = tmp_path / "second"
    shutil.copytree(policies / "n4-seed0", second / "n4-seed0")
    changed = json.loads((second / "n4-seed0" / "settings.json").read_text())
    (second / "n4-seed0" / "settings.json").write_text(json.dumps({**changed, "batch_size": 3}))
    with pytest.raises(InputError, match="other settings"):
        run(FutureTokens({"n4-seed0": second / "n4-seed0"}, {}, (TASK,), range(1)), tmp_path / "out")


def test_what_is_merged_and_drawn() -> None:
    rng = np.random.default_rng(0)
    two = rng.standard_normal((2, 6)).astype(np.float32)
    merged = resized.merge(two[[0, 1, 0, 0, 1]], 2)
    rows, bias = np.asarray(merged.future_tokens), merged.key_bias
    assert bias is not None
    counts = np.exp(np.asarray(bias["future", None]))  # type: ignore[index]
    order = np.argsort(counts)
    np.testing.assert_allclose(rows[order], two[[1, 0]], rtol=1e-6)
    np.testing.assert_allclose(counts[order], [2, 3], rtol=1e-6)
    arm = resized.drawn(3, equal_mass=True)
    drawn = arm.intervention(np.arange(16, dtype=np.float32).reshape(8, 2), rng)
    assert drawn is not None
    assert drawn.future_tokens is not None
    assert np.asarray(drawn.future_tokens).shape == (3, 2)
    assert drawn.key_bias is not None
    assert float(np.exp(drawn.key_bias["future", None])) == pytest.approx(8 / 3)  # type: ignore[index]


def test_merging_equal_tokens_changes_nothing() -> None:
    """A head whose tokens are copies of four of them, merged to four: exact, by I2."""
    head, context, state = shipped()
    tokens = head.future_tokens
    assert tokens is not None
    copies = tokens[np.random.default_rng(0).integers(4, size=11)]
    merged = resized.merge(copies, 4)
    assert len(np.asarray(merged.future_tokens)) == 4
    whole, smaller = (
        np.asarray(head.sample(context, state, 0, seed=3, intervention=change))
        for change in (Intervention(future_tokens=copies), merged)
    )
    np.testing.assert_allclose(smaller, whole, atol=1e-5)


def test_resized_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--tasks", TASK, "--episodes", "1", "--num-future-tokens", "4", "--out", str(tmp_path)]
    assert study("n-runtime", *arguments) == 0
    printed = capsys.readouterr().out
    assert "Control, every token twice, equal mass: the chunk changed by at most" in printed
    assert "as expected" in printed
    table: Any = read_table(tmp_path / "n-runtime.csv")
    assert set(table["arm"]) == {BASELINE, *(arm.name for arm in resized.arms_of([4]))}
    by_arm = table.groupby("arm")["chunk_change"].mean()
    assert by_arm[BASELINE] == 0.0
    assert by_arm["4 drawn"] > 1e-3
    section = resized.Resized.summarise(table, read_provenance(tmp_path / "n-runtime.json"))
    assert [row[0] for row in section.grids[0].rows] == [
        "4 drawn",
        "4 drawn, equal mass",
        "4 merged",
        TWICE,
        TWICE_EQUAL,
    ]


def test_resizing_a_policy_without_tokens(recording: Path, tmp_path: Path) -> None:
    settings = TrainingSettings(**{**vars(TINY), "num_future_tokens": 0, "steps": 1})
    train.train(recording, tmp_path / "policy", settings, lambda progress: None)
    arguments = ["--checkpoint", str(tmp_path / "policy"), "--episodes", "1", "--out", str(tmp_path)]
    assert study("n-runtime", *arguments) == 0
    table: Any = read_table(tmp_path / "n-runtime.csv")
    section = resized.Resized.summarise(table, read_provenance(tmp_path / "n-runtime.json"))
    assert section.concluded == ["Not measured, the checkpoint has no future tokens."]


def test_bad_input(
    policies: Path, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(name: str, *arguments: str) -> str:
        assert study(name, *arguments, "--out", str(tmp_path / "out")) == 2
        return capsys.readouterr().err

    runs = ("--policies", str(policies))
    assert "expected either --policies" in refused("n")
    assert "expected either --policies" in refused("n", *runs, "--demos", str(recording))
    assert "contain no runs of `saccade train`" in refused("n", "--policies", str(recording))
    assert "no such directory of policies" in refused("n", "--policies", str(tmp_path / "nowhere"))
    assert "not all policies know reach" in refused("n", *runs, "--tasks", "reach")
    assert "differ in vl_num_layers and seed only" in refused("vlsa", *runs)
    training = ("--demos", str(recording))
    assert "expected one: all runs see the same" in refused("n", *training, *training)
    assert "--training-steps: given 0" in refused("n", *training, "--training-steps", "0")
    assert "--alignment-weights: given -1" in refused("n", *training, "--alignment-weights", "-1")
    for word in ("much", "inf", "nan"):
        given = refused("n", *training, "--alignment-weights", word)
        assert f"--alignment-weights: given '{word}', expected numbers" in given
    assert "--num-future-tokens: given 40, expected 1 to 31" in refused(
        "n-runtime", "--num-future-tokens", "40"
    )
    assert not (tmp_path / "out").exists()
