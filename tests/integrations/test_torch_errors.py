"""What the torch module refuses: gradients, dropout, other devices, wrong arguments and other attention."""

from __future__ import annotations

import pytest
import torch

import saccade
from saccade.torch import CrossAttention, cross_attention
from tests.helpers.attention_cases import HEADS, assert_matches, attention, in_float64, tensors


def test_gradients_are_refused() -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    for args in ((states.requires_grad_(), context), (states.detach(), context.requires_grad_())):
        with pytest.raises(saccade.InputError, match=r"no gradient.*no_grad"):
            ours(*args)
        with torch.no_grad():
            assert not ours(*args).requires_grad
    with pytest.raises(saccade.InputError, match="no gradient"):
        ours.requires_grad_()(*tensors())
    weights = [tensor.detach() for tensor in ours.parameters()]
    output = cross_attention(states.requires_grad_(), context, None, weights, HEADS, "float32")
    with pytest.raises(RuntimeError, match=r"saccade.*cross_attention.*no autograd"):
        output.sum().backward()


def test_dropout_is_refused_in_training_mode() -> None:
    states, context = tensors()
    ours = CrossAttention.from_attention(attention().train())
    assert ours.training
    with pytest.raises(saccade.InputError, match="dropout"):
        ours(states, context)
    assert_matches(ours.eval()(states, context), in_float64(attention(), states, context))
    CrossAttention.from_attention(attention(dropout=0.0).train())(states, context)


def test_other_devices_are_refused() -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    with pytest.raises(saccade.DtypeError, match=r"CPU.*meta"):
        ours.to("meta")
    with pytest.raises(saccade.DtypeError, match=r"hidden_states.*CPU.*meta"):
        ours(states.to("meta"), context)
    with pytest.raises(saccade.DtypeError, match=r"encoder_hidden_states.*CPU.*meta"):
        ours(states, context.to("meta"))
    assert ours.to("cpu")(states, context).shape == states.shape


@pytest.mark.parametrize(
    ("error", "message", "args"),
    [
        (saccade.ShapeError, r"^hidden_states: expected \(batch, queries, 51\), got \(5, 51\)", ((5, 51),)),
        (saccade.ShapeError, r"hidden_states: .*got \(2, 5, 52\)", ((2, 5, 52), (2, 7, 29))),
        (saccade.ShapeError, r"encoder_hidden_states: .*\(batch, T_vl, 29\)", ((2, 5, 51),)),
        (saccade.ShapeError, r"encoder_hidden_states: .*got \(2, 7, 28\)", ((2, 5, 51), (2, 7, 28))),
        (saccade.ShapeError, r"encoder_hidden_states: .*batch.* 2, got 3", ((2, 5, 51), (3, 7, 29))),
        (saccade.ShapeError, r"attention_mask: .*\(2, 7\).*got \(2, 8\)", ((2, 5, 51), (2, 7, 29), (2, 8))),
        (saccade.ShapeError, r"attention_mask: .*\(2, 5, 7\)", ((2, 5, 51), (2, 7, 29), (2, 5, 7))),
        (saccade.ShapeError, r"attention_mask: .*got \(7,\)", ((2, 5, 51), (2, 7, 29), (7,))),
        (saccade.ShapeError, r"attention_mask: .*\(6, 1, 7\)", ((2, 5, 51), (2, 7, 29), (6, 1, 7))),
    ],
)
def test_shapes_are_checked(error: type[Exception], message: str, args: tuple[tuple[int, ...], ...]) -> None:
    ours = CrossAttention.from_attention(attention())
    with pytest.raises(error, match=message):
        ours(*(torch.ones(shape) for shape in args))


def test_values_and_dtypes_are_checked() -> None:
    ours = CrossAttention.from_attention(attention())
    states, context = tensors()
    with pytest.raises(saccade.DtypeError, match=r"hidden_states: .*int64"):
        ours(states.long(), context)
    with pytest.raises(saccade.DtypeError, match=r"attention_mask: .*int64"):
        ours(states, context, torch.ones(2, 7).long())
    with pytest.raises(saccade.InputError, match=r"encoder_hidden_states: .*NaN"):
        ours(states, context * torch.nan)
    with pytest.raises(TypeError, match="encoder_attention_mask"):
        ours(states, context, encoder_attention_mask=torch.ones(2, 7))  # diffusers ignores it


def test_what_groot_does_not_use_is_refused() -> None:
    unfit = attention(qk_norm="layer_norm", rescale_output_factor=2.0, residual_connection=True)
    with pytest.raises(
        saccade.InputError, match=r"norm_q.*norm_k.*residual_connection.*rescale_output_factor"
    ):
        CrossAttention.from_attention(unfit)
    with pytest.raises(saccade.CheckpointError, match=r"to_q\.bias"):
        CrossAttention.from_attention(attention(bias=False))
    with pytest.raises(saccade.CheckpointError):
        CrossAttention.from_attention(attention(kv_heads=1))
    with pytest.raises(saccade.InputError, match=r"heads.*divisor"):
        CrossAttention(attention().state_dict(), 4)
    with pytest.raises(saccade.InputError, match="processor"):
        CrossAttention.from_attention(torch.nn.Linear(3, 3))
