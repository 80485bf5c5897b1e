"""Training the backbone alone, and then heads on its frozen features."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from saccade import InputError
from saccade._internal.files import sha256_of
from saccade_lab.reference import Backbone
from saccade_lab.sim import demos
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.settings import TENSOR_FILE
from saccade_lab.sim.tasks import find_task
from saccade_lab.training import dataset, train
from saccade_lab.training.batches import prompts_of
from saccade_lab.training.dataset import load_samples
from saccade_lab.training.frames import padded
from saccade_lab.training.frozen import FrozenFeatures
from saccade_lab.training.inputs import prepared_inputs
from tests.helpers.training_cases import RECORDING, TASKS, TINY, ignore

BACKBONE = dataclasses.replace(TINY, only="backbone", steps=4, batch_size=4)
HEAD = dataclasses.replace(BACKBONE, only="head", absent_share=0.0, num_layers=3, seed=1)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demonstration of two tasks."""
    out = tmp_path_factory.mktemp("demos")
    demos.record_tasks(dict.fromkeys(TASKS, 1), out, RECORDING, lambda task: None)
    return out


@pytest.fixture(scope="module")
def pretrained(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A backbone that was trained alone."""
    out = tmp_path_factory.mktemp("backbone")
    train.train(recording, out, BACKBONE, ignore)
    return out


def test_the_backbone_alone_learns_positions_and_leaves_the_head(recording: Path, tmp_path: Path) -> None:
    settings = dataclasses.replace(BACKBONE, steps=40, learning_rate=5e-3)
    train.train(recording, tmp_path, settings, ignore)
    history = json.loads((tmp_path / "history.json").read_text())
    assert history[-1].keys() == {"step", "loss", "validation_loss"}
    config = train.policy_config(settings, RECORDING, TASKS)
    start = train.new_run(settings, config, {}).average
    changed = {
        name.split(".")[0]
        for name, tensor in load_file(tmp_path / "model.safetensors").items()
        if not torch.equal(tensor, start[name].to(torch.bfloat16))
    }
    assert changed == {"backbone"}
    # Positions are normalised: their mean has a squared error of 1.
    assert history[-1]["validation_loss"] < 0.9


def test_the_head_alone_leaves_the_backbone(recording: Path, pretrained: Path, tmp_path: Path) -> None:
    out = tmp_path / "heads" / "one"  # neither of which exists
    train.train(recording, out, HEAD, ignore, start=pretrained)
    before, after = (load_file(one / "model.safetensors") for one in (pretrained, out))
    config = train.policy_config(HEAD, RECORDING, TASKS)
    start = train.new_run(HEAD, config, {}).average
    for name, tensor in after.items():
        if name.startswith("backbone."):
            assert torch.equal(tensor, before[name]), name
    changed = [name for name in start if not torch.equal(start[name].to(torch.bfloat16), after[name])]
    assert any(name.startswith("action_head.future_tokens") for name in changed)
    assert Policy.from_pretrained(out).head.config.num_layers == 3


def test_features_are_those_of_the_backbone_and_are_shared(
    recording: Path, pretrained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train.train(recording, tmp_path / "one", HEAD, ignore, start=pretrained)
    files = sorted(tmp_path.glob("features-*.npy"))
    assert len(files) == 2
    # Frames are not read again: only their number counts now.
    monkeypatch.setattr(dataset, "prepared", None)
    written = [path.stat().st_mtime_ns for path in files]
    train.train(recording, tmp_path / "same", HEAD, ignore, start=pretrained)
    assert sha256_of(tmp_path / "same" / TENSOR_FILE) == sha256_of(tmp_path / "one" / TENSOR_FILE)
    aligned = dataclasses.replace(HEAD, alignment_weight=0.2)
    train.train(recording, tmp_path / "two", aligned, ignore, start=pretrained)
    assert [path.stat().st_mtime_ns for path in files] == written
    assert sorted(tmp_path.glob("features-*.npy")) == files
    assert json.loads((tmp_path / "two" / "history.json").read_text())[-1]["alignment_loss"] > 0


def test_features_of_a_frame_do_not_depend_on_its_batch(
    recording: Path, pretrained: Path, tmp_path: Path
) -> None:
    config = train.policy_config(HEAD, RECORDING, TASKS)
    processor = config.processor()
    samples, _ = load_samples(recording, TASKS, HEAD.horizon, processor)
    prompts = prompts_of(config, processor)
    backbone = Backbone.from_pretrained(pretrained)
    frozen = FrozenFeatures(samples, prompts, backbone, tmp_path / "features.npy")
    rows = np.array([3, 0, len(samples) - 1, 3])
    found = frozen(samples.now[rows])
    said = [prompts[samples.tasks[row]][samples.now[row] % 5] for row in rows]
    for number, row in enumerate(rows):
        images = torch.from_numpy(samples.images[samples.now[[row]]])
        with torch.no_grad():
            alone = backbone(prepared_inputs(backbone, images, [said[number]]))
        length = len(said[number])
        assert not found.attention_mask[number, :-length].any()
        assert found.attention_mask[number, -length:].all()
        torch.testing.assert_close(
            found.backbone_features[number, -length:], alone.backbone_features[0], rtol=1e-3, atol=2e-3
        )
        assert torch.equal(found.image_mask[number, -length:], alone.image_mask[0])
    assert found.image_mask.shape[1] == max(map(len, said))


def test_padded_to_a_length() -> None:
    ids, mask = padded([np.array([5, 6]), np.array([7])], 4)
    assert ids.tolist() == [[0, 0, 5, 6], [0, 0, 0, 7]]
    assert mask.tolist() == [[False, False, True, True], [False, False, False, True]]


def test_what_cannot_be_is_refused(recording: Path, pretrained: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="given 'vision', expected"):
        dataclasses.replace(HEAD, only="vision")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"absent_share: given 0\.1, expected 0"):
        dataclasses.replace(HEAD, absent_share=0.1)
    with pytest.raises(InputError, match=r"language_dropout: given 0\.2, expected 0"):
        dataclasses.replace(HEAD, language_dropout=0.2)
    with pytest.raises(InputError, match="start: given none"):
        train.train(recording, tmp_path / "out", HEAD, ignore)
    deeper = dataclasses.replace(HEAD, vision_layers=2)
    with pytest.raises(InputError, match="other sizes, tasks or cameras"):
        train.train(recording, tmp_path / "out", deeper, ignore, start=pretrained)
    assert not (tmp_path / "out").exists()


def test_a_head_of_another_width(recording: Path, pretrained: Path, tmp_path: Path) -> None:
    """Its VL self-attention stays as wide as the features; the engine computes what the reference does."""
    wider = dataclasses.replace(HEAD, width=24, language_width=16)
    train.train(recording, tmp_path / "wide", wider, ignore, start=pretrained)
    config = Policy.from_pretrained(tmp_path / "wide").head.config
    assert (config.width, config.context_dim) == (24, 16)
    seen = {}
    for engine in ("rust", "torch"):
        policy = Policy.from_pretrained(tmp_path / "wide", engine=engine)
        noise = policy.noise(np.random.default_rng(0))
        seen[engine] = policy.act(policy.blank("reach"), noise=noise).actions
    np.testing.assert_allclose(seen["rust"], seen["torch"], atol=1e-4)
    with pytest.raises(InputError, match="other sizes, tasks or cameras"):
        train.train(
            recording, tmp_path / "out", dataclasses.replace(HEAD, width=24), ignore, start=pretrained
        )
    with pytest.raises(InputError, match="language_width: given 15, expected a multiple of 4"):
        dataclasses.replace(HEAD, language_width=15)
    with pytest.raises(InputError, match="language_width: given -4, expected at least 0"):
        dataclasses.replace(HEAD, language_width=-4)


def test_a_blind_head_sees_black(recording: Path, pretrained: Path, tmp_path: Path) -> None:
    train.train(recording, tmp_path / "one", HEAD, ignore, start=pretrained)
    train.train(recording, tmp_path / "two", dataclasses.replace(HEAD, blind=True), ignore, start=pretrained)
    files = sorted(tmp_path.glob("features-*training*.npy"))
    assert [path.stem.split("-", 3)[3] for path in files] == ["training-blind", "training"]
    blind, seeing = (np.load(path) for path in files)
    # All frames of a task that have the same wording have the same features, which is what a policy sees of
    # cameras that are blanked.
    assert len(np.unique(blind, axis=0)) <= 10 < len(np.unique(seeing, axis=0))
    policy = Policy.from_pretrained(tmp_path / "two")
    black = policy.features(policy.blank(find_task("reach").instructions[0]))[0]
    assert any(np.allclose(row[-len(black) :], black, rtol=1e-3, atol=5e-3) for row in blind)
