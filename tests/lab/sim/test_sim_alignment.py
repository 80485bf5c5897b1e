"""Training with alignment: future rows that are drawn towards what the policy sees later."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from saccade import InputError
from saccade.cli import main
from saccade_lab.reference.backbone import PreparedInputs
from saccade_lab.training import train
from saccade_lab.training.learner import Learner, new_learner, pool_tokens
from saccade_lab.training.settings import TrainingSettings
from tests.helpers.training_cases import ALIGNED, TINY, ignore, make_batches, recorded


@pytest.fixture
def recording() -> Path:
    """Two demonstrations of two tasks."""
    return recorded()


def test_who_is_told_to_stand_still_sees_the_same_later(recording: Path) -> None:
    _, batches = make_batches(recording, dataclasses.replace(ALIGNED, absent_share=1.0))
    batch = batches.draw(0)
    assert isinstance(batch.inputs, PreparedInputs)
    assert isinstance(batch.later, PreparedInputs)
    assert torch.equal(batch.later.pixels[0], batch.inputs.pixels[0])
    _, batches = make_batches(recording, dataclasses.replace(ALIGNED, batch_size=8))
    batch = batches.draw(0)
    assert isinstance(batch.inputs, PreparedInputs)
    assert isinstance(batch.later, PreparedInputs)
    assert not torch.equal(batch.later.pixels[0], batch.inputs.pixels[0])


def test_pooling_means_runs_of_neighbours() -> None:
    tokens = torch.randn(2, 7, 5, generator=torch.Generator().manual_seed(0))
    for count in (1, 3, 7):
        runs = [
            tokens[:, i * 7 // count : -(-(i + 1) * 7 // count)].mean(dim=1) for i in range(count)
        ]  # the bounds that torch documents
        torch.testing.assert_close(pool_tokens(tokens, count), torch.stack(runs, dim=1))
    assert pool_tokens(tokens, 9).shape == (2, 9, 5)


def test_alignment_loss_is_one_minus_the_cosine_of_the_future_rows(recording: Path) -> None:
    run, batches = make_batches(recording, dataclasses.replace(ALIGNED, batch_size=3))
    with torch.no_grad():
        for tensor in run.average.values():  # so that the averaged backbone is not the current one
            tensor.add_(0.05 * torch.randn(tensor.shape, generator=torch.Generator().manual_seed(1)))
    batch = batches.draw(0)
    rows: list[torch.Tensor] = []
    handle = run.learner.action_head.model.transformer_blocks[0].register_forward_hook(
        lambda module, inputs, output: rows.append(output)
    )
    noise, time = run.learner.draw_noise(batch, torch.Generator().manual_seed(0))
    losses = run.learner.losses(batch, noise, time, run.average)
    handle.remove()
    losses["alignment_loss"].backward()

    other = Learner(run.config.backbone_sizes, run.config.head_config)
    other.load_state_dict(run.average, strict=False)
    with torch.no_grad():
        assert batch.later is not None
        seen = other.backbone(batch.later)
        image_tokens = seen.backbone_features[seen.image_mask].reshape(3, -1, TINY.width)
        projected = run.learner.projector(rows[0][:, 1:4])
        targets = F.adaptive_avg_pool1d(image_tokens.mT, 3).mT
        cosines = (projected * targets).sum(-1) / (projected.norm(dim=-1) * targets.norm(dim=-1))
    assert cosines.shape == (3, 3)
    torch.testing.assert_close(losses["alignment_loss"].detach(), 1 - cosines.mean())

    tokens = run.learner.action_head.future_tokens.weight
    assert tokens.grad is not None
    assert bool((tokens.grad.abs().sum(dim=1) > 0).all())
    decoder = run.learner.action_head.get_submodule("action_decoder")
    # Only the first block comes before the rows, and the targets' side must not move.
    assert all(parameter.grad is None for parameter in decoder.parameters())
    assert all(tensor.grad is None and not tensor.requires_grad for tensor in run.average.values())


def test_alignment_loss_falls_and_is_reported(recording: Path, tmp_path: Path) -> None:
    settings = dataclasses.replace(ALIGNED, steps=40, batch_size=4, learning_rate=5e-3)
    torch.set_num_threads(1)
    run, batches = make_batches(recording, settings)
    first = train.validation_losses(run, batches)["alignment_loss"]
    train.train(recording, tmp_path, settings, ignore)
    last = json.loads((tmp_path / "history.json").read_text())[-1]
    assert last["validation_alignment_loss"] < 0.7 * first
    assert last["alignment_loss"] < first
    state = torch.load(tmp_path / "training.pt", weights_only=True)["learner"]
    assert any(name.startswith("projector.") for name in state)
    stored = load_file(tmp_path / "model.safetensors")
    assert {name.split(".")[0] for name in stored} == {"backbone", "action_head"}


def test_alignment_block_is_the_middle_one_or_as_said() -> None:
    found = [TrainingSettings(num_layers=n, alignment_weight=1).aligned_block for n in (1, 2, 4, 16)]
    assert found == [0, 0, 1, 7]
    assert TrainingSettings(alignment_weight=1, alignment_block=3).aligned_block == 3
    assert TrainingSettings(alignment_block=3).aligned_block is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_future_tokens": 0, "alignment_weight": 0.2}, "expected 0 with num_future_tokens 0"),
        ({"alignment_weight": -0.1}, "given -0.1, expected at least 0"),
        ({"alignment_weight": float("nan")}, "given nan"),
        ({"alignment_weight": 0.2, "alignment_block": 4}, "given 4, expected 0 to 3"),
    ],
)
def test_alignment_that_cannot_be_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrainingSettings(**wrong)


def test_without_alignment_steps_are_those_of_the_two_losses(recording: Path) -> None:
    """Bit for bit, against the steps written out here: nothing of the alignment may take part."""
    torch.set_num_threads(1)
    settings = dataclasses.replace(TINY, absent_share=0.5)
    run, batches = make_batches(recording, settings, with_later=False)
    assert not any(name.startswith("projector") for name in run.learner.state_dict())
    other, _ = make_batches(recording, ALIGNED)  # the same start, with and without
    for name, tensor in run.learner.state_dict().items():
        assert torch.equal(tensor, other.learner.state_dict()[name]), name

    learner = new_learner(settings, run.config)
    optimizer = torch.optim.AdamW(
        [
            {"params": [p for p in learner.parameters() if p.ndim >= 2], "weight_decay": 0.01},
            {"params": [p for p in learner.parameters() if p.ndim < 2], "weight_decay": 0.0},
        ],
        betas=(0.9, 0.95),
    )
    for step in range(3):
        batch = batches.draw(settings.seed, step)
        found = train.train_step(run, batch)
        assert found.keys() == {"loss", "target_loss"}
        assert batch.later is None
        for group in optimizer.param_groups:
            group["lr"] = train.learning_rate(settings, step)
        seed = np.random.default_rng((settings.seed, step, 1)).integers(2**63)
        generator = torch.Generator().manual_seed(int(seed))
        features = learner.backbone(batch.inputs).backbone_features
        noise = torch.randn(batch.actions.shape, generator=generator)
        time = learner.action_head.sample_time(len(noise), generator)
        flow = learner.action_head.loss(
            features,
            batch.state,
            0,
            batch.actions,
            noise=noise,
            time=time,
            action_mask=batch.mask,
            drop_vl=~batch.inputs.attention_mask,
        )
        positions = F.mse_loss(learner.target_head(features[:, -1]), batch.targets)
        optimizer.zero_grad()
        (flow + settings.target_weight * positions).backward()
        torch.nn.utils.clip_grad_norm_(learner.parameters(), 1.0)
        optimizer.step()
        assert found == {"loss": flow.item(), "target_loss": positions.item()}
    for name, tensor in learner.state_dict().items():
        assert torch.equal(tensor, run.learner.state_dict()[name]), name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--alignment-weight", "0.2", "--num-future-tokens", "0"], "there is no row to align"),
        (["--alignment-weight", "-1"], "--alignment-weight: given -1.0, expected at least 0"),
        (["--alignment-weight", "inf"], "--alignment-weight: given inf"),
    ],
)
def test_the_command_refuses_alignment_that_cannot_be(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    out = tmp_path / "out"
    assert main(["train", "--demos", str(recording), "--out", str(out), *options]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()
