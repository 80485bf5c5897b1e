"""The study on a tiny plan: real training and real episodes, stage after stage; costs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_plan import PLAN, RECORDING, TASK, TINY, recipe

from saccade._internal.files import sha256_of
from saccade.errors import InputError
from saccade.head.intervention import Intervention
from saccade_lab.sim import graphics
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.study.questions import sweeps_cost
from saccade_lab.study.run import StudyError, run
from saccade_lab.study.simulator import policy_of
from saccade_lab.study.table import read_provenance, read_table
from saccade_lab.training import train
from why_32 import arms, costs, measures
from why_32 import plan as plans
from why_32.__main__ import main
from why_32.measured import MEASURED
from why_32.study import Answer


@pytest.fixture(autouse=True, scope="module")
def quick() -> Iterator[None]:
    """Training without its picture, few frames held out, short episodes; the machine draws."""
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "plot_history", lambda history, path: None)
        patch.setattr(train, "VALIDATION_FRAMES", 2)
        patch.setattr(graphics, "check", lambda: None)
        patch.setattr(plans, "PLAN", PLAN)
        yield


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of the first stage."""
    out = tmp_path_factory.mktemp("core")
    assert main(["run", "--stages", "core", "--out", str(out)]) == 0
    return out


def test_the_first_stage(core: Path) -> None:
    table: Any = read_table(core / "answer.csv")
    provenance = read_provenance(core / "answer.json")
    assert provenance.complete
    assert provenance.total == 1 + 1 + 6 + 6
    trained = table[table["kind"] == "training"].set_index("policy")
    assert sorted(trained.index) == sorted(f"n-{n}-seed-{seed}" for n in (0, 4, 32) for seed in (0, 1))
    policies = core / "answer" / "policies"
    backbones = table[table["kind"] == "backbone"].set_index("policy")
    assert list(backbones.index) == ["backbone"]
    assert (core / "answer" / "backbones" / "backbone" / "model.safetensors").is_file()
    assert backbones.loc["backbone", "steps"] == 2
    row = trained.loc["n-4-seed-1"]
    assert row["start_sha256"] == sha256_of(core / "answer" / "backbones" / "backbone" / "model.safetensors")
    assert row["checkpoint_sha256"] == Policy.from_pretrained(policies / "n-4-seed-1").checkpoint_sha256()
    history = json.loads((policies / "n-4-seed-1" / "history.json").read_text())
    assert row["validation_loss"] == history[-1]["validation_loss"]
    assert (row["steps"], row["trained_from_step"], row["training_seed"]) == (2, 0, 1)
    assert row["seconds"] > 0
    expected = costs.cost(replace(TINY, num_future_tokens=4), RECORDING)
    assert row["chunk_multiply_adds"] == expected.chunk
    assert row["training_multiply_adds"] == expected.sample * TINY.batch_size * TINY.steps
    recorded = table[table["kind"] == "recording"].iloc[0]
    assert row["demonstrations_sha256"] == recorded["demonstrations_sha256"]
    assert recorded["demonstrations"] == 2
    kept = {path.name for path in (policies / "n-4-seed-1").rglob("*") if path.is_file()}
    assert kept == {
        "config.json",
        "data_config.json",
        "history.json",
        "metadata.json",
        "model.safetensors",
        "settings.json",
        "tokenizer.json",
    }

    policy = Policy.from_pretrained(policies / "n-32-seed-0", num_threads=1)
    environment = environment_for(policy, TASK)
    episodes = table[table["kind"] == "episodes"].set_index(["policy", "seed"])
    assert len(episodes) == 12
    for seed in (0, 1):
        episode = run_episode(environment, policy, seed)
        row = episodes.loc[("n-32-seed-0", seed)]
        found = (row["success"], row["control_steps"], row["chunks"])
        assert found == (episode.success, episode.steps, episode.chunks)
    environment.close()


def test_all_policies_get_the_same_episodes(core: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same first images, states and noise, whatever N is."""
    given: dict[str, list[Any]] = {}
    for name in ("n-0-seed-0", "n-32-seed-1"):
        policy = Policy.from_pretrained(core / "answer" / "policies" / name, num_threads=1)
        seen = given.setdefault(name, [])
        act = policy.act

        def watched(observation: Any, *, noise: Any, seen: Any = seen, act: Any = act, **more: Any) -> Any:
            seen.append((observation["images"], observation["proprio"], observation["instruction"], noise))
            return act(observation, noise=noise, **more)

        monkeypatch.setattr(policy, "act", watched)
        environment = environment_for(policy, TASK)
        for seed in (3, 4):
            seen.append(seed)
            run_episode(environment, policy, seed)
        environment.close()
    one, other = given.values()
    starts = [([place for place, item in enumerate(seen) if isinstance(item, int)]) for seen in (one, other)]
    for first, second in zip(*starts, strict=True):
        for left, right in zip(one[first + 1][:2], other[second + 1][:2], strict=True):
            assert str(left) == str(right)
        assert one[first + 1][2] == other[second + 1][2]
        for chunk in range(1, 4):
            assert np.array_equal(one[first + chunk][3], other[second + chunk][3])
    assert not np.array_equal(one[starts[0][0] + 1][3], one[starts[0][1] + 1][3])


def times(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in out.glob("answer/*/*/model.safetensors")}


def test_nothing_is_trained_twice(core: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On another machine: without demonstrations, and with the policies and the finished cells."""
    out = tmp_path / "out"
    shutil.copytree(core, out)
    shutil.rmtree(out / "answer" / "demos")
    before = times(out)
    cells = {path: path.stat().st_mtime_ns for path in out.glob("answer/cells/*")}
    arguments = ["run", "--stages", "core", "--out", str(out)]
    assert main(arguments) == 0
    assert times(out) == before
    assert {path: path.stat().st_mtime_ns for path in out.glob("answer/cells/*")} == cells
    assert not (out / "answer" / "demos").exists()

    # Without the cells the policies are described and judged again, and not trained.
    (described,) = [
        path for path in cells if json.loads(path.read_text())["key"] == ["training", "n-4-seed-0"]
    ]
    described.unlink()
    assert main(arguments) == 0
    assert times(out) == before
    table: Any = read_table(out / "answer.csv")
    assert table.set_index("policy").loc["n-4-seed-0", "trained_from_step"].dropna().tolist() == [2.0]

    # A policy that is gone is named, and the others are judged.
    shutil.rmtree(out / "answer" / "policies" / "n-32-seed-1")
    for path in cells:
        if path.exists() and json.loads(path.read_text())["key"][0] == "episodes":
            path.unlink()
    capsys.readouterr()
    assert main(arguments) != 0
    assert "n-32-seed-1: no such policy; it was trained, with the hash" in capsys.readouterr().err
    provenance = read_provenance(out / "answer.json")
    assert (provenance.done, provenance.total) == (13, 14)


def test_a_policy_in_training_is_continued(core: Path, tmp_path: Path) -> None:
    whole: Any = read_table(core / "answer.csv")
    study = Answer(PLAN, ("core",)).begin(tmp_path).with_trained(whole)
    policy = study.planned("n-4-seed-0")
    backbone = study.trainings["backbone"]
    shutil.copytree(core / "answer" / "demos", tmp_path / "answer" / "demos")
    shutil.copytree(core / "answer" / "backbones", tmp_path / "answer" / "backbones")

    def stop(progress: train.Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train.train(study.demos["tiny"], study.trainings[policy.name], policy.training, stop, start=backbone)
    row = study.train(policy)
    assert (row["trained_from_step"], row["steps"]) == (1, 2)
    trained = whole[whole["kind"] == "training"].set_index("policy")
    assert row["checkpoint_sha256"] == trained.loc["n-4-seed-0", "checkpoint_sha256"]

    other = Answer(replace(PLAN, recipes=(recipe("core", "n-4", learning_rate=0.5),)), ("core",))
    with pytest.raises(InputError, match=r"n-4-seed-0: was trained with other settings \(learning_rate"):
        other.begin(tmp_path).with_trained(whole).train(other.planned("n-4-seed-0"))
    changed = replace(PLAN, recordings=(replace(RECORDING, counts={TASK: 3}),))
    with pytest.raises(InputError, match="was trained on other demonstrations"):
        Answer(changed, ("core",)).begin(tmp_path).with_trained(whole).train(policy)
    (study.trainings[policy.name] / "config.json").write_text(
        (study.trainings[policy.name] / "config.json").read_text() + " "
    )
    judge = replace(study, trained={policy.name: row["checkpoint_sha256"]})
    with pytest.raises(InputError, match=r"has the hash .* expected"):
        judge.judge(policy, "plain", TASK)
    tensors = backbone / "model.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-1] + b"\0")
    with pytest.raises(InputError, match=r"backbone: has the hash .* expected"):
        study.train(study.planned("n-32-seed-0"))


def test_a_later_stage_pairs_with_the_first(core: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(core, out)
    table: Any = run(Answer(PLAN, ("core", "alignment")), out)
    assert set(table[table["kind"] == "episodes"]["recipe"]) == {"n-0", "n-4", "n-32", "n-4-aligned"}
    assert read_provenance(out / "answer.json").total == 1 + 1 + 8 + 8
    assert len(times(out)) == 1 + 8
    # The core alone leaves the features, which the next stage of the plan needs. Now nobody does.
    assert len(list((core / "answer" / "policies").glob("features-*.npy"))) == 2
    assert not list((out / "answer" / "policies").glob("features-*.npy"))


def test_arms_of_trained_policies(core: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stage that trains nothing: a cut, and one Euler step, which a changed config must give as well."""
    unread = replace(arms.of_cuts("future-unread"), applies=lambda count: count == 4)
    one_step = replace(arms.steps_of(1), applies=lambda count: count == 0)
    monkeypatch.setitem(arms.ARMS, "instrument", (unread, one_step))
    monkeypatch.delitem(arms.ARMS, "steps")  # which has an arm of that name
    out = tmp_path / "out"
    shutil.copytree(core, out)
    assert main(["run", "--stages", "instrument", "--out", str(out)]) == 0
    table: Any = read_table(out / "answer.csv")
    assert read_provenance(out / "answer.json").total == 14 + 4
    found = table[table["kind"] == "episodes"].set_index(["policy", "arm", "seed"])
    policies = core / "answer" / "policies"

    def expected(directory: Path, seed: int, change: Intervention | None) -> tuple[bool, int]:
        policy = Policy.from_pretrained(directory, num_threads=1)
        environment = environment_for(policy, TASK)
        episode = run_episode(environment, policy, seed, intervention=change)
        environment.close()
        return episode.success, episode.steps

    cut = Intervention(cut=[("state", "future"), ("action", "future")])
    row = found.loc[("n-4-seed-1", "future-unread", 1)]
    assert (row["success"], row["control_steps"]) == expected(policies / "n-4-seed-1", 1, cut)
    stepped = tmp_path / "stepped"
    shutil.copytree(policies / "n-0-seed-0", stepped)
    config = json.loads((stepped / "config.json").read_text())
    config["action_head_cfg"]["num_inference_timesteps"] = 1
    (stepped / "config.json").write_text(json.dumps(config))
    row = found.loc[("n-0-seed-0", "steps of 1", 0)]
    assert (row["success"], row["control_steps"]) == expected(stepped, 0, None)


def test_stages_that_measure(core: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(core, out)
    for name in ("n-4-seed-1", "n-32-seed-1", "n-32-seed-0"):  # one policy is enough here
        shutil.rmtree(out / "answer" / "policies" / name)
    done = 14
    for stage in MEASURED:  # one after the other: a stage with failures is the last
        assert main(["run", "--stages", stage, "--out", str(out)]) != 0
        provenance = read_provenance(out / "answer.json")
        # Of the core's six policies two have no tokens, and three are not there.
        with_weights, planned = (3, 6) if stage == "probes" else (1, 4)
        assert (provenance.done, provenance.total) == (done + with_weights, done + planned)
        done += with_weights
    table: Any = read_table(out / "answer.csv")
    rows = table[table["kind"] == "specialise"]
    assert set(rows["policy"]) == {"n-4-seed-0"}
    assert sorted(zip(rows["tokens"], rows["weight"], strict=True)) == [
        (tokens, weight) for tokens in ("learned", "random") for weight in ("kept", "lost")
    ]
    rows = table[(table["kind"] == "patching") & (table["block"] == "all")].set_index("group")
    assert set(rows["pairs"]) == {2}
    assert rows["share"].isna().all()  # what is hardly trained acts alike in all layouts
    (row,) = table[table["kind"] == "measures"].to_dict("records")
    assert (row["policy"], row["training_seed"], row["num_future_tokens"]) == ("n-4-seed-0", 0, 4)
    directory = str(out / "answer" / "policies" / "n-4-seed-0")
    (found,) = measures.measure(directory, PLAN.tasks, PLAN.seeds)
    assert found["probe_r2"] is None
    for name in ("chunk_change", "attention_mass", "gradient_share"):
        assert row[name] == pytest.approx(found[name], rel=1e-6), name


def test_latencies(core: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One cell with a policy of each recipe, after everything else; it is repeated where there are others."""
    monkeypatch.setattr(sweeps_cost, "ROUNDS", 5)
    out = tmp_path / "out"
    shutil.copytree(core, out)
    assert main(["run", "--stages", "times", "--out", str(out)]) == 0
    provenance = read_provenance(out / "answer.json")
    assert (provenance.done, provenance.total) == (15, 15)
    table: Any = read_table(out / "answer.csv")
    rows = table[table["kind"] == "times"]
    assert list(rows["policy"]) == ["n-0-seed-0", "n-4-seed-0", "n-32-seed-0"]
    assert rows["sample_ratio"].iloc[0] == 1
    assert main(["run", "--stages", "alignment,times", "--out", str(out)]) == 0
    table = read_table(out / "answer.csv")
    rows = table[table["kind"] == "times"]
    assert list(rows["policy"]) == ["n-0-seed-0", "n-4-seed-0", "n-32-seed-0", "n-4-aligned-seed-0"]
    # Of some policies only the hash is kept: the next one of the recipe is timed, or an untrained one.
    for gone in ("n-4-seed-0", "n-4-aligned-seed-0", "n-4-aligned-seed-1"):
        shutil.rmtree(out / "answer" / "policies" / gone)
    assert main(["run", "--stages", "times", "--out", str(out)]) == 0
    table = read_table(out / "answer.csv")
    rows = table[table["kind"] == "times"].set_index("policy")
    assert list(rows.index) == ["n-0-seed-0", "n-4-seed-1", "n-32-seed-0", "n-4-aligned-seed-0"]
    assert list(rows["untrained"]) == [False, False, False, True]
    assert list(rows["checkpoint_sha256"].isna()) == [False, False, False, True]
    # It is as large as those that were trained.
    for size in ("head_bytes", "context_bytes", "num_vl_tokens"):
        assert rows.loc["n-4-aligned-seed-0", size] == rows.loc["n-4-seed-1", size]


def test_pilots_are_no_results(core: Path, tmp_path: Path) -> None:
    """They are run if they are named, on episodes of their own; a blind one is judged without pictures."""
    out = tmp_path / "out"
    shutil.copytree(core, out)
    assert main(["run", "--stages", "pilot", "--out", str(out)]) == 0
    table: Any = read_table(out / "answer.csv")
    assert read_provenance(out / "answer.json").total == 14 + 2 + 2
    pilots = table[(table["kind"] == "episodes") & (table["stage"] == "pilot")]
    assert set(pilots["seed"]) == {500, 501}
    name = "n-4-pilot-blind-seed-100"
    policy = Policy.from_pretrained(out / "answer" / "policies" / name, num_threads=1)
    environment = environment_for(policy, TASK, blanked=[camera.name for camera in policy.config.cameras])
    for seed in (500, 501):
        episode = run_episode(environment, policy, seed)
        row = pilots.set_index(["policy", "seed"]).loc[(name, seed)]
        assert (row["success"], row["control_steps"]) == (episode.success, episode.steps)
    environment.close()
    # Stages that train nothing, and those that are run by default, have no pilots.
    study = Answer(PLAN, ("instrument",)).begin(out)
    assert not [policy for policy, _ in study.judged("instrument") if "pilot" in policy.name]


def test_a_blind_policy_sees_nothing(core: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    directory = str(core / "answer" / "policies" / "n-4-seed-0")
    policy = policy_of(directory)
    act = policy.act

    def watched(observation: Any, **more: Any) -> Any:
        seen.append(max(image.max() for image in observation["images"].values()))
        return act(observation, **more)

    monkeypatch.setattr(policy, "act", watched)
    arms.judge(directory, TASK, 3, None, blind=True)
    assert seen
    assert not any(seen)
    seen.clear()
    arms.judge(directory, TASK, 3, None)
    assert all(seen)


def test_a_step_count_reaches_the_head(core: Path) -> None:
    """Episodes of policies that never succeed look alike, so the actions themselves are compared."""
    policy = Policy.from_pretrained(core / "answer" / "policies" / "n-4-seed-0", num_threads=1)
    seen = policy.blank("reach")
    noise = policy.noise(np.random.default_rng(0))
    features = policy.features(seen)
    for count in (1, 3):
        stepped = policy.with_head(arms.SteppedHead(policy.head, count))
        direct = policy.head.sample(
            policy.head.encode(features), policy.state(seen), 0, noise=noise, num_steps=count
        )
        found = stepped.act(seen, noise=noise).actions
        np.testing.assert_allclose(found, policy.robot_actions(np.asarray(direct))[0], atol=1e-6)


def test_failing_cells_do_not_stop_the_others(core: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(core, out)
    (out / "answer" / "policies" / "n-4-aligned-seed-0").mkdir()
    (out / "answer" / "policies" / "n-4-aligned-seed-0" / "settings.json").write_text("no JSON")
    with pytest.raises(StudyError, match="n-4-aligned-seed-0: not written by `saccade train`"):
        run(Answer(PLAN, ("core", "alignment")), out)
    table: Any = read_table(out / "answer.csv")
    assert "n-4-aligned-seed-1" in set(table["policy"])
