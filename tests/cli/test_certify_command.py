"""`saccade evaluate --certify` and `saccade certify`: what holds, what is noticed, what is refused."""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.cli import recorded
from saccade.evaluation import certificate
from tests.helpers.lfs_pointer import POINTER
from tests.helpers.recorded_commands import DEMO, run

OPTIONS = ("--stride", 8, "--num-threads", 1)
NAMES = [
    "checkpoint, sha256",
    "recordings, sha256",
    "actions, bits",
    "the same bits over batches",
    "the same bits over threads",
    "largest difference from float32",
]
pytestmark = pytest.mark.usefixtures("without_pages")


@pytest.fixture(scope="module")
def certified(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """A certificate of each of two precisions."""
    found = {}
    for precision in ("float32", "int8"):
        out = tmp_path_factory.mktemp(precision) / "out"  # which the run makes
        file = out / "certificate.json"
        command = ("evaluate", DEMO, folder, "--out", out, *OPTIONS, "--precision", precision)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(recorded, "extension", lambda name: None)
            assert run(*command, "--certify", file) == 0
        assert file.stat().st_size < 20_000
        found[precision] = json.loads(file.read_text())
    return found


def findings(
    file: Path, values: dict[str, Any], capsys: pytest.CaptureFixture[str], *flags: Any
) -> dict[str, bool]:
    """What holds of a certificate."""
    file.write_text(json.dumps(values))
    capsys.readouterr()
    status = run("certify", file, "--json", "--num-threads", 2, *flags)
    found = json.loads(capsys.readouterr().out)
    assert status == (0 if found["holds"] else 1)
    return {one["name"]: one["holds"] for one in found["findings"]}


def with_actions(values: dict[str, Any], content: bytes) -> dict[str, Any]:
    """A certificate with other actions."""
    text = base64.b64encode(content).decode()
    return {**values, "actions": text, "actions_sha256": hashlib.sha256(content).hexdigest()}


def made_with(values: dict[str, Any], **other: Any) -> dict[str, Any]:
    """A certificate that was made with something else."""
    return {**values, "made_with": {**values["made_with"], **other}}


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_a_certificate_holds_here(
    precision: str,
    certified: dict[str, dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    values = certified[precision]
    assert values["equal_over_batches"] is values["equal_over_threads"] is True
    assert values["threads"] == [1, 2]
    assert values["observations"] == [[0, 0], [0, 8], [1, 0], [2, 0]]
    assert 0 <= values["from_float32"]["normalized"] < 1
    assert (values["from_float32"]["normalized"] == 0) is (precision == "float32")
    assert findings(tmp_path / "c.json", values, capsys) == dict.fromkeys(NAMES, True)
    assert run("certify", tmp_path / "c.json") == 0
    assert "NO" not in capsys.readouterr().out


def test_other_bits_are_noticed_where_they_must_be_equal(
    certified: dict[str, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for values in certified.values():
        actions = np.frombuffer(base64.b64decode(values["actions"]), "<f4").copy()
        actions[3] = np.nextafter(actions[3], np.float32(9))
        found = findings(tmp_path / "c.json", with_actions(values, actions.tobytes()), capsys)
        assert [name for name, holds in found.items() if not holds] == ["actions, bits"]


@pytest.mark.parametrize(
    ("other", "value"),
    [
        ("saccade", "0.0.1"),
        ("library", "0123456789ab"),
        ("instruction_set", "elsewhere"),
        ("dot_products", ["elsewhere"]),
    ],
)
def test_other_machines_may_round_otherwise_but_not_compute_something_else(
    other: str,
    value: Any,
    certified: dict[str, dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for precision, values in certified.items():
        name = f"actions, normalised, made with {other} {value[0] if isinstance(value, list) else value}"
        if precision == "float32" and other == "dot_products":  # which float32 does not use
            name = "actions, bits"
        elsewhere = made_with(values, **{other: value})
        actions = np.frombuffer(base64.b64decode(values["actions"]), "<f4")
        expected = {one if one != "actions, bits" else name: True for one in NAMES}
        assert findings(tmp_path / "c.json", elsewhere, capsys) == expected
        rounded = with_actions(elsewhere, np.nextafter(actions, np.float32(9)).tobytes())
        assert findings(tmp_path / "c.json", rounded, capsys)[name] is (name != "actions, bits")
        wrong = with_actions(elsewhere, bytes(actions.nbytes))
        assert findings(tmp_path / "c.json", wrong, capsys)[name] is False
        # What a certificate says of itself does not widen what it may differ by.
        forged = {**wrong, "from_float32": {"normalized": 1e9, "by_key": {}}}
        found = findings(tmp_path / "c.json", forged, capsys)
        assert not found[name]
        assert not found["largest difference from float32"]


def test_other_contents_are_named_before_anything_is_computed(
    certified: dict[str, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = certified["int8"]
    for part in ("checkpoint", "recordings"):
        other = {**values, part: {**values[part], "sha256": "0" * 64}}
        found = findings(tmp_path / "c.json", other, capsys)
        assert found == {name: not name.startswith(part) for name in NAMES[:2]}


def test_files_of_options_are_certified_too(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Relative paths become absolute ones, so that another directory does not matter.
    monkeypatch.chdir(tmp_path)
    shutil.copytree(DEMO, "policy")
    shutil.copytree(folder, "recordings")
    shutil.copyfile("policy/tokenizer.json", "words.json")
    shutil.copyfile("policy/experiment_cfg/data_config.json", "keys.json")
    command = ("evaluate", "policy", "recordings", "--out", "out", *OPTIONS, "--episodes", 1)
    files = ("--tokenizer", "words.json", "--data-config", "keys.json")
    assert run(*command, *files, "--certify", "c.json") == 0
    values = json.loads(Path("c.json").read_text())
    for name, path in (
        ("tokenizer", values["options"]["tokenizer"]),
        ("data_config", values["options"]["data_config"]),
    ):
        content = Path(path).read_bytes()
        assert Path(path).is_absolute()
        assert values["option_files"][name] == hashlib.sha256(content).hexdigest()
    assert values["checkpoint"]["path"] == str(tmp_path / "policy")
    assert values["recordings"]["path"] == str(tmp_path / "recordings")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    expected = [*NAMES[:2], "tokenizer, sha256", "data_config, sha256", *NAMES[2:]]
    assert findings(tmp_path / "c.json", values, capsys) == dict.fromkeys(expected, True)
    for name, flag in (("words.json", "--tokenizer"), ("keys.json", "--data-config")):
        (tmp_path / name).rename(tmp_path / "elsewhere" / name)
        assert run("certify", tmp_path / "c.json") == 2
        assert f"{tmp_path / name}: no such path here: pass {flag}" in capsys.readouterr().err
        assert all(findings(tmp_path / "c.json", values, capsys, flag, name).values())
        text = Path(name).read_text()
        Path(name).write_text(text + "\n")
        found = findings(tmp_path / "c.json", values, capsys, flag, name)
        assert [one for one, holds in found.items() if not holds] == [
            f"{flag.removeprefix('--').replace('-', '_')}, sha256"
        ]
        Path(name).write_text(text)
        (tmp_path / "elsewhere" / name).rename(tmp_path / name)
    (tmp_path / "policy").rename(tmp_path / "moved")
    assert run("certify", tmp_path / "c.json") == 2
    assert all(findings(tmp_path / "c.json", values, capsys, "--checkpoint", tmp_path / "moved").values())


def test_one_observation_is_compared_in_a_batch_of_two(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute, file = certificate._actions, tmp_path / "c.json"
    command = ("evaluate", DEMO, folder, *OPTIONS, "--episodes", 1, "--certify", file, "--out")
    assert run(*command, tmp_path / "one") == 0
    values = json.loads(file.read_text())
    assert values["observations"] == [[1, 0]]
    assert values["equal_over_batches"] is True

    def drifting(policy: Any, data: Any, places: Any, seed: Any, sampling: Any) -> Any:
        return compute(policy, data, places, seed, sampling) + np.float32(len(places))

    monkeypatch.setattr(certificate, "_actions", drifting)
    assert run(*command, tmp_path / "two") == 0
    assert json.loads(file.read_text())["equal_over_batches"] is False


def test_differences_beyond_the_range_of_the_head_count() -> None:
    normalizer = saccade.Normalizer.from_pretrained(DEMO)
    groups = tuple(replace(group, clips=True) for group in normalizer.action_groups)
    clipped = replace(normalizer, action_groups=groups)
    state = np.zeros((1, 1, normalizer.state_width), np.float32)
    one = np.full((1, 2, normalizer.action_width), 50, np.float32)
    assert np.array_equal(clipped.normalize_actions(one, state), clipped.normalize_actions(2 * one, state))
    assert certificate._apart(clipped, state, one, 2 * one) > 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"actions": "AAAA"},  # another hash
        {"actions_sha256": "0" * 64},
        {"actions_sha256": 5},
        {"actions_sha256": None},
        {"sampling": {"speed": 2}},
        {"sampling": []},
        {"options": []},
        {"options": {"speed": 2}},
        {"option_files": {"config": "0"}},
        {"option_files": {"tokenizer": 0}},
        {"made_with": []},
        {"observations": [[0]]},
        {"observations": []},
        {"observations": [[0, 0]] * 17},
        {"observations": [[0, -1]]},
        {"seed": -1},
        {"stride": 1.5},
        {"checkpoint": {}},
        {"recordings": "here"},
        {"equal_over_batches": "yes"},
        {"threads": "12"},
        {"threads": [1]},
        {"threads": [2, 2]},
        {"threads": [0, 1]},
        {"threads": None},
        {"from_float32": {"normalized": 1e999, "by_key": {}}},
        {"from_float32": {"normalized": -1, "by_key": {}}},
        {"from_float32": {"normalized": None, "by_key": {}}},
        {"from_float32": {"normalized": 0, "by_key": {"hand": "x"}}},
        {"from_float32": {"normalized": 0, "by_key": []}},
        {"format": 1},
    ],
    ids=str,
)
def test_a_damaged_certificate_is_named(
    wrong: dict[str, Any],
    certified: dict[str, dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "c.json"
    file.write_text(json.dumps({**certified["int8"], **wrong}))
    assert run("certify", file) == 2
    assert f"{file}: expected a certificate" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read as JSON"),
        (POINTER, "cannot be read as JSON: it is a Git LFS pointer"),
        ("[]", "expected a JSON object, got list"),
        ("null", "expected a JSON object, got NoneType"),
        ("{}", "expected a certificate"),
        ('{"format": 3}', "expected a certificate"),
        ('{"format": 2, "mse": 3}', "expected a certificate"),
    ],
)
def test_no_certificate_is_named(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "certificate.json"
    file.write_text(text)
    assert run("certify", file) == 2
    assert f"{file}: {message}" in capsys.readouterr().err
    assert run("certify", tmp_path / "none.json") == 2
    assert "none.json: no such file" in capsys.readouterr().err


def test_a_certificate_has_one_policy_in_memory(
    folder: Path, tmp_path: Path, held_at_loads: list[int]
) -> None:
    file = tmp_path / "certificate.json"
    command = ("evaluate", DEMO, folder, "--out", tmp_path / "out", *OPTIONS, "--precision", "int8")
    assert run(*command, "--certify", file) == 0
    assert held_at_loads == [0, 0, 0]  # with these options, with other threads, in float32


def test_the_page_is_drawn_before_the_certificate_is_computed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(certificate, "certify", stopped)
    drawn: list[Path] = []
    monkeypatch.setattr(recorded, "extension", lambda name: lambda *given: drawn.append(given[-1]))
    out = tmp_path / "out"
    run("evaluate", DEMO, folder, "--out", out, *OPTIONS, "--episodes", 1, "--certify", tmp_path / "c.json")
    assert drawn == [out]
    assert (out / "results.json").is_file()
