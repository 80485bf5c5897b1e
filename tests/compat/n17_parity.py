"""The reference and the Rust head against lerobot's own GR00T N1.7 head.

`make test-compat` runs this where lerobot is 0.6 or later. Sine tables differ: the released code calls
torch's float32 exp, sin and cos, so up to 2e-4 may come from them alone.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from lerobot.policies.groot import groot_n1_7 as released
from torch import Tensor
from transformers.feature_extraction_utils import BatchFeature

import saccade
from saccade_lab.reference import ActionHead
from saccade_lab.reference.random_weights import (
    random_head,
    random_inputs,
    sized_config,
    small_config,
    write_checkpoint,
)

TOLERANCE = 3e-4

torch.set_num_threads(1)  # small tensors gain nothing from more


@dataclass(frozen=True)
class Case:
    """A head and how it is called."""

    config: dict[str, Any]
    num_vl_tokens: int = 20
    chunking: saccade.Chunking | None = None
    previous_chunk: Tensor | None = None


def small(change: dict[str, Any] | None = None, chunking: saccade.Chunking | None = None) -> Case:
    config = small_config("n1.7") | (change or {})
    shape = (3, config["action_horizon"], config["max_action_dim"])
    previous = None if chunking is None else torch.randn(shape, generator=torch.Generator().manual_seed(9))
    return Case(config, 20, chunking, previous)


CASES = {
    "small": small(),
    "history": small({"state_history_length": 3}),
    "no-vl-self-attention": small({"vl_self_attention_cfg": None}),
    "no-vlln": small({"use_vlln": False}),
    "text-every-third": small({"attend_text_every_n_blocks": 3}),
    "no-masks": small({"use_alternate_vl_dit": False}),
    "steps": small({"num_inference_timesteps": 7}),
    "chunking": small(chunking=saccade.Chunking(9, 3)),
    "chunking-shorter": small(chunking=saccade.Chunking(8, 0, ramp_rate=2.0, horizon=33)),
    "wide": Case(sized_config("n1.7", num_layers=3, vl_num_layers=1, num_embodiments=1), 81),
}


def theirs_of(case: Case, head: ActionHead) -> Any:
    theirs = released.GR00TN17ActionHead(released.GR00TN17Config(**case.config)).eval()
    theirs.load_state_dict(head.state_dict(), strict=True)
    return theirs


def backbone_of(inputs: dict[str, Tensor], num_vl_tokens: int) -> Any:
    every = torch.ones(3, num_vl_tokens, dtype=torch.bool)
    return BatchFeature(
        data={
            "backbone_features": inputs["backbone_features"],
            "backbone_attention_mask": inputs.get("attention_mask", every),
            "image_mask": inputs.get("image_mask", every),
        }
    )


@pytest.mark.parametrize("name", CASES)
def test_actions(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    write_checkpoint(tmp_path, case.config, seed=1)
    head = ActionHead.from_pretrained(tmp_path)
    inputs: dict[str, Any] = random_inputs(head.config, 2, batch=3, num_vl_tokens=case.num_vl_tokens)
    action_input = {"state": inputs["state"], "embodiment_id": inputs["embodiment_id"]}
    options: dict[str, Any] | None = None
    ours: dict[str, Any] = {}
    if case.chunking is not None:
        action_input["action"] = case.previous_chunk
        options = {
            "action_horizon": case.chunking.horizon or case.config["action_horizon"],
            "rtc_overlap_steps": case.chunking.overlap,
            "rtc_frozen_steps": case.chunking.frozen,
            "rtc_ramp_rate": case.chunking.ramp_rate,
        }
        ours = {"previous_chunk": case.previous_chunk, "chunking": case.chunking}

    def given_noise(*, size: tuple[int, ...], **_: Any) -> Tensor:
        assert size == tuple(inputs["noise"].shape)
        return inputs["noise"].clone()  # what is drawn is written into

    theirs = theirs_of(case, head)
    backbone = backbone_of(inputs, case.num_vl_tokens)
    with mock.patch.object(torch, "randn", given_noise):
        expected = theirs.get_action(backbone, BatchFeature(data=action_input), options)["action_pred"]
    assert expected.std() > 0.5
    with torch.no_grad():
        actions = head(**inputs, **ours)
    assert (actions - expected).abs().max() <= TOLERANCE
    in_rust = saccade.ActionHead.from_pretrained(tmp_path)
    assert (torch.as_tensor(in_rust(**inputs, **ours)) - expected).abs().max() <= TOLERANCE


@pytest.mark.parametrize("name", ["small", "history", "no-vl-self-attention"])
def test_training_loss_and_gradients(name: str) -> None:
    case = CASES[name]
    head = random_head(case.config, 3, dtype=torch.float64)
    theirs = theirs_of(case, head).double()  # in eval mode it drops no states
    inputs = random_inputs(head.config, 4, batch=3, num_vl_tokens=case.num_vl_tokens)
    inputs = {key: t.double() if t.is_floating_point() else t for key, t in inputs.items()}
    generator = torch.Generator().manual_seed(5)
    noise = inputs.pop("noise")
    actions = torch.randn(noise.shape, generator=generator).double()
    mask = torch.randint(2, noise.shape, generator=generator).double()
    time = head.sample_time(3, generator)
    loss = head.loss(**inputs, actions=actions, noise=noise, time=time, action_mask=mask)
    loss.backward()

    batch = {"state": inputs["state"], "embodiment_id": inputs["embodiment_id"]}
    batch |= {"action": actions, "action_mask": mask}
    with (
        mock.patch.object(torch, "randn", lambda *args, **kwargs: noise),
        mock.patch.object(type(theirs), "sample_time", lambda *args, **kwargs: time),
    ):
        their_loss = theirs(backbone_of(inputs, case.num_vl_tokens), BatchFeature(data=batch))["loss"]
    their_loss.backward()
    assert loss.item() == pytest.approx(their_loss.item(), rel=1e-5)
    gradients = dict(theirs.named_parameters())
    for key, parameter in head.named_parameters():
        their_gradient = gradients[key].grad
        assert parameter.grad is not None
        assert their_gradient is not None
        assert (parameter.grad - their_gradient).abs().max() <= 1e-4 * max(1.0, their_gradient.abs().max())
