"""The reference and the Rust head against the released code itself, at the released widths.

lerobot is installed by the test set-up without its dependencies; if it is missing, these tests fail.
Tables differ: the released code calls torch's float32 sin and cos, so up to 2e-4 may come from them alone.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from reference_cases import relative_error, small_config
from released import Released
from torch import Tensor, nn

import saccade
from saccade.reference import ActionHead, lerobot_head
from saccade.reference.random_weights import n15_config, random_head, random_inputs, write_checkpoint

TOLERANCE = 3e-4
WIDE_CONFIG = n15_config(num_layers=2, vl_num_layers=1, num_embodiments=3)
INPUTS = ("backbone_features", "state", "embodiment_id", "noise")


@pytest.fixture(scope="module")
def wide() -> tuple[ActionHead, nn.Module, dict[str, Tensor]]:
    """Both heads at N1.5's widths with fewer blocks and embodiments, equal weights, one view's tokens."""
    head = random_head(WIDE_CONFIG, seed=0)
    theirs = lerobot_head.build(WIDE_CONFIG)
    theirs.load_state_dict(head.state_dict(), strict=True, assign=True)
    return head, theirs, random_inputs(head.config, seed=1, batch=1, num_vl_tokens=296)


def their_actions(theirs: nn.Module, inputs: dict[str, Tensor]) -> Tensor:
    return lerobot_head.get_action(
        theirs, inputs["backbone_features"], inputs["state"], inputs["embodiment_id"], inputs["noise"]
    )


def test_reference_equals_lerobot_at_full_width(
    wide: tuple[ActionHead, nn.Module, dict[str, Tensor]],
) -> None:
    head, theirs, inputs = wide
    with torch.no_grad():
        ours = head(**inputs)
    expected = their_actions(theirs, inputs)
    assert expected.std() > 0.5
    assert (ours - expected).abs().max() <= TOLERANCE


def test_lerobot_reproduces_the_recorded_outputs(released: Released) -> None:
    """Guards the recorded outputs: a changed file, or a wrong set-up of lerobot, shows here."""
    theirs = lerobot_head.build(released.config)
    theirs.load_state_dict(ActionHead.load(released.path).state_dict(), strict=True)
    inputs = {name: torch.tensor(getattr(released, name)) for name in INPUTS}
    assert np.abs(their_actions(theirs, inputs).numpy() - released.actions_f64).max() <= TOLERANCE


def test_rust_equals_lerobot_at_full_width(
    wide: tuple[ActionHead, nn.Module, dict[str, Tensor]], isa: str, tmp_path: Path
) -> None:
    reference, theirs, inputs = wide
    write_checkpoint(tmp_path, WIDE_CONFIG, seed=0)
    head = saccade.ActionHead.load(tmp_path)
    assert head.isa == isa
    features, state, ids, noise = (inputs[name].numpy() for name in INPUTS)
    actions = head(features, state, ids, noise=noise)
    assert np.abs(actions - their_actions(theirs, inputs).numpy()).max() <= TOLERANCE
    with torch.no_grad():
        assert relative_error(actions, reference(**inputs)) <= 1e-5


@pytest.mark.parametrize(
    "change",
    [
        {"num_future_tokens": 0},
        {"interleave": False},
        {"use_vlln": False},
        {"add_pos_embed": False},
        {"num_layers": 3},
        {"vl_num_layers": 2, "num_steps": 7},
    ],
    ids=str,
)
def test_reference_equals_lerobot_on_other_configs(change: dict[str, int | bool]) -> None:
    config = small_config(**change)  # type: ignore[arg-type]
    head = random_head(config, seed=2)
    theirs = lerobot_head.build(config)
    theirs.load_state_dict(head.state_dict(), strict=True)
    inputs = random_inputs(head.config, seed=3, batch=3, num_vl_tokens=7)
    with torch.no_grad():
        assert relative_error(head(**inputs), their_actions(theirs, inputs)) <= TOLERANCE


def test_training_loss_and_gradients_equal_lerobot() -> None:
    config = small_config()
    head = random_head(config, seed=4, dtype=torch.float64)
    theirs = lerobot_head.build(config).double()
    theirs.load_state_dict(head.state_dict(), strict=True)
    inputs = {name: t.double() if t.is_floating_point() else t for name, t in training_inputs(head).items()}
    loss = head.loss(**inputs)
    loss.backward()

    feature = lerobot_head.import_head().BatchFeature
    backbone = feature(
        data={"backbone_features": inputs["backbone_features"], "backbone_attention_mask": None}
    )
    batch = {"state": inputs["state"], "embodiment_id": inputs["embodiment_id"]}
    batch |= {"action": inputs["actions"], "action_mask": inputs["action_mask"]}
    with (
        mock.patch.object(torch, "randn", lambda *args, **kwargs: inputs["noise"]),
        mock.patch.object(type(theirs), "sample_time", lambda *args, **kwargs: inputs["time"]),
    ):
        their_loss = theirs(backbone, feature(data=batch)).loss
    their_loss.backward()

    assert relative_error(loss.detach(), their_loss.detach()) <= 1e-5
    gradients = dict(head.named_parameters())
    for name, parameter in theirs.named_parameters():
        ours = gradients[name].grad
        assert ours is not None
        assert parameter.grad is not None
        assert relative_error(ours, parameter.grad) <= 1e-4, name


def training_inputs(head: ActionHead) -> dict[str, Tensor]:
    inputs = random_inputs(head.config, seed=5, batch=4, num_vl_tokens=6)
    generator = torch.Generator().manual_seed(6)
    actions = torch.randn(inputs["noise"].shape, generator=generator)
    mask = torch.randint(2, actions.shape, generator=generator).float()
    return inputs | {"actions": actions, "action_mask": mask, "time": head.sample_time(4, generator)}
