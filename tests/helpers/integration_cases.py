"""What an accelerated head must do: checks for any torch head with `get_action`.

Run by test_integrations.py on what the test environment has, and by tests/compat on lerobot's own policies.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator"

from __future__ import annotations

import copy
import io
import pickle
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import saccade
from saccade.integrations import Accelerated, accelerate
from saccade_lab.reference.random_weights import random_tensor

#: Largest relative errors. Exact arithmetic differs by the sinusoidal tables, which the released code takes
#: from torch's float32 functions; where the original rounds to bfloat16, saccade does not.
EXACT = 3e-4
ROUNDED = 0.05
INT4 = 0.4  # of parts as small as these: 0.10 to 0.30 measured over five seeds of weights and inputs


@dataclass(frozen=True)
class Case:
    """A torch head in eval mode, and the class that it takes and returns."""

    head: Any
    batch_feature: type[Any]

    @property
    def config(self) -> Any:
        return self.head.config

    @property
    def takes_options(self) -> bool:
        return hasattr(self.head, "get_action_with_features")

    @property
    def action_width(self) -> int:
        """Width of the actions that are denoised."""
        return int(self.head.action_encoder.W1.W.shape[1])


@dataclass(frozen=True)
class Outcome:
    """What a call of `get_action` leaves behind."""

    results: dict[str, Tensor]
    result_class: type[Any]
    backbone_output: dict[str, Tensor]
    next_random: Tensor


Build = Callable[[], Case]
Inputs = tuple[dict[str, Tensor], dict[str, Tensor]]


def fill(module: Any, seed: int = 0) -> Any:
    """Gives every parameter random values of a useful size."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            parameter.copy_(random_tensor(name, parameter.shape, generator))
    return module


def inputs(
    case: Case, *, batch: int = 1, dtype: torch.dtype = torch.float32, num_vl_tokens: int = 11
) -> Inputs:
    """`backbone_output` and `action_input`, with padding on the left and a run of image tokens."""
    generator = torch.Generator().manual_seed(batch)
    config = case.config
    history = getattr(config, "state_history_length", 1)
    attended = torch.ones(batch, num_vl_tokens, dtype=torch.bool)
    image = torch.zeros(batch, num_vl_tokens, dtype=torch.bool)
    for row in range(batch):
        attended[row, : 2 * row] = False
        image[row, 2 * row + 2 : 2 * row + 5] = True
    features = torch.randn(batch, num_vl_tokens, config.backbone_embedding_dim, generator=generator)
    backbone_output = {
        "backbone_features": features.to(dtype),
        "backbone_attention_mask": attended,
        "image_mask": image,
    }
    action_input = {
        "state": torch.randn(batch, history, config.max_state_dim, generator=generator).to(dtype),
        "embodiment_id": torch.arange(batch) % config.max_num_embodiments,
    }
    return backbone_output, action_input


def call(
    case: Case,
    given: Inputs,
    *,
    seed: int = 7,
    autocast: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Outcome:
    """`get_action` on copies of the inputs, from a seeded generator."""
    backbone_output, action_input = (case.batch_feature(data=dict(part)) for part in given)
    torch.manual_seed(seed)
    arguments = () if options is None else (options,)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        results = case.head.get_action(backbone_output, action_input, *arguments)
    return Outcome(dict(results), type(results), dict(backbone_output), torch.randn(4))


def assert_same(ours: Outcome, theirs: Outcome, tolerance: float) -> float:
    """That two calls left the same behind, up to rounding; the largest relative error of the actions."""
    assert ours.result_class is theirs.result_class
    assert ours.results.keys() == theirs.results.keys()
    assert ours.backbone_output.keys() == theirs.backbone_output.keys()
    assert torch.equal(ours.next_random, theirs.next_random), "other draws from torch's generator"
    for ours_part, theirs_part in (
        (ours.results, theirs.results),
        (ours.backbone_output, theirs.backbone_output),
    ):
        for name, expected in theirs_part.items():
            got = ours_part[name]
            assert (got.dtype, got.shape, got.device) == (expected.dtype, expected.shape, expected.device), (
                name
            )
            assert error(got, expected) <= tolerance, name
    assert theirs.results["action_pred"].float().std() > 0.5
    return error(ours.results["action_pred"], theirs.results["action_pred"])


def error(got: Tensor, expected: Tensor) -> float:
    """Root mean square of the difference, relative to that of the expected values."""
    size = torch.linalg.vector_norm(expected.float())
    return float(torch.linalg.vector_norm(got.float() - expected.float()) / size.clamp_min(1e-30))


def tolerance_of(dtype: torch.dtype, autocast: bool, precision: Any) -> float:
    """The largest relative error of an accelerated part."""
    if precision == "int4":
        return INT4
    exact = dtype is torch.float32 and not autocast and precision == "float32"
    return EXACT if exact else ROUNDED


def check_equal_seeds(
    case: Case, *, batch: int, dtype: torch.dtype = torch.float32, autocast: bool = False, **options: Any
) -> float:
    """Equal seeds, equal actions; the largest relative error."""
    case.head.to(dtype)
    given = inputs(case, batch=batch, dtype=torch.bfloat16 if autocast else dtype)
    tolerance = tolerance_of(dtype, autocast, options.get("precision", "float32"))
    theirs = [call(case, given, seed=seed, autocast=autocast) for seed in (7, 8)]
    with accelerate(case.head, **options):
        ours = [call(case, given, seed=seed, autocast=autocast) for seed in (7, 8)]
    assert not torch.equal(theirs[0].results["action_pred"], theirs[1].results["action_pred"])
    return max(assert_same(a, b, tolerance) for a, b in zip(ours, theirs, strict=True))


def check_chunking(case: Case) -> float:
    """Real-time chunking by the head's options; the largest relative error."""
    horizon = case.config.action_horizon
    backbone_output, action_input = inputs(case, batch=2)
    # A chunk of five steps, padded by three: what overlaps is the tail of the five.
    previous = torch.randn(2, 8, case.action_width, generator=torch.Generator().manual_seed(3))
    given = (backbone_output, action_input | {"action": previous})
    errors = []
    for overlap, frozen, rate in ((5, 2, 6.0), (4, 4, 6.0), (3, 0, 1.5), (0, 0, 6.0)):
        options = {
            "action_horizon": 5,
            "rtc_overlap_steps": overlap,
            "rtc_frozen_steps": frozen,
            "rtc_ramp_rate": rate,
        }
        theirs = call(case, given, options=options)
        with accelerate(case.head):
            ours = call(case, given, options=options)
        errors.append(assert_same(ours, theirs, EXACT))
        actions = ours.results["action_pred"]
        assert actions.shape[1] == horizon
        torch.testing.assert_close(actions[:, :frozen], previous[:, 5 - overlap : 5 - overlap + frozen])
    with accelerate(case.head):
        with pytest.raises(
            saccade.InputError, match=r"^options: .* without action_horizon, rtc_overlap_steps"
        ):
            call(case, given)
        with pytest.raises(saccade.InputError, match=r"^options: rtc_frozen_steps: expected at most 3"):
            call(case, given, options=options | {"rtc_overlap_steps": 3, "rtc_frozen_steps": 4})
    return max(errors)


def check_restore(case: Case) -> None:
    """`restore` puts the original back, bit for bit, and frees what saccade held."""
    given = inputs(case, batch=2)
    before, own = call(case, given), dict(vars(case.head))
    handle = accelerate(case.head, num_threads=1)
    assert case.head.get_action is handle
    assert handle.head.config.action_horizon == case.config.action_horizon
    with pytest.raises(saccade.InputError, match="accelerated already"):
        accelerate(case.head)
    handle.restore()
    handle.restore()
    assert dict(vars(case.head)) == own
    after = call(case, given)
    assert torch.equal(before.results["action_pred"], after.results["action_pred"])
    for use in (lambda: handle.head, handle.refresh):
        with pytest.raises(saccade.InputError, match="no longer"):
            use()
    accelerate(case.head, num_threads=1).restore()


def check_changed_weights(case: Case, change: Callable[[Any], None]) -> None:
    """Weights that change are never stale."""
    given = inputs(case, batch=2)
    handle = accelerate(case.head)
    first, loaded = call(case, given), handle.head
    assert handle.head is loaded
    change(case.head)
    dtype = next(case.head.parameters()).dtype
    given = inputs(case, batch=2, dtype=dtype)
    ours = call(case, given)
    assert handle.head is not loaded
    handle.restore()
    tolerance = EXACT if dtype is torch.float32 else ROUNDED
    assert_same(ours, call(case, given), tolerance)
    if dtype is torch.float32:
        assert error(ours.results["action_pred"], first.results["action_pred"]) > 10 * tolerance


def step(head: Any) -> None:
    optimizer = torch.optim.AdamW(head.parameters(), lr=0.05)
    for parameter in head.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()


def load(head: Any) -> None:
    other = {name: tensor + 0.1 for name, tensor in head.state_dict().items()}
    head.load_state_dict(other)


def assign(head: Any) -> None:
    other = {name: nn.Parameter(tensor + 0.1) for name, tensor in head.state_dict().items()}
    head.load_state_dict(other, assign=True)


def average(head: Any) -> None:
    for parameter in head.parameters():
        parameter.data.mul_(0.7)  # not counted by torch


def through_numpy(head: Any) -> None:
    weight = head.action_encoder.W3.W
    weight.detach().numpy()[...] *= 0.5


def half_of_a_matrix(head: Any) -> None:
    for parameter in head.model.parameters():
        if parameter.ndim == 2:
            parameter.data[:, : parameter.shape[1] // 2].mul_(-1)


def replace_parameter(head: Any) -> None:
    linear = head.model.proj_out_2
    linear.weight = nn.Parameter(linear.weight.detach() * 0.5)


def replace_module(head: Any) -> None:
    decoder = next(name for name, _ in head.named_children() if name.endswith("decoder"))
    setattr(head, decoder, fill(copy.deepcopy(getattr(head, decoder)), seed=5).eval())


def to_bfloat16(head: Any) -> None:
    head.to(torch.bfloat16)


CHANGES = {
    change.__name__: change
    for change in (
        step,
        load,
        assign,
        average,
        through_numpy,
        half_of_a_matrix,
        replace_parameter,
        replace_module,
        to_bfloat16,
    )
}


def check_settings_are_read_live(case: Case) -> None:
    """Steps that a user sets on the torch head afterwards are those that run."""
    given = inputs(case)
    with accelerate(case.head):
        case.head.num_inference_timesteps = 7
        ours = call(case, given)
    assert_same(ours, call(case, given), EXACT)


def check_copies(case: Case) -> None:
    """Copies and pickles hold the original, of their own weights."""
    given = inputs(case)
    theirs = call(case, given)
    handle = accelerate(case.head)
    copies = [copy.deepcopy(case.head), pickle.loads(pickle.dumps(case.head))]
    buffer = io.BytesIO()
    torch.save(nn.ModuleDict({"inner": case.head}), buffer)
    buffer.seek(0)
    copies.append(torch.load(buffer, weights_only=False)["inner"])
    assert case.head.state_dict().keys() == copies[0].state_dict().keys()
    for other in copies:
        assert not isinstance(other.get_action, Accelerated)
        same = Case(other, case.batch_feature)
        assert torch.equal(call(same, given).results["action_pred"], theirs.results["action_pred"])
        fill(other, seed=9)
        with accelerate(other):
            changed = call(same, given)
        assert error(changed.results["action_pred"], theirs.results["action_pred"]) > 0.1
    assert_same(call(case, given), theirs, EXACT)
    handle.restore()


def check_threads(case: Case) -> None:
    """Callers at once, at any number of threads, get the bits of one; also while the weights change."""
    given = inputs(case, batch=2)
    with accelerate(case.head, num_threads=1) as handle:
        expected = handle.head.num_threads, handle.head.sample
        backbone_output, action_input = given
        noise = np.ones((2, case.config.action_horizon, case.action_width), np.float32)
        want = whole(handle, backbone_output, action_input, noise)
    with accelerate(case.head, num_threads=2) as handle:
        assert handle.head.num_threads == 2
        got: list[Any] = []
        callers = [
            threading.Thread(target=lambda: got.append(whole(handle, backbone_output, action_input, noise)))
            for _ in range(4)
        ]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
        assert len(got) == 4
        assert all(np.array_equal(actions, want) for actions in got)
        average(case.head)
        outcomes: list[Any] = []
        callers = [threading.Thread(target=lambda: outcomes.append(handle.head)) for _ in range(4)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
        assert len(set(map(id, outcomes))) == 1, "loaded more than once"
    assert expected[0] == 1


def whole(handle: Accelerated, backbone_output: Any, action_input: Any, noise: Any) -> Any:
    """The engine's own call, from given noise."""
    masks = {}
    if handle.head.config.mask_mode == "alternate":
        masks = {
            "attention_mask": backbone_output["backbone_attention_mask"],
            "image_mask": backbone_output["image_mask"],
        }
    features, state, ids = (
        part.numpy()
        for part in (
            backbone_output["backbone_features"],
            action_input["state"],
            action_input["embodiment_id"],
        )
    )
    return handle.head(features, state, ids, noise=noise, **masks)
