"""What an accelerated whole policy must do: checks for lerobot's own models, backbone and head.

Run by test_accelerated_backbone.py on lerobot 0.4.4's model, and by tests/compat on the policies of every
release.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator"

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import saccade
from saccade.integrations import Accelerated, accelerate
from saccade.integrations.accelerated_backbone import AcceleratedBackbone
from tests.helpers import whole_policies
from tests.helpers.integration_cases import EXACT, average, error, load, step, tolerance_of


@dataclass(frozen=True)
class Whole:
    """A model of lerobot in eval mode, and its version."""

    model: Any
    kind: str

    @property
    def backbone(self) -> Any:
        return self.model.backbone

    def observations(self, batch: int = 1, views: int = 1) -> dict[str, Tensor]:
        return whole_policies.observations(self.kind, self.model.action_head, batch=batch, views=views)

    def copy(self) -> Whole:
        return Whole(copy.deepcopy(self.model), self.kind)


@dataclass(frozen=True)
class Outcome:
    """What a call of the model computes: the backbone's results and the actions."""

    backbone: Any
    actions: Tensor
    next_random: Tensor


def call(whole: Whole, given: dict[str, Tensor], *, autocast: bool = False) -> Outcome:
    """The backbone's results, and `get_action` from a seeded generator."""
    model = whole.model
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        backbone_inputs, _ = model.prepare_input(dict(given))
        backbone = model.backbone(backbone_inputs)
        torch.manual_seed(7)
        actions = model.get_action(dict(given))["action_pred"]
    return Outcome(backbone, actions, torch.randn(4))


def assert_same(ours: Outcome, theirs: Outcome, tolerance: float) -> float:
    """That two calls computed the same, up to rounding; the relative error of the actions."""
    assert type(ours.backbone) is type(theirs.backbone)
    assert ours.backbone.keys() == theirs.backbone.keys()
    for name, expected in theirs.backbone.items():
        got = ours.backbone[name]
        assert (got.dtype, got.shape, got.device) == (expected.dtype, expected.shape, expected.device), name
        if name == "backbone_features":
            assert not got.requires_grad
            assert error(got, expected) <= tolerance
        else:
            assert torch.equal(got, expected), name
    assert ours.actions.dtype is theirs.actions.dtype
    assert torch.equal(ours.next_random, theirs.next_random), "other draws from torch's generator"
    assert theirs.actions.float().std() > 0.5
    found = error(ours.actions, theirs.actions)
    assert found <= tolerance
    return found


def check_the_same(
    whole: Whole, *, dtype: torch.dtype, autocast: bool, batch: int, views: int, **options: Any
) -> float:
    """Equal features and actions; the relative error of the actions."""
    whole.model.to(dtype)
    given = whole.observations(batch, views)
    tolerance = tolerance_of(dtype, autocast, options.get("precision", "float32"))
    theirs = call(whole, given, autocast=autocast)
    with accelerate(whole.model, backbone=True, **options):
        ours = call(whole, given, autocast=autocast)
    return assert_same(ours, theirs, tolerance)


def check_restore(whole: Whole) -> None:
    """`restore` puts both originals back, bit for bit."""
    given, owned = whole.observations(2), [dict(vars(part)) for part in parts(whole)]
    before = call(whole, given)
    handle = accelerate(whole.model, backbone=True, num_threads=1)
    assert isinstance(whole.backbone.forward, AcceleratedBackbone)
    assert handle.backbone.config.version == whole.kind
    assert (handle.backbone.num_threads, handle.head.num_threads) == (1, 1)
    for again in (True, False):
        with pytest.raises(saccade.InputError, match="accelerated already"):
            accelerate(whole.model, backbone=again)
    handle.restore()
    handle.restore()
    assert [dict(vars(part)) for part in parts(whole)] == owned
    after = call(whole, given)
    assert torch.equal(before.actions, after.actions)
    for use in (lambda: handle.head, lambda: handle.backbone, handle.refresh):
        with pytest.raises(saccade.InputError, match="no longer"):
            use()
    with accelerate(whole.model) as handle:
        assert "forward" not in vars(whole.backbone)
        with pytest.raises(saccade.InputError, match="backbone=True"):
            handle.backbone  # noqa: B018


def parts(whole: Whole) -> tuple[Any, Any]:
    return whole.model.action_head, whole.backbone


def check_changed_weights(whole: Whole, change: Callable[[Any], None]) -> None:
    """Weights that change are never stale."""
    given = whole.observations(2)
    handle = accelerate(whole.model, backbone=True)
    first, loaded = call(whole, given), handle.backbone
    assert handle.backbone is loaded
    change(whole.backbone)
    ours = call(whole, given)
    assert handle.backbone is not loaded
    handle.restore()
    assert_same(ours, call(whole, given), EXACT)
    assert error(ours.actions, first.actions) > 10 * EXACT


def replace_layer(backbone: Any) -> None:
    layers = language_model(backbone).layers
    layers[1] = whole_policies.fill(copy.deepcopy(layers[1]), seed=5).eval()


def through_numpy(backbone: Any) -> None:
    language_model(backbone).layers[0].mlp.up_proj.weight.detach().numpy()[...] *= 0.5


CHANGES = {change.__name__: change for change in (step, load, average, replace_layer, through_numpy)}


def language_model(backbone: Any) -> Any:
    inner = getattr(backbone, "eagle_model", None)
    return backbone.model.model.language_model if inner is None else inner.language_model.model


def check_training(whole: Whole) -> None:
    """In training, and where a gradient is asked for, the original runs."""
    given = whole.observations(2)
    backbone_inputs, _ = whole.model.prepare_input(dict(given))
    theirs = whole.backbone(backbone_inputs)["backbone_features"]
    with accelerate(whole.model, backbone=True):
        for training in (True, False):
            whole.backbone.train(training)
            whole.backbone.requires_grad_(True)
            features = whole.backbone(backbone_inputs)["backbone_features"]
            assert features.requires_grad
            assert torch.equal(features, theirs)
            features.float().square().mean().backward()
            whole.backbone.requires_grad_(False)
            assert torch.equal(whole.backbone(backbone_inputs)["backbone_features"], theirs) == training
        weight = language_model(whole.backbone).layers[0].mlp.up_proj.weight
        assert weight.grad is not None
        assert weight.grad.abs().max() > 0


def check_copies(whole: Whole) -> None:
    """Copies and pickles hold the originals."""
    given = whole.observations(2)
    theirs = call(whole, given)
    with accelerate(whole.model, backbone=True):
        other = whole.copy()
        # Whole models cannot be pickled once transformers 5 has recorded hidden states.
        assert whole.backbone.forward.__reduce__() == (getattr, (whole.backbone, "forward"))
        assert whole.model.state_dict().keys() == other.model.state_dict().keys()
        assert not isinstance(other.backbone.forward, AcceleratedBackbone)
        assert torch.equal(call(other, given).actions, theirs.actions)
        whole_policies.fill(other.model, seed=9)
        with accelerate(other.model, backbone=True):
            assert error(call(other, given).actions, theirs.actions) > 0.1
        assert_same(call(whole, given), theirs, EXACT)


def refused(whole: Whole, match: str, **options: Any) -> None:
    """Checks that `accelerate` refuses the policy and leaves it as it is."""
    with pytest.raises(saccade.InputError, match=match):
        accelerate(whole.model, backbone=True, **options)
    assert not isinstance(whole.backbone.forward, AcceleratedBackbone)
    assert not isinstance(whole.model.action_head.get_action, Accelerated)


def check_refusals(whole: Whole) -> None:
    """Uses that saccade cannot follow are errors, before and after `accelerate`."""
    given = whole.observations()
    prefix = "eagle_" if whole.kind == "n1.5" else ""
    layer = language_model(whole.backbone).layers[0]

    refused(whole, "precision", precision={"head": "int8"})
    with pytest.raises(saccade.InputError, match="without backbone=True"):
        accelerate(whole.model, precision={"head": "int8", "backbone": "int8"})
    with pytest.raises(saccade.InputError, match="backbone of GR00T"):
        accelerate(whole.model.action_head, backbone=True)

    whole.backbone.train()
    refused(whole, "training mode")
    whole.model.eval()

    handle = accelerate(whole.model, backbone=True)
    hook = layer.register_forward_hook(lambda *arguments: None)
    with pytest.raises(saccade.InputError, match="hooks"):
        call(whole, given)
    hook.remove()
    layer.forward = lambda *arguments, **options: None
    with pytest.raises(saccade.InputError, match=r"forward of .*layers\.0 has been replaced"):
        call(whole, given)
    del layer.forward
    name = "eagle_position_ids" if prefix else "pixel_values_videos"
    with torch.no_grad(), pytest.raises(saccade.InputError, match=name):
        whole.backbone({**given, name: torch.zeros(1, 3)})
    own = whole.backbone.forward
    whole.backbone.forward = lambda *arguments: own(*arguments)
    with pytest.raises(saccade.InputError, match="forward was replaced since"):
        handle.restore()
    assert isinstance(whole.model.action_head.get_action, Accelerated)
    whole.backbone.forward = own
    handle.restore()

    layer.forward = lambda *arguments: None
    refused(whole, r"forward of .*layers\.0")
    del layer.forward
    whole.backbone.forward = lambda *arguments: None
    refused(whole, "forward has been replaced by")
    del whole.backbone.forward
    whole.backbone.double()
    refused(whole, "float64")
    whole.backbone.float()
    # Other code under the same names is found by running it.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(layer.mlp), "forward", lambda self, rows: self.down_proj(self.up_proj(rows)))
        refused(whole, "its features differ")
    accelerate(whole.model, backbone=True).restore()


def check_other_attention(whole: Whole) -> None:
    """Without sdpa, prompts of equal length are computed as before, and padding is refused.

    Args:
        whole: a model whose language model does not use sdpa.
    """
    given = whole.observations(1, 2)
    theirs = call(whole, given)
    with accelerate(whole.model, backbone=True):
        assert_same(call(whole, given), theirs, EXACT)
        with pytest.raises(saccade.InputError, match="attention_mask: expected no padding"):
            call(whole, whole.observations(2))


def check_threads(whole: Whole) -> None:
    """Callers at once get the bits of one, also while the weights change."""
    given = whole.observations(2)
    with accelerate(whole.model, backbone=True, num_threads=2) as handle:
        assert_equal(features_of_callers(whole, given))
        average(whole.backbone)
        assert_equal(features_of_callers(whole, given))
        assert handle.backbone.num_threads == 2


def features_of_callers(whole: Whole, given: dict[str, Tensor]) -> list[Tensor]:
    """The features that three threads compute at the same time."""
    features: list[Tensor] = []

    def run() -> None:
        with torch.no_grad():
            backbone_inputs, _ = whole.model.prepare_input(dict(given))
            features.append(whole.backbone(backbone_inputs)["backbone_features"])

    callers = [threading.Thread(target=run) for _ in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    return features


def assert_equal(features: list[Tensor]) -> None:
    assert len(features) == 3
    assert all(torch.equal(one, features[0]) for one in features)
