"""`saccade verify`: what is whole passes, and what is damaged is named."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import saccade
from saccade import cli
from saccade.checkpoints import convert, describe, quantize, verify
from saccade.checkpoints.finite import count_not_finite
from saccade.checkpoints.precisions import PRECISIONS
from saccade.checkpoints.verification import TOLERANCE
from saccade.cli.verify import without_folder
from saccade.errors import CheckpointError, InputError, MissingExtraError
from saccade_lab.against_reference import reference
from saccade_lab.random_checkpoint.whole import small_backbone, small_head, write
from tests.helpers import layouts
from tests.helpers.whole_checkpoints import EMBODIMENT, LAYOUTS, whole

HEAD = "action_head.model.transformer_blocks.0.attn1.to_q.weight"
BACKBONE = "backbone.eagle_model.language_model.model.layers.0.mlp.up_proj.weight"


def damaged(folder: Path, change: Callable[[dict[str, torch.Tensor]], None]) -> Path:
    """A copy of the bundled policy with other tensors."""
    shutil.copytree(saccade.demo_checkpoint(), folder)
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors")
    return folder


@pytest.mark.parametrize("layout", LAYOUTS)
def test_whole_checkpoints_of_every_layout_pass(layout: str) -> None:
    found = verify(whole(layout), embodiment=EMBODIMENT if layout in ("n16", "n17") else None)
    assert (found.verdict, found.problems, found.refused) == ("passed", [], None)
    assert found.part == "policy"
    assert [run.name for run in found.runs] == list(PRECISIONS)
    names = {name for path in whole(layout).glob("model*.safetensors") for name in load_file(path)}
    assert sum(part.count for part in found.tensors.values()) == len(names)
    assert set(found.tensors) == {"head", "backbone"}
    assert found.runs[0].difference is None
    for run in found.runs[1:]:
        assert run.difference is not None
        assert 0 < run.difference.worst < 0.5


def test_values_of_int4_are_counted_not_their_bytes(tmp_path: Path) -> None:
    counts = {}
    for to in ("int8", "int4"):
        quantize(saccade.demo_checkpoint(), tmp_path / to, to=to)
        counts[to] = {name: part.parameters for name, part in verify(tmp_path / to).tensors.items()}
    # The token embeddings, which are int8 with int4 alone, have scales.
    (num_embeddings,) = (
        tensor.shape[0]
        for tensor in describe(saccade.demo_checkpoint()).tensors
        if tensor.name.endswith("embed_tokens.weight")
    )
    counts["int8"]["backbone"] += num_embeddings
    assert counts["int4"] == counts["int8"]


@pytest.mark.parametrize("version", ["n1.5", "n1.6", "n1.7"])
def test_random_checkpoints_agree_with_the_reference(version: str, tmp_path: Path) -> None:
    write(tmp_path / "random", version, backbone=small_backbone(version), head=small_head(version), seed=1)
    found = verify(tmp_path / "random", reference=reference)
    assert found.verdict == "passed"
    assert found.reference is not None
    assert 0 < found.reference["of range"] < 1e-5


@pytest.mark.parametrize("layout", ["saccade", "n1", "fork"])
def test_a_head_alone_is_run_on_random_features(layout: str, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / layout, layout)
    if layout != "saccade":
        convert(source, tmp_path / "head", head_only=True)
        source = tmp_path / "head"
    found = verify(source)
    assert (found.verdict, found.part) == ("passed", "head")
    assert list(found.tensors) == ["head"]
    heads = dict.fromkeys(precision["head"] for precision in PRECISIONS.values())
    assert [run.name for run in found.runs] == list(heads)


def test_a_policy_that_is_refused_says_why_and_runs_its_head() -> None:
    found = verify(whole("n17"), embodiment="no_such_robot")
    assert (found.verdict, found.part) == ("incomplete", "head")
    assert found.refused is not None
    assert "no_such_robot" in found.refused
    assert len(found.runs) >= 3


def remove(name: str) -> Callable[[dict[str, torch.Tensor]], None]:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        del tensors[name]

    return change


def put(name: str, make: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[dict[str, torch.Tensor]], None]:
    return lambda tensors: tensors.update({name: make(tensors[name]).contiguous()})


def with_nan(tensor: torch.Tensor) -> torch.Tensor:
    tensor = tensor.clone()
    tensor[0, :2] = torch.tensor([float("nan"), float("-inf")])
    return tensor


DAMAGES: Mapping[str, tuple[Callable[[dict[str, torch.Tensor]], None], str]] = {
    "missing in the head": (remove(HEAD), "transformer_blocks.0.attn1.to_q.weight"),
    "missing in the backbone": (remove(BACKBONE), "layers.0.mlp.up_proj.weight"),
    "shape in the head": (put(HEAD, lambda tensor: tensor[:-1]), "expected"),
    "shape in the backbone": (put(BACKBONE, lambda tensor: tensor[:-1]), "expected"),
    "type in the head": (put(HEAD, lambda tensor: tensor.double()), "F64, expected F32, BF16 or F16"),
    "type in the backbone": (put(BACKBONE, lambda tensor: tensor.to(torch.int32)), "I32, expected F32"),
    "NaN in the head": (put(HEAD, with_nan), f"{HEAD}: 2 of 16384 values are NaN or infinite"),
    "NaN in the backbone": (put(BACKBONE, with_nan), f"{BACKBONE}: 2 of 32768 values are NaN or infinite"),
    "unknown in the head": (
        lambda tensors: tensors.update({"action_head.extra": torch.zeros(2)}),
        "extra is unknown",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_named(damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, message = DAMAGES[damage]
    folder = damaged(tmp_path / "policy", change)
    found = verify(folder)
    assert found.verdict == "failed"
    assert any(message in problem for problem in found.problems), found.problems
    assert found.runs == []
    assert cli.main(["verify", str(folder)]) == 1
    out = capsys.readouterr().out
    assert message in out
    assert "verdict     FAILED" in out
    assert str(tmp_path) not in out


def test_all_damage_is_listed_at_once(tmp_path: Path) -> None:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        for name in ("missing in the head", "missing in the backbone"):
            DAMAGES[name][0](tensors)
        tensors["action_head.vlln.weight"][0] = float("inf")

    problems = "\n".join(verify(damaged(tmp_path / "policy", change)).problems)
    for name in ("attn1.to_q.weight", "mlp.up_proj.weight", "action_head.vlln.weight: 1 of 128"):
        assert name in problems


def test_a_file_that_is_cut_off_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "policy"
    shutil.copytree(saccade.demo_checkpoint(), folder)
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-5])
    found = verify(folder)
    assert (found.verdict, found.version, found.runs) == ("failed", None, [])
    assert "model.safetensors" in found.problems[0]


def test_tensors_that_belong_to_nothing_are_counted(tmp_path: Path) -> None:
    folder = damaged(tmp_path / "policy", lambda tensors: tensors.update(other=torch.zeros(3)))
    found = verify(folder)
    assert found.tensors["neither"].count == 1
    assert found.verdict == "passed"


def test_a_difference_from_the_reference_fails() -> None:
    def far(policy: Any, observation: Any, noise: Any) -> Callable[[], dict[str, float]]:
        assert policy.head.precision == "float32"
        return lambda: {"of range": 2 * TOLERANCE}

    found = verify(saccade.demo_checkpoint(), reference=far)
    assert found.verdict == "failed"
    assert "differs from the reference by 2.0e-03" in found.problems[0]
    nan = verify(saccade.demo_checkpoint(), reference=lambda *_: lambda: {"of range": float("nan")})
    assert nan.verdict == "failed"


def test_a_head_alone_cannot_be_compared_with_the_reference(tmp_path: Path) -> None:
    convert(saccade.demo_checkpoint(), tmp_path / "head", head_only=True)
    found = verify(tmp_path / "head", reference=reference)
    assert (found.verdict, found.part, found.problems) == ("incomplete", "head", [])
    assert found.refused is not None
    assert "no backbone" in found.refused


def test_a_reference_without_its_packages_is_not_a_refused_policy() -> None:
    def lacks(policy: Any, observation: Any, noise: Any) -> Callable[[], dict[str, float]]:
        raise MissingExtraError("torch is not installed", name="torch")

    with pytest.raises(MissingExtraError, match="torch is not installed"):
        verify(saccade.demo_checkpoint(), reference=lacks)


def test_the_robot_of_a_head_alone_is_never_another_than_the_given_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "head"
    convert(whole("n17"), source, head_only=True)
    found = verify(source, embodiment=EMBODIMENT)
    expected = saccade.robots.Normalizer.from_pretrained(source, EMBODIMENT).embodiment_id
    assert (found.verdict, found.robot) == ("passed", str(expected))
    assert verify(source, embodiment=3).robot == "3"
    with pytest.raises(
        InputError, match=f"no id of 'no_such_robot', expected an id or one of .*{EMBODIMENT}"
    ):
        verify(source, embodiment="no_such_robot")
    assert cli.main(["verify", str(source), "--embodiment", "3"]) == 0
    assert "the head alone, as embodiment 3, on random features" in capsys.readouterr().out


@pytest.mark.parametrize("kept", [True, False])
def test_weights_too_large_for_the_arithmetic_are_named_at_each_precision(kept: bool, tmp_path: Path) -> None:
    def large(tensors: dict[str, torch.Tensor]) -> None:
        tensors[HEAD] = tensors[HEAD] * 1e38
        for name in [name for name in tensors if not kept and name.startswith("backbone.")]:
            del tensors[name]

    found = verify(damaged(tmp_path / "policy", large))
    assert (found.verdict, found.refused, found.part) == ("failed", None, "policy" if kept else "head")
    assert found.problems[0].startswith("float32: actions: the result is not finite")
    assert len(found.runs) == len(PRECISIONS) if kept else len(found.runs) >= 3


def test_what_fails_at_one_precision_keeps_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    load = saccade.Policy.from_pretrained.__func__  # type: ignore[attr-defined]

    def refusing(cls: Any, /, source: Any, **options: Any) -> Any:
        if options["precision"] == PRECISIONS["int8"]:
            raise CheckpointError("a weight is too large\nfor int8")
        return load(cls, source, **options)

    monkeypatch.setattr(saccade.Policy, "from_pretrained", classmethod(refusing))
    found = verify(saccade.demo_checkpoint())
    assert found.problems == ["int8: a weight is too large; for int8"]
    assert (found.part, found.refused, len(found.runs)) == ("policy", None, len(PRECISIONS))


def test_the_report_names_neither_the_folders_above_nor_the_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", f"{os.sep}home{os.sep}me")
    monkeypatch.setenv("USERPROFILE", f"{os.sep}home{os.sep}me")
    home, source = Path(os.sep) / "home" / "me", Path("o") / "p"
    text = f"{home / 'tokenizer.json'}: broken; {source / 'config.json'}: cut off; neuro{os.sep}GR00T"
    wanted = (
        f"{Path('~') / 'tokenizer.json'}: broken; {Path('p') / 'config.json'}: cut off; neuro{os.sep}GR00T"
    )
    assert without_folder(text, source) == wanted


def test_actions_that_are_not_finite_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    act = saccade.Policy.act

    def broken(self: saccade.Policy, *args: Any, **options: Any) -> Any:
        chunk = act(self, *args, **options)
        chunk["hand"][0, 3, 1] = np.inf
        return chunk

    monkeypatch.setattr(saccade.Policy, "act", broken)
    found = verify(saccade.demo_checkpoint())
    assert found.verdict == "failed"
    assert "float32: NaN or infinity in the actions of hand" in found.problems


def test_too_little_memory_for_one_precision_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    load = saccade.Policy.from_pretrained.__func__  # type: ignore[attr-defined]

    def small(cls: Any, /, source: Any, **options: Any) -> Any:
        if options["precision"]["head"] == "bfloat16" == options["precision"]["backbone"]:
            raise MemoryError("Unable to allocate 48 GiB")
        return load(cls, source, **options)

    monkeypatch.setattr(saccade.Policy, "from_pretrained", classmethod(small))
    found = verify(saccade.demo_checkpoint())
    assert found.problems == ["bfloat16: too large for this machine's memory: Unable to allocate 48 GiB"]
    assert [run.problem is None for run in found.runs] == [True, False, *[True] * (len(PRECISIONS) - 2)]


def test_it_prints_a_report_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    demo = str(saccade.demo_checkpoint())
    assert cli.main(["verify", demo]) == 0
    out = capsys.readouterr().out
    for text in ("GR00T N1.5, nvidia", "head 98", "backbone 79", "metaworld_sawyer", "verdict     passed"):
        assert text in out
    assert all(f"\n{name} " in out for name in PRECISIONS)
    assert str(Path(demo).parent) not in out
    assert cli.main(["verify", demo, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "passed"
    assert [run["name"] for run in found["runs"]] == list(PRECISIONS)
    assert found["machine"]["saccade"] == saccade.__version__
    assert found["peak_memory"] > 1e7


def test_no_checkpoint_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", str(tmp_path / "nowhere")]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_the_reference_needs_the_lab(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("saccade.cli.verify.extension", lambda name: None)
    assert cli.main(["verify", str(saccade.demo_checkpoint()), "--reference"]) == 2
    assert "--reference: needs saccade-vla-lab" in capsys.readouterr().err


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
def test_values_that_are_not_finite_are_counted(
    dtype: torch.dtype, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("saccade.checkpoints.finite.PIECE", 48)
    rng = torch.Generator().manual_seed(0)
    values = torch.randn(7, 11, generator=rng, dtype=torch.float64).to(dtype)
    values[0, 0] = torch.finfo(dtype).max
    values[1, 1] = torch.finfo(dtype).tiny
    spoiled = values.clone()
    spoiled[3, 4], spoiled[6, 10] = float("nan"), float("-inf")
    save_file({"a": values, "b": spoiled, "c": torch.ones(3, dtype=torch.int8)}, tmp_path / "x.safetensors")
    assert count_not_finite([tmp_path / "x.safetensors"]) == {"b": (2, 77)}


def test_a_file_that_is_cut_off_while_it_is_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    save_file({"a": torch.ones(7, 11)}, path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(CheckpointError, match="ends within a, 7 bytes too early"):
        count_not_finite([path])
