"""Training on tiny settings: resumable, and the same as if never stopped."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from saccade import CheckpointError, InputError
from saccade.backbone.inputs import BackboneInputs
from saccade_lab.reference.backbone import PreparedInputs
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy
from saccade_lab.training import train
from saccade_lab.training.learner import Learner
from saccade_lab.training.settings import TrainingSettings
from tests.helpers.training_cases import ALIGNED, RECORDING, TASKS, TINY, ignore, make_batches, recorded


@pytest.fixture
def recording() -> Path:
    """Two demonstrations of two tasks."""
    return recorded()


@pytest.mark.parametrize(
    "settings",
    [TINY, ALIGNED, dataclasses.replace(TINY, dtype="bfloat16")],
    ids=["plain", "aligned", "bfloat16"],
)
def test_training_resumes_to_the_same_weights(
    recording: Path, tmp_path: Path, settings: TrainingSettings
) -> None:
    def interrupt(progress: train.Progress) -> None:
        if progress.step == 3:
            raise KeyboardInterrupt

    torch.set_num_threads(1)
    train.train(recording, tmp_path / "whole", settings, ignore)
    with pytest.raises(KeyboardInterrupt):
        train.train(recording, tmp_path / "parts", settings, interrupt)
    stopped = load_file(tmp_path / "parts" / "model.safetensors")
    train.train(recording, tmp_path / "parts", settings, ignore)
    whole, parts = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    for name, tensor in whole.items():
        assert tensor.dtype == torch.bfloat16
        assert torch.equal(tensor, parts[name]), name
    assert any(not torch.equal(stopped[name], whole[name]) for name in whole)
    ends = [torch.load(tmp_path / name / "training.pt", weights_only=True) for name in ("whole", "parts")]
    for name, tensor in ends[0]["learner"].items():  # including what is trained besides the policy
        assert torch.equal(tensor, ends[1]["learner"][name]), name


def test_bfloat16_is_near_float32_and_keeps_weights_wide(recording: Path) -> None:
    torch.set_num_threads(1)
    found = {}
    for dtype in ("float32", "bfloat16"):
        run, batches = make_batches(recording, dataclasses.replace(TINY, dtype=dtype), with_later=False)
        found[dtype] = [train.train_step(run, batches.draw(0, step))["loss"] for step in range(3)]
        for one in (*run.learner.parameters(), *run.average.values()):
            assert one.dtype == torch.float32
            assert one.grad is None or one.grad.dtype == torch.float32
    assert found["bfloat16"] != found["float32"]
    np.testing.assert_allclose(found["bfloat16"], found["float32"], rtol=0.02)


def test_bfloat16_on_another_device_than_a_cpu_is_refused(recording: Path, tmp_path: Path) -> None:
    settings = dataclasses.replace(TINY, dtype="bfloat16")
    with pytest.raises(InputError, match="dtype: given 'bfloat16' with device 'cuda', expected 'float32'"):
        train.train(recording, tmp_path, settings, ignore, device="cuda")
    assert not list(tmp_path.iterdir())


def test_the_followed_tensors_stay_those_of_the_learner(recording: Path, tmp_path: Path) -> None:
    run, batches = make_batches(recording, TINY, with_later=False)
    train.train_step(run, batches.draw(TINY.seed, 0))
    train.validation_losses(run, batches)
    train.save(run, tmp_path)
    train.start_from(run, tmp_path)
    train.resume(run, tmp_path / "training.pt")
    parameters = dict(run.learner.named_parameters())
    assert run.tensors.keys() == run.average.keys()
    for name, tensor in run.tensors.items():
        assert tensor.data_ptr() == parameters[name].data_ptr(), name
        assert tensor.data_ptr() != run.average[name].data_ptr(), name


def test_training_leaves_a_policy_both_engines_run(recording: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    train.train(recording, tmp_path, TINY, ignore)
    assert {path.name for path in tmp_path.iterdir()} == {
        "config.json",
        "experiment_cfg",
        "model.safetensors",
        "tokenizer.json",
        "training.pt",
        "settings.json",
        "history.json",
        "loss.png",
    }
    history = json.loads((tmp_path / "history.json").read_text())
    assert history[-1]["step"] == TINY.steps
    settings = json.loads((tmp_path / "settings.json").read_text())
    assert settings.pop("demonstrations")["tasks"] == dict.fromkeys(TASKS, 2)
    assert TrainingSettings(**settings) == TINY
    rust, other = (
        Policy.from_pretrained(tmp_path, engine=engine, num_threads=1) for engine in ("rust", "torch")
    )
    assert rust.config.tasks == tuple(TASKS)
    images = {
        camera.name: np.full((16, 16, 3), 30 * number, np.uint8)
        for number, camera in enumerate(RECORDING.cameras)
    }
    observation = {"images": images, "proprio": np.zeros(4), "instruction": "press the button"}
    noise = rust.noise(np.random.default_rng(0))
    np.testing.assert_allclose(
        rust.act(observation, noise=noise).actions, other.act(observation, noise=noise).actions, atol=1e-4
    )


def test_padding_changes_no_gradient(recording: Path) -> None:
    """Prompts of different lengths in a batch train as they do alone, which is how they are run."""
    run, batches = make_batches(recording, dataclasses.replace(TINY, batch_size=6), with_later=False)
    run.learner.double()
    batch = batches.draw(0)
    assert isinstance(batch.inputs, PreparedInputs)
    lengths = batch.inputs.attention_mask.sum(dim=1).tolist()
    assert len(set(lengths)) > 1
    features = run.learner.backbone(batch.inputs).backbone_features
    views = len(RECORDING.cameras)
    for row, length in enumerate(lengths):
        (pixels,) = batch.inputs.pixels
        alone = BackboneInputs(
            pixels[row * views : (row + 1) * views], batch.inputs.input_ids[row : row + 1, -length:]
        )
        expected = run.learner.backbone(alone).backbone_features[0]
        torch.testing.assert_close(features[row, -length:], expected)


def test_a_run_with_other_settings_is_refused(recording: Path, tmp_path: Path) -> None:
    train.train(recording, tmp_path, TINY, ignore)
    before = {path.name: path.read_bytes() for path in tmp_path.rglob("*.*")}
    other = TrainingSettings(**{**vars(TINY), "seed": 1, "batch_size": 3})
    with pytest.raises(InputError, match=r"other settings \(batch_size, seed\)"):
        train.train(recording, tmp_path, other, ignore)
    assert {path.name: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.parametrize("size", [0, 7])
def test_patches_that_cannot_be_halved_are_refused(size: int) -> None:
    with pytest.raises(InputError, match=f"patch_size: given {size}, expected an even number"):
        TrainingSettings(patch_size=size)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 12}, "width: given 12, expected a multiple of 8"),
        ({"num_heads": 3, "width": 96}, "num_heads: given 3, expected 1 or an even number"),
        ({"vision_width": 100}, "vision_width: given 100, expected a multiple of vision_heads 3"),
    ],
)
def test_sizes_that_cannot_be_loaded_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrainingSettings(**wrong)


@pytest.mark.parametrize(("size", "patch", "view"), [(68, 16, 64), (64, 16, 64), (64, 8, 64), (16, 32, 32)])
def test_the_tower_sees_whole_patches(size: int, patch: int, view: int) -> None:
    """Preprocessing crops to 95 % and resizes to the nearest size that patches divide."""
    settings = dataclasses.replace(TINY, patch_size=patch)
    config = train.policy_config(settings, dataclasses.replace(RECORDING, image_size=size), TASKS)
    assert config.processor().image_size == view
    assert config.processor().tokens_per_view == (view // patch) ** 2


def test_learning_rate_warms_up_and_falls_to_zero() -> None:
    settings = TrainingSettings(steps=1000)
    rates = [train.learning_rate(settings, step) for step in range(1000)]
    assert rates[0] < 0.01 * settings.learning_rate
    assert max(rates) <= settings.learning_rate
    assert np.argmax(rates) == train.WARMUP_STEPS - 1
    assert rates[-1] < 1e-4 * settings.learning_rate


def test_training_starts_from_a_policy(recording: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train.train(recording, first, TINY, ignore)
    settings = TrainingSettings(**{**vars(TINY), "steps": 2, "learning_rate": 1e-9, "absent_share": 0.5})
    train.train(recording, second, settings, ignore, start=first)
    tensors = load_file(second / "model.safetensors")
    for name, tensor in load_file(first / "model.safetensors").items():
        torch.testing.assert_close(tensors[name], tensor)
    with pytest.raises(InputError, match=r"other settings \(start_sha256\)"):
        train.train(recording, second, settings, ignore)


def test_a_policy_of_other_sizes_cannot_be_started_from(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="other sizes, tasks or cameras"):
        train.train(recording, tmp_path / "out", TINY, ignore, start=DEMO_CHECKPOINT)
    with pytest.raises(FileNotFoundError):
        train.train(recording, tmp_path / "out", TINY, ignore, start=tmp_path / "nowhere")
    start = tmp_path / "start"
    shutil.copytree(DEMO_CHECKPOINT, start)
    (start / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"start/config.json: cannot be read as JSON"):
        train.train(recording, tmp_path / "out", TINY, ignore, start=start)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_runs_of_one_seed_differ_in_their_tokens_only(weight: float) -> None:
    def initial(count: int, seed: int = 5) -> dict[str, torch.Tensor]:
        settings = dataclasses.replace(
            TINY, num_future_tokens=count, seed=seed, alignment_weight=weight if count else 0.0
        )
        run = train.new_run(settings, train.policy_config(settings, RECORDING, TASKS), {})
        assert all(torch.equal(run.average[name], run.learner.state_dict()[name]) for name in run.average)
        return run.learner.state_dict()

    tokens = "action_head.future_tokens.weight"
    settings = dataclasses.replace(TINY, num_future_tokens=32, seed=5, alignment_weight=weight)
    config = train.policy_config(settings, RECORDING, TASKS)
    torch.manual_seed(5)
    shared = Learner(config.backbone_sizes, config.head_config, settings.aligned_block).state_dict()
    for count in (0, 1, 4, 32, 33, 64):
        found = initial(count)
        assert found[tokens].shape == (count, TINY.width)
        assert torch.equal(found[tokens][:32], shared[tokens][:count])
        for name in found.keys() - {tokens}:
            assert torch.equal(found[name], shared[name]), (count, name)
        assert found.keys() == {name for name in shared if count or not name.startswith("projector.")}
    rows = initial(64)[tokens]
    assert torch.equal(initial(40)[tokens], rows[:40])
    assert len(torch.unique(rows, dim=0)) == 64
    assert 0.015 < float(rows[32:].std()) < 0.025
    assert not torch.equal(initial(64, seed=6)[tokens][32:], rows[32:])
