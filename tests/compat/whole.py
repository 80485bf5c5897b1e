"""lerobot's whole policies, accelerated: `make test-compat` runs this in an environment of each release.

Policy, model, backbone and head are small instances of lerobot's own classes. Results are added to the file
named by SACCADE_COMPAT_OUT.
"""

# Calls of torch modules are untyped, and lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call, attr-defined"

from __future__ import annotations

import copy
import functools
import importlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import policies
import pytest
import torch
from torch import Tensor

from saccade.integrations import accelerate
from saccade.integrations.accelerated_backbone import AcceleratedBackbone
from tests.helpers import whole_integration_cases as cases
from tests.helpers import whole_policies

KIND = policies.KIND

RESULTS: dict[str, Any] = {}


@pytest.fixture(scope="module", autouse=True)
def added_results() -> Iterator[None]:
    """Adds what the tests have recorded to the results of policies.py."""
    yield
    if "SACCADE_COMPAT_OUT" in os.environ:
        path = Path(os.environ["SACCADE_COMPAT_OUT"])
        report = json.loads(path.read_text())
        report["results"] |= RESULTS
        path.write_text(json.dumps(report, indent=1))


@functools.cache
def built(attention: str = "sdpa") -> Any:
    """A `GrootPolicy` with a whole small model."""
    name = "groot_n1" if KIND == "n1.5" else "groot_n1_7"
    released = importlib.import_module(f"lerobot.policies.groot.{name}")
    return policies.policy_around(whole_policies.build(released, KIND, attention=attention))


@pytest.fixture
def policy() -> Any:
    return copy.deepcopy(built())


@pytest.fixture
def whole(policy: Any) -> cases.Whole:
    return cases.Whole(policy._groot_model, KIND)


def predict(policy: Any, batch: int, views: int = 1, **options: Any) -> Tensor:
    head = policy._groot_model.action_head
    given = whole_policies.observations(KIND, head, batch=batch, views=views)
    torch.manual_seed(3)
    return policy.predict_action_chunk(given, **options)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("autocast", [False, True], ids=["plain", "autocast"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
def test_policy_predicts_the_same(policy: Any, dtype: torch.dtype, autocast: bool, precision: str) -> None:
    policy.to(dtype)
    if dtype is torch.bfloat16 and KIND == "n1.5":
        policy._groot_model.compute_dtype = "bfloat16"
    if autocast:
        policies.use_bfloat16(policy)
    exact = dtype is torch.float32 and not autocast and precision == "float32"
    kind = f"{str(dtype).removeprefix('torch.')}{', autocast' if autocast else ''}"
    name = f"whole, {kind}" if precision == "float32" else f"whole, {kind}, precision {precision}"
    for batch, views in ((1, 1), (3, 2)):
        theirs = predict(policy, batch, views)
        with accelerate(policy, backbone=True, precision=precision):
            assert isinstance(policy._groot_model.backbone.forward, AcceleratedBackbone)
            ours = predict(policy, batch, views)
        assert ours.dtype is theirs.dtype
        error = cases.error(ours, theirs)
        RESULTS[name] = max(error, RESULTS.get(name, 0.0))
        assert error <= (cases.EXACT if exact else cases.ROUNDED)


def test_policy_steps_the_same(policy: Any) -> None:
    given = whole_policies.observations(KIND, policy._groot_model.action_head, batch=1)

    def actions() -> Tensor:
        policy.reset()
        torch.manual_seed(4)
        return torch.stack([policy.select_action(given) for _ in range(policy.config.n_action_steps + 3)])

    theirs = actions()
    with accelerate(policy, backbone=True):
        ours = actions()
    assert cases.error(ours, theirs) <= cases.EXACT


@pytest.mark.skipif(KIND != "n1.7", reason="N1.5 has no real-time chunking")
def test_policy_continues_a_chunk(policy: Any) -> None:
    left = torch.randn(9, policies.ACTION_DIM, generator=torch.Generator().manual_seed(5))
    theirs = predict(policy, 2, prev_chunk_left_over=left, inference_delay=3)
    with accelerate(policy, backbone=True):
        ours = predict(policy, 2, prev_chunk_left_over=left, inference_delay=3)
    assert cases.error(ours, theirs) <= cases.EXACT


def test_training_between_evaluations(policy: Any) -> None:
    """An optimizer's steps in lerobot's training mode, then `predict_action_chunk`, which turns it off."""
    handle = accelerate(policy, backbone=True)
    before = predict(policy, 1)
    policy.train()
    cases.step(policy)
    ours = predict(policy, 1)
    handle.restore()
    assert cases.error(ours, predict(policy, 1)) <= cases.EXACT
    assert cases.error(ours, before) > 0.1


def test_saved_policies_are_the_originals(policy: Any, tmp_path: Path) -> None:
    from safetensors.torch import load_file

    tensors = policy.state_dict()
    with accelerate(policy, backbone=True):
        policy.save_pretrained(tmp_path)
    saved = load_file(tmp_path / "model.safetensors")
    assert set(saved) <= set(tensors)  # a tied tensor is saved once
    assert all(torch.equal(saved[name], tensors[name]) for name in saved)


def test_int8(whole: cases.Whole) -> None:
    RESULTS["whole, precision int8"] = cases.check_the_same(
        whole, dtype=torch.float32, autocast=False, batch=2, views=2, precision="int8"
    )


def test_results_of_the_backbone(whole: cases.Whole) -> None:
    cases.check_the_same(whole, dtype=torch.float32, autocast=True, batch=3, views=2)


def test_restore(whole: cases.Whole) -> None:
    cases.check_restore(whole)


@pytest.mark.parametrize("change", cases.CHANGES)
def test_weights_that_change_are_taken_anew(whole: cases.Whole, change: str) -> None:
    cases.check_changed_weights(whole, cases.CHANGES[change])


def test_training(whole: cases.Whole) -> None:
    cases.check_training(whole)


def test_copies_hold_the_originals(whole: cases.Whole) -> None:
    cases.check_copies(whole)


def test_refusals(whole: cases.Whole) -> None:
    cases.check_refusals(whole)


def test_other_attention() -> None:
    cases.check_other_attention(cases.Whole(copy.deepcopy(built("eager"))._groot_model, KIND))


def test_threads(whole: cases.Whole) -> None:
    cases.check_threads(whole)
