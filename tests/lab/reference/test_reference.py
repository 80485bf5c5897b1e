"""The torch reference against the released code: its outputs, its tensors, the definition of each part."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call, operator, union-attr"

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

import saccade
from saccade import _saccade
from saccade_lab.reference import ActionHead, TimeDistribution, tables
from saccade_lab.reference.attention import Attention
from saccade_lab.reference.random_weights import (
    CONFIGS,
    random_head,
    random_inputs,
    sized_config,
    unused_parameters,
    whole_config,
)
from tests.helpers.paths import DATA
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import NAMES, VARIANTS, Released, load_released


@pytest.fixture(params=[*NAMES, *VARIANTS])
def released(request: pytest.FixtureRequest) -> Released:
    """Each file of tests/data in turn, those of the variants too."""
    return load_released(request.param)


def test_float64_equals_the_released_code(released: Released) -> None:
    with torch.no_grad():
        actions = ActionHead.from_pretrained(released.path, dtype=torch.float64)(**released.arguments)
    assert actions.dtype == torch.float64
    assert relative_error(actions, released.actions_f64) <= 1e-6


def test_float32_is_as_close_as_the_released_code(released: Released) -> None:
    with torch.no_grad():
        actions = ActionHead.from_pretrained(released.path)(**released.arguments)
    assert actions.dtype == torch.float32
    assert (np.abs(actions.numpy() - released.actions_f64) <= released.tolerance).all()


def test_state_dict_has_the_names_of_the_file(released: Released) -> None:
    with safe_open(released.path, framework="np") as file:
        names = {name.removeprefix("action_head.") for name in file.keys() if name[0] != "_"}  # noqa: SIM118
    assert ActionHead.from_pretrained(released.path).state_dict().keys() == names


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vl_embs_equal_the_released_code(released: Released, dtype: torch.dtype) -> None:
    with torch.no_grad():
        vl_embs = ActionHead.from_pretrained(released.path, dtype=dtype).encode(released.backbone_features)
    assert relative_error(vl_embs, released.vl_embs) <= 4e-6  # the recorded ones are float32


def test_full_size_state_dict_has_the_released_names_and_shapes() -> None:
    expected = {}
    for line in (DATA / "groot_n15_tensors.tsv").read_text().splitlines()[2:]:
        name, shape = line.split("\t")
        expected[name.removeprefix("action_head.")] = tuple(int(size) for size in shape.split("x"))
    head = full_size("n1.5")
    assert {name: tuple(t.shape) for name, t in head.state_dict().items()} == expected


def full_size(kind: str, **sizes: int) -> ActionHead:
    """A head of the published size, without memory."""
    config = sized_config(kind, **sizes)
    with torch.device("meta"):
        return ActionHead(saccade.HeadConfig.from_dict(config), unused=unused_parameters(config))


def count(head: ActionHead) -> int:
    return sum(parameter.numel() for parameter in head.parameters())


@pytest.mark.parametrize(
    ("kind", "transformer", "one_embodiment", "all_embodiments"),
    [
        ("n1.5", 550_386_688, 763_300_896, 1_068_806_144),
        ("n1.6", 1_091_722_240, 1_103_465_600, 1_418_624_000),
        ("n1.7", 1_091_722_240, 1_304_913_028, 1_620_515_968),
        ("fork", 550_386_688, None, 1_101_868_546),
    ],
)
def test_full_size_parameter_counts(
    kind: str, transformer: int, one_embodiment: int | None, all_embodiments: int
) -> None:
    """Counts of the published heads, by the reference and by the Rust head's list of tensors."""
    head = full_size(kind)
    assert count(head) == all_embodiments
    assert sum(parameter.numel() for parameter in head.model.parameters()) == transformer
    if one_embodiment is not None:
        assert count(full_size(kind, num_embodiments=1)) == one_embodiment


@pytest.mark.parametrize("kind", CONFIGS)
def test_the_rust_head_lists_the_same_tensors(kind: str) -> None:
    names = {name: list(tensor.shape) for name, tensor in full_size(kind).state_dict().items()}
    listed = dict(_saccade.tensor_shapes(json.dumps(whole_config(CONFIGS[kind]))))
    if kind in ("n1", "n1.6", "n1.7"):
        assert listed.pop("future_tokens.weight", [0, 1536]) == [0, 1536]  # none, and not stored
    assert names == listed | {name: [] for name in unused_parameters(CONFIGS[kind])}


def test_new_head_starts_as_released() -> None:
    head = ActionHead(
        saccade.HeadConfig.from_dict(small_config(num_heads=16, head_dim=8, num_future_tokens=64))
    )
    for table in (head.future_tokens.weight, head.state_encoder.layer1.W, head.action_encoder.W2.W):
        assert table.std().item() == pytest.approx(0.02, rel=0.2)
    assert (head.action_encoder.W2.b == 0).all()
    assert (head.vlln.weight == 1).all()
    assert (head.vlln.bias == 0).all()
    bound = 1 / math.sqrt(head.config.width)
    assert head.model.proj_out_2.weight.abs().max().item() == pytest.approx(bound, rel=0.05)


def test_modules_are_only_those_of_the_config() -> None:
    config = saccade.HeadConfig.from_dict(small_config(use_vlln=False, add_pos_embed=False))
    names = ActionHead(config).state_dict().keys()
    assert not any(name.startswith(("vlln", "vl_self_attention", "position_embedding")) for name in names)
    features = torch.randn(1, 2, 10)
    assert torch.equal(ActionHead(config).encode(features), features)
    assert isinstance(
        ActionHead(saccade.HeadConfig.from_dict(small_config(vl_num_layers=0))).vlln, nn.LayerNorm
    )


# The two tables


def test_tables_are_correctly_rounded() -> None:
    log_10000 = np.float32(math.log(10000.0))
    buckets, width = [0, 1, 250, 907, 999], 12
    sines_first = tables.action_time_table(torch.tensor(buckets), width).numpy()
    cosines_first = tables.timestep_table(torch.tensor(buckets)).numpy()
    for row, bucket in enumerate(buckets):
        for i in range(width // 2):
            exponent = np.float32(-i) * np.float32(log_10000 / np.float32(width // 2))
            angle = float(np.float32(bucket) * np.float32(math.exp(exponent)))
            assert sines_first[row, i] == np.float32(math.sin(angle))
            assert sines_first[row, width // 2 + i] == np.float32(math.cos(angle))
        for i in range(128):
            exponent = np.float32(np.float32(-log_10000 * np.float32(i)) / np.float32(127))
            angle = float(np.float32(bucket) * np.float32(math.exp(exponent)))
            assert cosines_first[row, i] == np.float32(math.cos(angle))
            assert cosines_first[row, 128 + i] == np.float32(math.sin(angle))


# Attention


def random_attention() -> tuple[Attention, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    attention = Attention(width=12, context_dim=10, num_heads=3, head_dim=4).double()
    return attention, torch.randn(2, 5, 12).double(), torch.randn(2, 7, 10).double()


def test_attention_equals_loops_over_heads() -> None:
    attention, x, context = random_attention()
    out, weights = attention(x, context, return_weights=True)
    q, k, v = attention.to_q(x), attention.to_k(context), attention.to_v(context)
    for row in range(2):
        heads = []
        for head in range(3):
            columns = slice(4 * head, 4 * head + 4)
            logits = q[row, :, columns] @ k[row, :, columns].T / 2.0
            probabilities = logits.exp() / logits.exp().sum(dim=1, keepdim=True)
            torch.testing.assert_close(weights[row, head], probabilities)
            heads.append(probabilities @ v[row, :, columns])
        torch.testing.assert_close(out[row], attention.to_out[0](torch.cat(heads, dim=1)))


@pytest.mark.parametrize("shape", [None, (7,), (5, 7), (2, 1, 1, 7), (2, 3, 5, 7)])
def test_attention_is_the_same_with_and_without_weights(shape: tuple[int, ...] | None) -> None:
    attention, x, context = random_attention()
    bias = None if shape is None else torch.randn(shape, generator=torch.Generator().manual_seed(0)).double()
    if bias is not None:
        bias[..., 3] = -torch.inf
    plain, none = attention(x, context, logit_bias=bias)
    written_out, _ = attention(x, context, logit_bias=bias, return_weights=True)
    assert none is None
    torch.testing.assert_close(plain, written_out)


@pytest.mark.parametrize("return_weights", [False, True])
def test_minus_infinity_removes_a_key(return_weights: bool) -> None:
    attention, x, context = random_attention()
    bias = torch.zeros(7).double()
    bias[[1, 4]] = -torch.inf
    out, weights = attention(x, context, logit_bias=bias, return_weights=return_weights)
    without, _ = attention(x, context[:, [0, 2, 3, 5, 6]])
    torch.testing.assert_close(out, without)
    assert not return_weights or (weights[..., [1, 4]] == 0).all()


@pytest.mark.parametrize("return_weights", [False, True])
def test_a_query_with_no_key_left_gets_the_bias_and_finite_gradients(return_weights: bool) -> None:
    attention, x, context = random_attention()
    x.requires_grad_()
    bias = torch.zeros(5, 7).double()
    bias[2] = -torch.inf
    out, weights = attention(x, context, logit_bias=bias, return_weights=return_weights)
    assert not return_weights or (weights[:, :, 2] == 0).all()
    torch.testing.assert_close(out[:, 2], attention.to_out[0].bias.expand(2, 12))
    out.sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in attention.parameters())


# Sampling


@pytest.mark.parametrize(
    ("num_steps", "buckets"), [(1, [0]), (4, [0, 250, 500, 750]), (7, [0, 142, 285, 428, 571, 714, 857])]
)
def test_sample_takes_equal_steps_through_these_buckets(num_steps: int, buckets: list[int]) -> None:
    head = random_head(small_config(), seed=1, dtype=torch.float64)
    inputs = random_inputs(head.config, seed=2, batch=2, num_vl_tokens=6)
    vl_embs, noise = head.encode(inputs["backbone_features"]), inputs["noise"].double()
    actions = noise
    for bucket in buckets:
        actions = actions + head.velocity(
            vl_embs, inputs["state"], inputs["embodiment_id"], actions, torch.tensor([bucket, bucket])
        ) / len(buckets)
    sampled = head.sample(vl_embs, inputs["state"], inputs["embodiment_id"], noise=noise, num_steps=num_steps)
    torch.testing.assert_close(sampled, actions)


def test_numpy_inputs_and_flat_state_are_the_same() -> None:
    head = random_head(small_config(), seed=1)
    inputs = random_inputs(head.config, seed=2, batch=2, num_vl_tokens=6)
    with torch.no_grad():
        expected = head(**inputs)
        arrays = {name: tensor.numpy() for name, tensor in inputs.items()}
        arrays["state"] = arrays["state"][:, 0]
        assert torch.equal(head(**arrays), expected)


def test_one_embodiment_for_all_equals_one_per_row() -> None:
    head = random_head(small_config(), seed=1, dtype=torch.float64)
    inputs = random_inputs(head.config, seed=2, batch=3, num_vl_tokens=6)
    inputs["embodiment_id"] = torch.tensor([2, 2, 2])
    expected = head(**inputs)
    torch.testing.assert_close(head(**(inputs | {"embodiment_id": 2})), expected)
    torch.testing.assert_close(head(**(inputs | {"embodiment_id": np.int64(2)})), expected)


@pytest.mark.parametrize("name", ["backbone_features", "state", "embodiment_id", "noise"])
def test_other_shapes_are_refused_by_name(name: str) -> None:
    head = random_head(small_config(), seed=1)
    inputs = random_inputs(head.config, seed=2, batch=2, num_vl_tokens=6)
    for wrong in (inputs[name][:1], inputs[name][..., :1], inputs[name][None]):
        if name == "backbone_features" and wrong.shape[0] == 1 and wrong.ndim == 3:
            continue  # another batch: then it is the others that do not fit
        with pytest.raises(saccade.ShapeError, match=name):
            head(**(inputs | {name: wrong}))


def test_values_out_of_range_are_refused() -> None:
    head = random_head(small_config(), seed=1)
    inputs: dict[str, Any] = random_inputs(head.config, seed=2, batch=2, num_vl_tokens=6)
    for ids in (3, -1, torch.tensor([0, 3]), 1.0, torch.tensor([True, False])):
        with pytest.raises(saccade.InputError, match="embodiment_id"):
            head(**(inputs | {"embodiment_id": ids}))
    for steps in (0, -1, 1001):
        with pytest.raises(saccade.InputError, match="num_steps"):
            head(**inputs, num_steps=steps)


# Training


def numpy_loss(head: ActionHead, given: dict[str, np.ndarray], mask: np.ndarray) -> float:
    total, weight = 0.0, 0.0
    for row in range(len(given["time"])):
        t = given["time"][row]
        noisy = (1 - t) * given["noise"][row] + t * given["actions"][row]
        velocity = head.velocity(
            head.encode(given["backbone_features"][row : row + 1]),
            given["state"][row : row + 1],
            int(given["embodiment_id"][row]),
            noisy[None],
            math.floor(t * 1000),
        )
        error = velocity[0].detach().numpy() - (given["actions"][row] - given["noise"][row])
        total += float((error**2 * mask[row]).sum())
        weight += float(mask[row].sum())
    return total / weight


def training_batch(head: ActionHead, batch: int) -> dict[str, np.ndarray]:
    inputs = random_inputs(head.config, seed=3, batch=batch, num_vl_tokens=6)
    given = {name: tensor.numpy().astype(np.float64) for name, tensor in inputs.items()}
    rng = np.random.default_rng(4)
    return given | {
        "embodiment_id": inputs["embodiment_id"].numpy(),
        "actions": rng.standard_normal(given["noise"].shape),
        "time": rng.uniform(0, 0.999, size=batch),
    }


def test_loss_is_the_masked_mean_of_squared_velocity_errors() -> None:
    head = random_head(small_config(), seed=1, dtype=torch.float64)
    given = training_batch(head, batch=4)
    mask = np.random.default_rng(5).integers(0, 2, size=given["actions"].shape).astype(np.float64)
    assert head.loss(**given).item() == pytest.approx(numpy_loss(head, given, np.ones_like(mask)), rel=1e-12)
    assert head.loss(**given, action_mask=mask).item() == pytest.approx(
        numpy_loss(head, given, mask), rel=1e-12
    )
    per_dimension = mask[:, :1]
    expected = numpy_loss(head, given, np.broadcast_to(per_dimension, mask.shape))
    assert head.loss(**given, action_mask=per_dimension).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("interleave", [True, False])
def test_every_used_parameter_gets_a_gradient(interleave: bool) -> None:
    head = random_head(small_config(interleave=interleave), seed=1, dtype=torch.float64)
    given = training_batch(head, batch=4) | {"embodiment_id": np.array([0, 2, 0, 2])}
    head.loss(**given).backward()
    # Among cross-attention blocks alone no action row reads the state or future rows.
    # A key's bias shifts all logits of a query alike.
    without = () if interleave else ("future_tokens", "state_encoder")
    for name, parameter in head.named_parameters():
        assert parameter.grad is not None, name
        gradient = parameter.grad
        if name.startswith(without):
            assert (gradient == 0).all(), name
        elif name.endswith("to_k.bias"):
            assert gradient.abs().max() < 1e-12, name
        elif name == "position_embedding.weight":
            horizon = head.config.action_horizon
            assert (gradient[:horizon] != 0).all()
            assert (gradient[horizon:] == 0).all()
        elif name.endswith((".W", ".b")):
            assert gradient[0].any(), name
            assert gradient[2].any(), name
            assert not gradient[1].any(), name
        else:
            assert gradient.any(), name


def test_gradients_equal_finite_differences() -> None:
    head = random_head(small_config(num_layers=2), seed=1, dtype=torch.float64)
    given = training_batch(head, batch=2)
    features = torch.tensor(given.pop("backbone_features"), requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: head.loss(x, **given), (features,), fast_mode=True)


def test_sample_time_follows_the_distribution() -> None:
    config = saccade.HeadConfig.from_dict(small_config())
    head = ActionHead(config, time_distribution=TimeDistribution(alpha=3.0, beta=2.0, scale=0.9))
    times = head.sample_time(20_000, torch.Generator().manual_seed(0))
    assert times.dtype == torch.float32
    assert times.min() >= 0
    assert times.max() <= 0.9
    assert times.mean().item() == pytest.approx(0.9 * (1 - 3 / 5), abs=0.005)
    assert torch.equal(times, head.sample_time(20_000, torch.Generator().manual_seed(0)))


def test_training_lowers_the_loss() -> None:
    torch.manual_seed(0)
    head = ActionHead(saccade.HeadConfig.from_dict(small_config(num_heads=4, head_dim=8)))
    given = training_batch(head, batch=8)
    optimizer = torch.optim.AdamW(head.parameters(), lr=3e-3)
    losses = []
    for _ in range(100):
        loss = head.loss(**given)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.4 * losses[0]
