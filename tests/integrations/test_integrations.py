"""`saccade.integrations.accelerate` on the released head that is installed here, and on heads of the shape of
those that are not.
"""

from __future__ import annotations

import copy
import functools
import gc
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from transformers.feature_extraction_utils import BatchFeature

import saccade
from saccade.integrations import accelerate
from saccade_lab.reference import lerobot_head
from saccade_lab.reference.random_weights import small_config
from tests.compat import run as compat
from tests.helpers import integration_cases as cases
from tests.helpers import upstream_heads
from tests.helpers.integration_refusals import check_refusals

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing from more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@functools.cache
def built() -> Any:
    """lerobot 0.4.4's own class, small."""
    return cases.fill(lerobot_head.build(small_config()))


def n15() -> cases.Case:
    """A copy of its own for each test."""
    return cases.Case(copy.deepcopy(built()), lerobot_head.import_head().BatchFeature)


def of_the_shape(kind: str) -> Callable[[], cases.Case]:
    """A head of the shape of one that no wheel holds."""
    build = upstream_heads.ChunkingHead if kind == "n1.7" else upstream_heads.Head
    return lambda: cases.Case(build(small_config(kind)), BatchFeature)


CASES = {"n1.5": n15, **{kind: of_the_shape(kind) for kind in ("n1", "n1.6", "n1.7", "fork", "split-arms")}}


#: Weights' dtype, autocast, observations. Every kind in two of them, the released class in all.
SETTINGS = [
    (torch.float32, False, 3),
    (torch.bfloat16, True, 1),
    (torch.float32, False, 1),
    (torch.bfloat16, False, 3),
    (torch.float32, True, 3),
    (torch.bfloat16, False, 1),
]


@pytest.mark.parametrize(
    ("kind", "dtype", "autocast", "batch"),
    [(kind, *setting) for kind in CASES for setting in SETTINGS[: None if kind == "n1.5" else 2]],
)
def test_equal_seeds_give_equal_actions(kind: str, dtype: torch.dtype, autocast: bool, batch: int) -> None:
    cases.check_equal_seeds(CASES[kind](), batch=batch, dtype=dtype, autocast=autocast)


@pytest.mark.parametrize("precision", ["bfloat16", "int8", "int4"])
def test_other_precisions(precision: str) -> None:
    cases.check_equal_seeds(n15(), batch=2, precision=precision)


@pytest.mark.parametrize("kind", CASES)
def test_restore(kind: str) -> None:
    cases.check_restore(CASES[kind]())


def test_chunking() -> None:
    cases.check_chunking(CASES["n1.7"]())


@pytest.mark.parametrize("change", cases.CHANGES)
def test_weights_that_change_are_taken_anew(change: str) -> None:
    cases.check_changed_weights(n15(), cases.CHANGES[change])


@pytest.mark.parametrize("kind", ["n1.5", "n1.7"])
def test_settings_are_read_live(kind: str) -> None:
    cases.check_settings_are_read_live(CASES[kind]())


def test_copies_hold_the_original() -> None:
    cases.check_copies(n15())


def test_refusals() -> None:
    check_refusals(n15())


def test_threads() -> None:
    cases.check_threads(n15())


class Holder:
    """Isaac-GR00T's policy: an object with a model."""

    def __init__(self, **held: Any) -> None:
        self.__dict__.update(held)


class Model(nn.Module):
    """A model with heads."""

    def __init__(self, **heads: nn.Module) -> None:
        super().__init__()
        for name, head in heads.items():
            self.add_module(name, head)


def test_heads_are_found_where_policies_hold_them() -> None:
    head = n15().head
    model = Model(backbone=nn.Linear(2, 2), action_head=head).eval()
    around = Model(_groot_model=model).eval()
    policies: list[object] = [head, model, around, Holder(model=model), Holder(policy=Holder(model=model))]
    for policy in policies:
        with accelerate(policy) as handle:
            assert handle.module is head
    refused: list[tuple[object, str]] = [
        (Model(one=head, two=n15().head), "found one, two"),
        (nn.Linear(2, 2), "found none"),
        (Holder(model=3), "expected a torch module"),
        (3, "expected a torch module"),
    ]
    for policy, match in refused:
        with pytest.raises(saccade.InputError, match=match):
            accelerate(policy)


def test_only_the_embodiments_asked_for_are_held() -> None:
    case = n15()
    with accelerate(case.head) as handle:
        whole = handle.head.nbytes
    given = cases.inputs(case, batch=3)
    with accelerate(case.head, embodiment_ids=[1]) as handle:
        assert handle.head.nbytes < whole
        with pytest.raises(saccade.InputError, match="embodiment_id"):
            cases.call(case, given)
        given[1]["embodiment_id"][:] = 1
        ours = cases.call(case, given)
    cases.assert_same(ours, cases.call(case, given), cases.EXACT)


def test_a_policy_that_goes_takes_its_weights_along() -> None:
    case = n15()
    handle = accelerate(case.head)
    held = weakref.ref(case.head)
    gc.collect()
    gc.disable()
    try:
        del case
        assert held() is None, "something keeps the torch head"
    finally:
        gc.enable()
    with pytest.raises(saccade.InputError, match="no longer"):
        handle.head  # noqa: B018
    handle.restore()
    assert "restored" in repr(handle)


def test_an_edit_that_is_not_seen_is_taken_by_refresh() -> None:
    case = n15()
    given = cases.inputs(case)
    linear = case.head.model.proj_out_2
    with accelerate(case.head) as handle:
        before = cases.call(case, given)
        linear.bias.data[1] += 5.0  # not one of the values that are compared
        handle.refresh()
        ours = cases.call(case, given)
    assert_other = cases.error(ours.results["action_pred"], before.results["action_pred"])
    assert assert_other > 0.01
    cases.assert_same(ours, cases.call(case, given), cases.EXACT)


def test_weights_of_another_kind_are_listed() -> None:
    case = n15()
    block = case.head.model.transformer_blocks[0]
    block.lora_down = nn.Linear(2, 2)
    with pytest.raises(saccade.CheckpointError, match="lora_down"):
        accelerate(case.head.eval())
    assert "get_action" not in vars(case.head)


def test_the_instrument_works_on_the_policy() -> None:
    case = n15()
    given = cases.inputs(case)
    with accelerate(case.head) as handle:
        context = handle.head.encode(given[0]["backbone_features"])
        trace = handle.head.trace(context, given[1]["state"], given[1]["embodiment_id"], seed=0)
    assert trace.attention[(0, 0)].shape[-1] == 11


def test_inference_mode() -> None:
    """As Isaac-GR00T's policy calls its model."""
    case = n15()
    given = cases.inputs(case)
    theirs = cases.call(case, given)
    with torch.inference_mode(), accelerate(case.head):
        cases.assert_same(cases.call(case, given), theirs, cases.EXACT)


def test_the_benchmark_runs() -> None:
    options = ["--size", "small", "--num-vl-tokens", "9", "--rounds", "1", "--num-threads", "1"]
    command = [sys.executable, "-m", "benches.accelerate", *options, "--precisions", "int8"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.count("| int8 | float32") == 2


def test_the_page_is_what_the_command_writes() -> None:
    page = (ROOT / "docs" / "results" / "compatibility.md").read_text(encoding="utf-8")
    assert page.startswith(compat.INTRODUCTION)
    assert page.endswith(compat.CHECKED)
    for release in compat.RELEASES:
        # Of the oldest one only recordings are tested.
        assert (f"lerobot {release.lerobot} |" in page) == ("policies.py" in release.tests)
        assert f"lerobot=={release.lerobot}\n" in release.packages.read_text() or release.on_top_of == ""


@pytest.mark.parametrize("untrained", ["first", "all"])
def test_embodiments_that_were_never_trained(untrained: str) -> None:
    """They hardly move the noise, and rounding it to bfloat16 is then most of the difference."""
    case = n15()
    chosen = slice(0, 1) if untrained == "first" else slice(None)
    with torch.no_grad():
        for name, parameter in case.head.named_parameters():
            if name.endswith(".W"):
                parameter[chosen] = 0.02 * torch.randn(parameter[chosen].shape)
            elif name.endswith(".b"):
                parameter[chosen] = 0.0
    accelerate(case.head.to(torch.bfloat16)).restore()
    accelerate(case.head.float(), precision="int8").restore()


def test_the_meta_device_is_refused_and_other_default_devices_do_not_matter() -> None:
    case = n15()
    with (
        torch.device("meta"),
        pytest.raises(saccade.DtypeError, match="default device with memory, got meta"),
    ):
        accelerate(case.head)
    assert "get_action" not in vars(case.head)
    with torch.device("cpu"), accelerate(case.head):
        pass
