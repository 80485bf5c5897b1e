"""`saccade evaluate --against CHECKPOINT`: a second checkpoint on the same observations and noise."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import InputError, Policy
from saccade._internal.environment import arithmetic
from saccade.evaluation.episode_files import EpisodeFiles
from saccade.evaluation.pairing import SHARED, check_said, check_shared, interface_of
from tests.helpers.recorded_cases import Recorded, demo_policy
from tests.helpers.recorded_commands import DEMO, results, run

OPTIONS = ("--stride", 8, "--num-threads", 1)
pytestmark = pytest.mark.usefixtures("without_pages")


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


def test_another_checkpoint_is_compared_with_this_one(
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


def test_the_same_checkpoint_exact_against_a_fast_mode(folder: Path, data: Recorded, tmp_path: Path) -> None:
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
    first = results(out)
    assert first == results(whole)
    # What is computed for a comparison is itself a run, and is not mixed with another one.
    assert run("evaluate", DEMO, folder, *OPTIONS, "--out", whole, "--against", out / "against") == 0
    assert results(whole)["against"] == first["against"]
    capsys.readouterr()
    config = (other / "config.json").read_text()
    (other / "config.json").write_text(config + "\n")  # another checkpoint
    try:
        assert run(*command, "--out", out) == 2
    finally:
        (other / "config.json").write_text(config)
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


def test_policies_that_read_other_instructions_are_no_pairs(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings, tuned = tmp_path / "two", tmp_path / "tuned"
    shutil.copytree(folder, recordings)
    file = recordings / "meta" / "modality.json"
    modality = json.loads(file.read_text())
    (known,) = modality["annotation"]
    modality["annotation"]["human.other"] = modality["annotation"][known]
    file.write_text(json.dumps(modality))
    shutil.copytree(DEMO, tuned)
    config = tuned / "experiment_cfg" / "data_config.json"
    values = {**json.loads(config.read_text()), "language_keys": ["annotation.human.other"]}
    config.write_text(json.dumps(values))
    out = tmp_path / "out"
    command = ("evaluate", DEMO, recordings, "--out", out, *OPTIONS, "--against")
    assert run(*command, tuned) == 2
    said = f"{tuned}: expected the language_key of this run, annotation.{known}, got annotation.human.other"
    assert said in capsys.readouterr().err
    assert not out.exists()
    assert run("evaluate", tuned, recordings, "--out", tmp_path / "earlier", *OPTIONS) == 0
    assert run(*command, tmp_path / "earlier") == 2
    assert "expected the language_key of this run" in capsys.readouterr().err
    values["language_keys"] = ["annotation.human.none"]  # the recordings do not have it
    config.write_text(json.dumps(values))
    assert run(*command, tuned) == 2
    said = f"--against: {tuned}: data_config: expected one that says which is the instruction"
    assert said in capsys.readouterr().err


SETTINGS: dict[str, Any] = {
    "command": "evaluate",
    "recordings": {"sha256": "1"},
    **interface_of(demo_policy()),
    "language_key": "annotation.a",
    "stride": 8,
    "seed": 0,
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("command", "diagnose"),
        ("recordings", {"sha256": "2"}),
        ("observation", {**SETTINGS["observation"], "cameras": ["left", "top", "right"]}),
        ("observation", {**SETTINGS["observation"], "camera_steps": [-1, 0]}),
        ("observation", {**SETTINGS["observation"], "state": {"hand": 4}}),
        ("observation", {**SETTINGS["observation"], "state_steps": [-1, 0]}),
        ("action_keys", [["gripper", 1], ["hand", 3]]),
        ("head_widths", [6, 1]),
        ("horizon", 8),
        ("noise_shape", [SETTINGS["noise_shape"][0], SETTINGS["noise_shape"][1] + 1]),
        ("language_key", "annotation.b"),
        ("stride", 4),
        ("seed", 1),
    ],
)
def test_each_difference_that_breaks_pairs_is_refused(name: str, value: Any) -> None:
    assert set(SETTINGS) == set(SHARED)
    check_shared({**SETTINGS, "options": {"precision": "int8"}}, SETTINGS, "here")
    for changed in ({**SETTINGS, name: value}, {key: SETTINGS[key] for key in SETTINGS if key != name}):
        with pytest.raises(InputError, match=f"here: expected the {name} of this run, .*, got ") as error:
            check_shared(changed, SETTINGS, "here")
        assert str(error.value).endswith(f", got {changed.get(name)}")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"checkpoint": "base"}, "expected checkpoint in the settings of a run, got 'base'"),
        ({"checkpoint": {}}, "expected the sha256 of its checkpoint, got None"),
        ({"options": None}, "expected options in the settings of a run, got None"),
        ({"options": {}}, "expected the precision of a run, got None"),
        ({"options": {"precision": {}}}, "expected the precision of a run, got {}"),
        ({"options": {"precision": {"head": 8}}}, "expected the precision of a run, got {'head': 8}"),
        ({"sampling": []}, "expected sampling in the settings of a run, got []"),
        ({"library": None}, "expected library in the settings of a run, got None"),
        ({"dot_products": "vnni"}, "expected dot_products in the settings of a run, got 'vnni'"),
    ],
)
def test_settings_that_do_not_say_what_a_run_was_are_named(changed: dict[str, Any], message: str) -> None:
    said = {
        "checkpoint": {"sha256": "1"},
        "options": {"precision": {"backbone": "int8", "head": "float32"}},
        "sampling": {},
        **arithmetic(),
    }
    check_said(said, "here")
    with pytest.raises(InputError) as error:
        check_said({**said, **changed}, "here")
    assert str(error.value) == f"here: {message}"


def test_damaged_files_of_an_earlier_run_are_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    earlier, out = tmp_path / "earlier", tmp_path / "out"
    command = ("evaluate", DEMO, folder, *OPTIONS, "--out")
    assert run(*command, earlier) == 0
    settings, names = (earlier / "episodes" / name for name in ("settings.json", "names.json"))
    whole = json.loads(settings.read_text())
    settings.write_text(json.dumps({**whole, "options": {}}))
    assert run(*command, out, "--num-steps", 1, "--against", earlier) == 2
    assert f"--against: {earlier}: expected the precision of a run" in capsys.readouterr().err
    settings.write_text(json.dumps(whole))
    for text in ("[", '{"checkpoint": 3}'):
        names.write_text(text)
        assert run(*command, out, "--num-steps", 1, "--against", earlier) == 2
        assert "names.json: " in capsys.readouterr().err
    assert not out.exists()
    names.unlink()  # without names, the hash tells which it was
    assert run(*command, out, "--num-steps", 1, "--against", earlier) == 0
    assert results(out)["against"]["name"] == f"checkpoint {whole['checkpoint']['sha256'][:12]}, float32"


@pytest.mark.parametrize(
    "name", ["recorded", "predicted", "normalized_recorded", "normalized", "state", "steps", "seconds"]
)
def test_an_earlier_episode_of_another_shape_is_named(
    name: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    earlier, out = tmp_path / "earlier", tmp_path / "out"
    command = ("evaluate", DEMO, folder, *OPTIONS, "--episodes", 0, "--out")
    assert run(*command, earlier) == 0
    file = earlier / "episodes" / "000000.npz"
    with np.load(file) as arrays:
        values = dict(arrays)
    values[name] = values[name][..., 1:] if values[name].ndim else np.zeros(2)
    np.savez(file, **values)
    capsys.readouterr()
    for arguments in ((out, "--num-steps", 1, "--against", earlier), (earlier,)):
        assert run(*command, *arguments) == 2
        said = capsys.readouterr().err
        assert "000000.npz: cannot be read: " in said
        assert "expected" in said
    assert not out.exists()


def test_an_earlier_run_is_read_once(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    earlier, out = tmp_path / "earlier", tmp_path / "out"
    command = ("evaluate", DEMO, folder, *OPTIONS, "--out")
    assert run(*command, earlier) == 0
    load, read = EpisodeFiles.load, []

    def counted(files: EpisodeFiles[Any], episode: int) -> Any:
        if files.folder.parent == earlier:
            read.append(episode)
        return load(files, episode)

    monkeypatch.setattr(EpisodeFiles, "load", counted)
    assert run(*command, out, "--num-steps", 1, "--against", earlier) == 0
    assert read == [0, 1, 2]


def test_a_run_is_not_compared_with_itself(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert run("evaluate", DEMO, folder, "--out", out, *OPTIONS, "--episodes", 1) == 0
    capsys.readouterr()
    monkeypatch.chdir(tmp_path)
    assert run("evaluate", DEMO, folder, "--out", out, *OPTIONS, "--against", "out") == 2
    assert "--against: expected another run than that in --out, got out" in capsys.readouterr().err


def test_the_shape_of_the_noise_is_that_of_the_head() -> None:
    found = interface_of(demo_policy())
    config = demo_policy().head.config
    assert found["noise_shape"] == [config.action_horizon, config.encoder_action_dim]
    assert np.prod(found["noise_shape"]) == demo_policy().head.config.action_horizon * 4
    assert json.loads(json.dumps(found)) == found  # so that the settings of a file compare


def test_one_policy_is_in_memory(folder: Path, other: Path, tmp_path: Path, held_at_loads: list[int]) -> None:
    assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *OPTIONS, "--against", other) == 0
    assert held_at_loads == [0, 0, 0]  # this one for its checks, the other one, this one
