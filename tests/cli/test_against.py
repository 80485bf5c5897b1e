"""`saccade evaluate --against CHECKPOINT`: a second checkpoint on the same observations and noise."""

from __future__ import annotations

import gc
import json
import shutil
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import InputError, Policy, cli
from saccade.cli import recorded
from saccade.evaluation.pairing import SHARED, check_shared, interface_of
from saccade.evaluation.source import forget_policy
from tests.helpers.recorded_cases import Recorded, by_the_policy, demo_policy
from tests.helpers.recorded_folder import written

LENGTHS = (9, 5, 8)
DEMO = str(saccade.demo_checkpoint())
OPTIONS = ("--stride", 8, "--num-threads", 1)


@pytest.fixture(scope="module")
def data() -> Recorded:
    return by_the_policy(demo_policy(), LENGTHS, stride=4, seed=0)


@pytest.fixture(scope="module")
def folder(data: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(data, tmp_path_factory.mktemp("recordings") / "tiny")


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled policy without its state: the last layer of the state encoder is zero."""
    found = tmp_path_factory.mktemp("checkpoints") / "stateless"
    shutil.copytree(DEMO, found)
    file = found / "model.safetensors"
    content = bytearray(file.read_bytes())
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    for name in ("W", "b"):
        start, end = header[f"action_head.state_encoder.layer2.{name}"]["data_offsets"]
        content[8 + size + start : 8 + size + end] = bytes(end - start)
    file.write_bytes(content)
    return found


@pytest.fixture(autouse=True)
def without_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lab has tests of its own."""
    monkeypatch.setattr(recorded, "extension", lambda name: None)


def run(*arguments: Any) -> int:
    return cli.main([str(argument) for argument in arguments])


def test_another_checkpoint_stands_beside_this_one(
    folder: Path, data: Recorded, other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run("evaluate", DEMO, folder, "--out", out, *OPTIONS, "--against", other) == 0
    assert "Against stateless, float32" in capsys.readouterr().out
    found = json.loads((out / "results.json").read_text())
    own = saccade.evaluate(demo_policy(), data, stride=8)
    theirs = saccade.evaluate(Policy.from_pretrained(other, num_threads=1), data, stride=8)
    expected = own.compare(theirs)
    assert not expected.equal
    about = found["against"]
    assert {**expected.to_json(), "name": about["name"], "other": about["other"]} == about
    assert (found["mse"], about["other"]["mse"]) == (own.mse, theirs.mse)
    assert about["mse"]["value"] == pytest.approx(own.mse - theirs.mse, rel=1e-5)
    assert about["mse"]["low"] <= about["mse"]["value"] <= about["mse"]["high"]
    for key, one in about["mse_by_key"].items():
        assert one["value"] == pytest.approx(
            found["by_key"][key]["mse"] - about["other"]["by_key"][key]["mse"], rel=1e-5
        )
    assert set(about["mse_by_key"]) == {"hand", "gripper"}
    assert about["other"]["checkpoint"]["name"] == "stateless"


def test_the_same_checkpoint_exact_beside_a_fast_mode(folder: Path, data: Recorded, tmp_path: Path) -> None:
    exact = saccade.evaluate(demo_policy(), data, stride=8)
    fast: dict[str, Any] = {"num_steps": 1, "integrator": "midpoint"}
    for name, flags, options in (
        ("int8", ("--precision", "int8"), {}),
        ("midpoint", ("--num-steps", 1, "--integrator", "midpoint"), fast),
        ("refresh", ("--future-refresh", 2), {"future_refresh": 2}),
    ):
        out = tmp_path / name
        assert run("evaluate", DEMO, folder, "--out", out, *OPTIONS, *flags, "--against", DEMO) == 0
        found = json.loads((out / "results.json").read_text())
        assert found["sampling"] == options
        if options:
            assert found["mse"] == saccade.evaluate(demo_policy(), data, stride=8, **options).mse
        assert found["against"]["other"]["mse"] == exact.mse
        assert found["against"]["other"]["sampling"] == {}
        assert set(found["against"]["other"]["options"]["precision"].values()) == {"float32"}
        assert not found["against"]["equal"]


def test_both_go_on_where_they_stopped(
    folder: Path, other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, whole = tmp_path / "out", tmp_path / "whole"
    command = ("evaluate", DEMO, folder, "--against", other, *OPTIONS)
    assert run(*command, "--out", out, "--episodes", "0,2") == 0
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    assert len(files) == 4
    assert run(*command, "--out", out) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in files.items())
    assert run(*command, "--out", whole) == 0
    first, second = (json.loads((one / "results.json").read_text()) for one in (out, whole))
    for one in (first, second, first["against"]["other"], second["against"]["other"]):
        assert one.pop("seconds") > 0
    assert first == second
    # What is computed for a comparison is itself a run, and is not mixed with another one.
    assert run("evaluate", DEMO, folder, *OPTIONS, "--out", whole, "--against", out / "against") == 0
    again = json.loads((whole / "results.json").read_text())
    again["against"]["other"].pop("seconds")
    assert again["against"] == first["against"]
    capsys.readouterr()
    (other / "note.json").write_text("{}")  # a checkpoint with another file is another checkpoint
    try:
        assert run(*command, "--out", out) == 2
    finally:
        (other / "note.json").unlink()
    assert "against: has results with other settings (checkpoint changed)" in capsys.readouterr().err


def renamed(folder: Path, kind: str, old: str, new: str) -> Path:
    """A copy of the bundled policy with another name for one of its cameras or keys."""
    shutil.copytree(DEMO, folder)
    config, statistics = (folder / "experiment_cfg" / name for name in ("data_config.json", "metadata.json"))
    text = config.read_text()
    assert f'"{kind}.{old}"' in text
    config.write_text(text.replace(f'"{kind}.{old}"', f'"{kind}.{new}"'))
    values = json.loads(statistics.read_text())
    (robot,) = values.values()
    for part in (robot["statistics"], robot["modalities"]):
        if kind in part:
            part[kind] = {new if key == old else key: value for key, value in part[kind].items()}
    statistics.write_text(json.dumps(values))
    return folder


def test_what_does_not_match_is_named_before_anything_is_computed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short"
    shutil.copytree(DEMO, short)
    config = short / "experiment_cfg" / "data_config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "action_indices": list(range(8))}))
    for given, message in (
        (
            renamed(tmp_path / "keys", "action", "gripper", "claw"),
            "expected the action_keys of this run, [['hand', 3], ['gripper', 1]], got [['hand', 3], ['claw',",
        ),
        (
            renamed(tmp_path / "cameras", "video", "left", "wrist"),
            "expected the observation of this run, {'cameras': ['left',",
        ),
        (short, "expected the horizon of this run, 16, got 8"),
        (DEMO, "expected another checkpoint, precision or sampling than that of this run, got the same"),
        (tmp_path, "expected the directory of an earlier run, or a checkpoint: "),
        (tmp_path / "nowhere", "nowhere: No such file or directory"),
    ):
        out = tmp_path / "out"
        assert run("evaluate", DEMO, folder, "--out", out, *OPTIONS, "--against", given) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"saccade: --against: {given}: ")
        assert message in said
        assert not out.exists()


@pytest.mark.parametrize("name", SHARED)
def test_each_difference_that_breaks_pairs_is_refused(name: str) -> None:
    own: dict[str, Any] = {
        "command": "evaluate",
        "recordings": {"name": "a", "sha256": "1"},
        **interface_of(demo_policy()),
        "stride": 8,
        "seed": 0,
    }
    check_shared({**own, "recordings": {"name": "b", "sha256": "1"}, "precision": "int8"}, own, "here")
    with pytest.raises(InputError, match=f"here: expected the {name} of this run, .*, got None"):
        check_shared({key: value for key, value in own.items() if key != name}, own, "here")


def test_the_shape_of_the_noise_is_that_of_the_head() -> None:
    found = interface_of(demo_policy())
    config = demo_policy().head.config
    assert found["noise_shape"] == [config.action_horizon, config.encoder_action_dim]
    assert np.prod(found["noise_shape"]) == demo_policy().head.config.action_horizon * 4
    assert json.loads(json.dumps(found)) == found  # so that the settings of a file compare


def test_one_policy_is_in_memory(
    folder: Path, other: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, most = Policy.from_pretrained, []
    loaded: list[weakref.ref[Policy]] = []

    def counted(*arguments: Any, **options: Any) -> Policy:
        gc.collect()
        most.append(sum(one() is not None for one in loaded))
        policy = load(*arguments, **options)
        loaded.append(weakref.ref(policy))
        return policy

    forget_policy()
    monkeypatch.setattr(Policy, "from_pretrained", counted)
    assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *OPTIONS, "--against", other) == 0
    assert most == [0, 0, 0]  # this one for its checks, the other one, this one
