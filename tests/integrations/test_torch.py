"""The torch module compared with diffusers' Attention, under torch's compilers, and with changed weights."""

from __future__ import annotations

import copy
import gc
import io
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from diffusers.models.attention import Attention

import saccade
import saccade.torch
from saccade.torch import NAMES, CrossAttention, cross_attention
from saccade_lab.reference import lerobot_head
from tests.helpers.attention_cases import (
    CONTEXT_DIM,
    HEADS,
    WIDTH,
    assert_matches,
    attention,
    in_float64,
    tensors,
)
from tests.helpers.reference_cases import small_config


@pytest.fixture
def packings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one entry whenever weights are packed."""
    counted: list[int] = []
    engine = saccade.CrossAttention

    def count(*args: Any, **options: Any) -> saccade.CrossAttention:
        counted.append(len(counted))
        return engine(*args, **options)

    monkeypatch.setattr("saccade.torch.PackedAttention", count)
    return counted


@pytest.mark.parametrize(("batch", "queries", "keys"), [(1, 1, 1), (2, 5, 7), (3, 49, 131), (1, 17, 64)])
@pytest.mark.parametrize("masked", ["", "bool", "float", "removed"])
def test_equals_diffusers(batch: int, queries: int, keys: int, masked: str) -> None:
    module = attention()
    states, context = tensors(batch, queries, keys)
    mask = torch.randn(batch, keys)
    if masked == "bool":
        mask = mask > 0
        mask[0, 0] = True
    if masked == "removed":
        mask[:, 1::2] = -torch.inf
    given = mask if masked else None
    expected = in_float64(module, states, context, given)
    assert_matches(CrossAttention.from_attention(module)(states, context, given), expected)


@pytest.mark.parametrize("heads", [1, HEADS, WIDTH])
def test_self_attention_equals_diffusers(heads: int) -> None:
    module = attention(context_dim=None, heads=heads, dim_head=WIDTH // heads)
    states, _ = tensors()
    ours = CrossAttention.from_attention(module)
    expected = in_float64(module, states)
    assert_matches(ours(states), expected)
    assert_matches(ours(states, None, torch.ones(2, 5, dtype=torch.bool)), expected)


def test_masks_of_all_forms() -> None:
    module = attention()
    ours = CrossAttention.from_attention(module)
    states, context = tensors()
    for mask in (torch.rand(2, 7) > 0.3, torch.randn(2, 7)):
        expected = in_float64(module, states, context, mask)
        for shape in ((2, 7), (2, 1, 7), (2, 1, 1, 7)):
            given = mask.reshape(shape)
            torch.testing.assert_close(in_float64(module, states, context, given), expected, rtol=0, atol=0)
            assert_matches(ours(states, context, given), expected)
    lowest = torch.zeros(2, 7).masked_fill(torch.rand(2, 7) > 0.5, torch.finfo(torch.float32).min)
    assert_matches(ours(states, context, lowest), in_float64(module, states, context, lowest))


def test_no_key_left_gives_the_output_bias() -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    bias = ours.state_dict()["to_out.0.bias"]
    mask = torch.ones(2, 7, dtype=torch.bool)
    mask[1] = False
    assert_matches(ours(states, context, mask)[1], bias.double().expand(5, WIDTH))
    empty = ours(states, context[:, :0])
    torch.testing.assert_close(empty, bias.expand(2, 5, WIDTH), rtol=0, atol=0)


@pytest.mark.parametrize(("batch", "queries"), [(0, 5), (2, 0), (0, 0)])
def test_nothing_to_do(batch: int, queries: int) -> None:
    module = attention()
    states, context = tensors(batch, queries)
    assert CrossAttention.from_attention(module)(states, context).shape == (batch, queries, WIDTH)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
def test_other_dtypes(dtype: torch.dtype) -> None:
    """bfloat16 weights and inputs: what float64 makes of the same values, rounded once."""
    module = attention().to(dtype)
    states, context = (value.to(dtype) for value in tensors())
    output = CrossAttention.from_attention(module)(states, context, torch.rand(2, 7).to(dtype))
    assert output.dtype == dtype
    output = CrossAttention.from_attention(module)(states, context)
    expected = in_float64(module, states, context)
    assert_matches(output, expected, max(torch.finfo(dtype).eps, 1e-6))


@pytest.mark.parametrize("compiled", [False, True])
def test_autocast(compiled: bool) -> None:
    module = attention()
    ours = CrossAttention.from_attention(module)
    states, context = tensors()
    called = torch.compile(ours, fullgraph=True, backend="aot_eager") if compiled else ours
    with torch.autocast("cpu", torch.bfloat16):
        output, theirs = called(states, context), module(states, context)
    assert output.dtype == theirs.dtype == torch.bfloat16
    assert torch.equal(output, ours(states, context).bfloat16())
    assert called(states, context).dtype == torch.float32


@pytest.mark.parametrize("precision", ["bfloat16", "int8", "int4"])
def test_precisions_are_the_engines(precision: str) -> None:
    module = attention()
    states, context = tensors()
    engine = saccade.CrossAttention(module.state_dict(), HEADS, precision=precision)
    ours = CrossAttention.from_attention(module, precision=precision)
    assert torch.equal(ours(states, context), engine(states, engine.project(context)))  # type: ignore[arg-type]
    assert precision in repr(ours)


def test_strides() -> None:
    module = attention()
    states, context = tensors()
    turned = states.transpose(0, 1).contiguous().transpose(0, 1)
    expected = in_float64(module, states, context)
    output = CrossAttention.from_attention(module)(turned, context.expand(2, 7, CONTEXT_DIM))
    assert output.is_contiguous()
    assert_matches(output, expected)
    weights = module.state_dict()
    for name in ("to_q.weight", "to_k.weight"):
        weights[name] = weights[name].T.contiguous().T
    assert_matches(CrossAttention(weights, HEADS)(states, context), expected)


def test_in_the_released_head() -> None:
    """Every attention of lerobot's own head replaced: the same actions."""
    config = small_config(num_layers=5, head_dim=6, vl_num_layers=2)
    torch.manual_seed(4)
    theirs = lerobot_head.build(config)
    inputs = (torch.randn(2, 9, 10), torch.randn(2, 1, 6), torch.tensor([2, 0]), torch.randn(2, 5, 3))
    expected = lerobot_head.get_action(theirs, *inputs)
    replaced = 0
    for parent in list(theirs.modules()):
        for name, child in parent.named_children():
            if isinstance(child, Attention):
                setattr(parent, name, CrossAttention.from_attention(child))
                replaced += 1
    assert replaced == 7
    assert expected.std() > 0.1
    torch.testing.assert_close(lerobot_head.get_action(theirs, *inputs), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("dtype", "mask", "precision"),
    [
        (torch.float32, None, "float32"),
        (torch.float32, torch.rand(2, 7) > 0.5, "float32"),
        (torch.bfloat16, torch.randn(2, 7), "float32"),
        (torch.float16, None, "int8"),
    ],
)
def test_opcheck(dtype: torch.dtype, mask: torch.Tensor | None, precision: str) -> None:
    weights = [attention().state_dict()[name] for name in NAMES]
    states, context = (value.to(dtype) for value in tensors())
    checks = torch.library.opcheck(cross_attention, (states, context, mask, weights, HEADS, precision))
    assert set(checks.values()) == {"SUCCESS"}
    assert len(checks) >= 4
    torch.library.opcheck(cross_attention, (states, context[:, :0], None, weights, HEADS, precision))


class Block(torch.nn.Module):
    """A block that attends to the tokens and then to itself, as GR00T's do."""

    def __init__(self, *attentions: torch.nn.Module) -> None:
        super().__init__()
        self.cross, self.own = attentions

    def forward(self, states: torch.Tensor, context: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        states = states + self.cross(torch.tanh(states), encoder_hidden_states=context, attention_mask=mask)
        output: torch.Tensor = states + self.own(
            torch.tanh(states), encoder_hidden_states=None, attention_mask=None
        )
        return output


def blocks() -> tuple[Block, Block]:
    theirs = Block(attention(2), attention(3, None))
    return theirs, Block(*(CrossAttention.from_attention(module) for module in theirs.children()))


@torch.no_grad()
def test_compile(packings: list[int]) -> None:
    """One graph, no packing beyond the first, new sizes and changed weights included."""
    theirs, ours = blocks()
    assert len(packings) == 2
    compiled = torch.compile(ours, fullgraph=True, dynamic=True, backend="aot_eager")
    for batch, queries, keys in ((2, 5, 7), (3, 4, 9)):
        states, context = tensors(batch, queries, keys)
        mask = torch.ones(batch, keys, dtype=torch.bool)
        mask[:, 1] = False
        assert_matches(compiled(states, context, mask), in_float64(theirs, states, context, mask))
    assert len(packings) == 2
    ours.own.to_v.weight.mul_(2)  # type: ignore[union-attr,operator]
    assert_matches(compiled(states, context, mask), in_float64(theirs, states, context, mask))
    assert len(packings) == 3


def test_inductor() -> None:
    """The default backend; the module alone, so that nothing is left for a C++ compiler."""
    module = attention()
    states, context = tensors()
    with torch.inference_mode():
        output = torch.compile(CrossAttention.from_attention(module), fullgraph=True)(states, context)
    assert_matches(output, in_float64(module, states, context))


def test_export(packings: list[int]) -> None:
    theirs, ours = blocks()
    states, context = tensors()
    mask = torch.ones(2, 7, dtype=torch.bool)
    tokens = torch.export.Dim("tokens", min=2, max=500)
    shapes = {"states": None, "context": {1: tokens}, "mask": {1: tokens}}
    program = torch.export.export(ours, (states, context, mask), dynamic_shapes=shapes)
    assert "torch.ops.saccade.cross_attention.default" in program.graph_module.code
    file = io.BytesIO()
    torch.export.save(program, file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    packings.clear()
    for keys in (7, 31):
        context, mask = tensors(keys=keys)[1], torch.rand(2, keys) > 0.2
        expected = in_float64(theirs, states, context, mask)
        assert_matches(program.module()(states, context, mask), expected)
        assert_matches(loaded(states, context, mask), expected)
    assert len(packings) == 2  # the loaded weights, once


@pytest.mark.parametrize(
    "change",
    [
        lambda weight: weight.mul_(1.5),
        lambda weight: weight.data.mul_(1.5),
        lambda weight: weight.data[3].neg_(),
        lambda weight: weight.data[:, 3].neg_(),
        lambda weight: weight.data.copy_(weight.data.flip(0)),
        lambda weight: weight.data[7, 11].add_(1),
        lambda weight: weight.detach().numpy()[0, 0:1].fill(3),
        lambda weight: setattr(weight, "data", weight.data * 2),
        lambda weight: weight.data[10:30, 5:25].neg_(),
    ],
)
@pytest.mark.parametrize("name", ["to_q", "to_k", "to_v", "to_out.0"])
def test_changed_weights_are_seen(change: Callable[[torch.Tensor], object], name: str) -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    before = ours(states, context)
    change(ours.get_submodule(name).weight)  # type: ignore[arg-type]
    fresh = CrossAttention({name: tensor.clone() for name, tensor in ours.state_dict().items()}, HEADS)
    after = ours(states, context)
    assert torch.equal(after, fresh(states, context))
    assert not torch.equal(after, before)


def test_a_changed_bias_is_seen() -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    before = ours(states, context)
    ours.to_out[0].bias.data[4] += 1  # type: ignore[operator,index]
    difference = ours(states, context) - before
    assert_matches(difference[..., 4], torch.ones(2, 5).double())
    assert difference[..., [3, 5]].abs().max() == 0


def test_weights_are_shared_with_the_module_they_came_from(packings: list[int]) -> None:
    module = attention()
    ours = CrossAttention.from_attention(module)
    states, context = tensors()
    with torch.no_grad():
        module.to_k.weight.normal_()
    assert ours.to_k.weight.data_ptr() == module.to_k.weight.data_ptr()
    assert_matches(ours(states, context), in_float64(module, states, context))
    assert len(packings) == 2


def test_loading_a_state_dict(packings: list[int]) -> None:
    ours = CrossAttention.from_attention(attention())
    other = attention(seed=9)
    assert list(ours.state_dict()) == list(other.state_dict())
    ours.load_state_dict(other.state_dict())
    states, context = tensors()
    expected = in_float64(other, states, context)
    for _ in range(3):
        assert_matches(ours(states, context), expected)
    assert len(packings) == 2
    other.load_state_dict(ours.state_dict())  # and the other way


def test_copies_and_pickles() -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    expected = ours(states, context)
    copies = [copy.deepcopy(ours), pickle.loads(pickle.dumps(ours))]
    file = io.BytesIO()
    torch.save(ours, file)
    file.seek(0)
    copies.append(torch.load(file, weights_only=False))
    with torch.no_grad():
        ours.to_q.weight.zero_()
    for module in copies:
        assert torch.equal(module(states, context), expected)
        assert not torch.equal(ours(states, context), expected)
        assert module.heads == HEADS


def test_dtype_of_the_weights_may_change() -> None:
    module = attention()
    ours = CrossAttention.from_attention(module)
    states, context = tensors()
    ours.bfloat16()
    assert_matches(ours(states, context), in_float64(module.bfloat16(), states, context))


def test_packed_weights_go_with_the_weights(packings: list[int]) -> None:
    gc.collect()
    held = saccade.torch._PACKED
    before = len(held)
    ours = CrossAttention({name: tensor.clone() for name, tensor in attention().state_dict().items()}, HEADS)
    states, context = tensors()
    ours(states, context)
    ours.double()
    ours(states, context)
    assert len(held) == before + 1
    del ours
    gc.collect()
    assert len(held) == before


def test_weights_made_in_inference_mode() -> None:
    states, context = tensors()
    with torch.inference_mode():
        module = attention()
        ours = CrossAttention.from_attention(module)
        ours.to_q.weight.mul_(2)
        assert_matches(ours(states, context), in_float64(module, states, context))


def test_saccade_alone_imports_no_torch() -> None:
    code = "import sys, saccade; sys.exit('torch' in sys.modules or 'saccade.torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
