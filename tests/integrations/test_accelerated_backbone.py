"""`saccade.integrations.accelerate` with the backbone, on lerobot 0.4.4's own model, small."""

from __future__ import annotations

import copy
import functools
import gc
import weakref
from typing import Any

import pytest
import torch

import saccade
from saccade.integrations import accelerate, modules
from tests.helpers import whole_integration_cases as cases
from tests.helpers import whole_policies
from tests.helpers.integration_cases import EXACT

torch.set_num_threads(1)  # small tensors gain nothing from more


@functools.cache
def built(attention: str = "sdpa") -> Any:
    return whole_policies.build(whole_policies.import_n15(), "n1.5", attention=attention)


@pytest.fixture
def whole() -> cases.Whole:
    return cases.Whole(copy.deepcopy(built()), "n1.5")


@pytest.mark.parametrize("autocast", [False, True], ids=["plain", "autocast"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize(("batch", "views"), [(1, 1), (3, 2)])
def test_the_same(whole: cases.Whole, dtype: torch.dtype, autocast: bool, batch: int, views: int) -> None:
    cases.check_the_same(whole, dtype=dtype, autocast=autocast, batch=batch, views=views)


@pytest.mark.parametrize(
    "precision", ["bfloat16", "int8", "int4", {"backbone": "int8", "head": "bfloat16"}], ids=str
)
def test_precisions(whole: cases.Whole, precision: Any) -> None:
    cases.check_the_same(whole, dtype=torch.float32, autocast=False, batch=2, views=1, precision=precision)


def test_each_part_has_its_precision(whole: cases.Whole) -> None:
    precision = {"backbone": "int8", "head": "bfloat16"}
    with accelerate(whole.model, backbone=True, precision=precision) as handle:
        assert (handle.backbone.precision, handle.head.precision) == ("int8", "bfloat16")
        assert "int8" in repr(handle)
    assert "restored" in repr(handle)


def test_every_instruction_set(whole: cases.Whole, isa: str) -> None:
    cases.check_the_same(whole, dtype=torch.float32, autocast=False, batch=2, views=1)


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
    cases.check_other_attention(cases.Whole(copy.deepcopy(built("eager")), "n1.5"))


def test_threads(whole: cases.Whole) -> None:
    cases.check_threads(whole)


def test_the_original_in_another_thread_is_no_replacement(whole: cases.Whole) -> None:
    """While it runs, transformers 4.57 has functions of its own in the place of the layers' `forward`."""
    given = whole.observations()
    layers = cases.language_model(whole.backbone).layers
    seen: list[bool] = []

    def look(*arguments: object) -> None:
        seen.extend(("forward" in vars(layers[0]), modules.is_own(layers[0], "forward")))

    hook = layers[1].register_forward_hook(look)
    cases.call(whole, given)
    hook.remove()
    assert seen[:2] == [True, True]
    layers[0].forward = lambda *arguments: None
    assert not modules.is_own(layers[0], "forward")


def test_projected_features(whole: cases.Whole) -> None:
    """`project_to_dim`, which the released code gives the width 2048 only."""
    torch.manual_seed(0)
    whole.backbone.eagle_linear = torch.nn.Linear(whole_policies.WIDTH, whole_policies.WIDTH)
    whole.model.eval()
    cases.check_the_same(whole, dtype=torch.float32, autocast=True, batch=2, views=2)
    cases.check_the_same(whole, dtype=torch.float32, autocast=False, batch=2, views=2)


def test_a_setting_that_changes_is_read(whole: cases.Whole) -> None:
    given = whole.observations()
    with accelerate(whole.model, backbone=True) as handle:
        before = handle.backbone
        whole.backbone.eagle_model.image_token_index = 9
        given["eagle_input_ids"][given["eagle_input_ids"] == whole_policies.IMAGE_TOKEN] = 9
        ours = cases.call(whole, given)
        assert handle.backbone is not before
    cases.assert_same(ours, cases.call(whole, given), EXACT)


def test_inference_mode(whole: cases.Whole) -> None:
    given = whole.observations()
    theirs = cases.call(whole, given)
    with torch.inference_mode(), accelerate(whole.model, backbone=True):
        cases.assert_same(cases.call(whole, given), theirs, EXACT)


def test_a_policy_that_goes_takes_its_weights_along(whole: cases.Whole) -> None:
    model = copy.deepcopy(whole.model)
    handle = accelerate(model, backbone=True)
    held = weakref.ref(model.backbone)
    gc.collect()
    gc.disable()
    try:
        del model
        assert held() is None, "something keeps the torch backbone"
    finally:
        gc.enable()
    with pytest.raises(saccade.InputError, match="no longer"):
        handle.backbone  # noqa: B018
    handle.restore()


def test_a_layer_too_many_is_refused(whole: cases.Whole) -> None:
    """The released code takes the features before it; saccade would compute it."""
    whole.backbone.select_layer = 1
    cases.refused(whole, "select_layer is 1, expected its number of layers, 2")
