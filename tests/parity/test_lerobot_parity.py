"""The reference and the Rust head against the released code itself, at the released widths.

lerobot is installed by the test set-up without its dependencies; if it is missing, these tests fail.
Tables differ: the released code calls torch's float32 sin and cos, so up to 2e-4 may come from them alone.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import saccade
from saccade_lab.reference import ActionHead, lerobot_head
from saccade_lab.reference.random_weights import random_head, random_inputs, sized_config, write_checkpoint
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import Released

TOLERANCE = 3e-4
INPUTS = ("backbone_features", "state", "embodiment_id", "noise")


@dataclass(frozen=True)
class Wide:
    """One observation at N1.5's widths, fewer blocks and embodiments; what the torch heads make of it."""

    checkpoint: Path
    inputs: dict[str, Tensor]
    reference_actions: NDArray[np.float32]
    lerobot_actions: NDArray[np.float32]


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Wide:
    checkpoint = tmp_path_factory.mktemp("wide")
    config = sized_config("n1.5", num_layers=2, vl_num_layers=1, num_embodiments=3)
    write_checkpoint(checkpoint, config, seed=0)
    reference = ActionHead.from_pretrained(checkpoint)
    theirs = lerobot_head.build(config, device="meta")
    theirs.load_state_dict(reference.state_dict(), strict=True, assign=True)
    inputs = random_inputs(reference.config, seed=1, batch=1, num_vl_tokens=296)
    with torch.no_grad():
        return Wide(checkpoint, inputs, reference(**inputs).numpy(), their_actions(theirs, inputs).numpy())


def their_actions(theirs: nn.Module, inputs: dict[str, Tensor]) -> Tensor:
    return lerobot_head.get_action(
        theirs, inputs["backbone_features"], inputs["state"], inputs["embodiment_id"], inputs["noise"]
    )


def test_reference_equals_lerobot_at_full_width(wide: Wide) -> None:
    assert wide.lerobot_actions.std() > 0.5
    assert np.abs(wide.reference_actions - wide.lerobot_actions).max() <= TOLERANCE


def test_rust_equals_lerobot_at_full_width(wide: Wide, isa: str) -> None:
    head = saccade.ActionHead.from_pretrained(wide.checkpoint)
    assert head.isa == isa
    features, state, ids, noise = (wide.inputs[name].numpy() for name in INPUTS)
    actions = head(features, state, ids, noise=noise)
    assert np.abs(actions - wide.lerobot_actions).max() <= TOLERANCE
    assert relative_error(actions, wide.reference_actions) <= 1e-5


def test_lerobot_reproduces_the_recorded_outputs(released: Released) -> None:
    """Guards the recorded outputs: a changed file, or a wrong set-up of lerobot, shows here."""
    theirs = lerobot_head.build(released.config)
    theirs.load_state_dict(ActionHead.from_pretrained(released.path).state_dict(), strict=True)
    inputs = {name: torch.tensor(getattr(released, name)) for name in INPUTS}
    assert np.abs(their_actions(theirs, inputs).numpy() - released.actions_f64).max() <= TOLERANCE


@pytest.mark.parametrize(
    "change",
    [
        {"num_future_tokens": 0},
        {"interleave": False},
        {"use_vlln": False},
        {"add_pos_embed": False},
        {"num_layers": 3},
        {"vl_num_layers": 2, "num_steps": 7},
        {"num_future_tokens": 0, "use_vlln": False, "context_dim": 12},  # what N1 is
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
