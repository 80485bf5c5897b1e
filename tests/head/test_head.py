"""The head and the cross-attention through the public API: what is pinned besides the numbers."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open

import saccade
from tests.helpers.released import Released, load_released


def load(released: Released, **options: Any) -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(released.path, config=released.config, **options)


@pytest.fixture
def tiny() -> Released:
    """The smallest file: batch 2, five embodiments."""
    return load_released("n15_tiny")


@pytest.fixture
def head(tiny: Released) -> saccade.ActionHead:
    return load(tiny)


@pytest.fixture
def context(head: saccade.ActionHead, tiny: Released) -> saccade.Context:
    return head.encode(tiny.backbone_features)


def test_released_outputs_on_every_instruction_set(released: Released, isa: str) -> None:
    head = load(released)
    assert head.isa == isa
    context = head.encode(released.backbone_features)
    np.testing.assert_allclose(context.vl_embs, released.vl_embs, atol=5e-6)
    actions = head.sample(context, released.state, released.embodiment_id, noise=released.noise)
    assert actions.dtype == np.float32
    assert (np.abs(actions - released.actions_f64) <= released.tolerance).all()


def test_bits_do_not_depend_on_threads(released: Released, isa: str) -> None:
    def chunk(threads: int) -> Any:
        head = load(released, num_threads=threads)
        assert head.num_threads == threads
        return head(released.backbone_features, released.state, released.embodiment_id, noise=released.noise)

    alone = chunk(1)
    for threads in (2, 3, 8):
        np.testing.assert_array_equal(chunk(threads), alone)


def test_bits_do_not_depend_on_the_batch(tiny: Released, isa: str) -> None:
    head = load(tiny)
    rng = np.random.default_rng(0)
    picks = [0, 1, 1, 0, 1]
    features, state = tiny.backbone_features[picks], rng.standard_normal((5, 7), np.float32)
    ids, noise = [0, 4, 2, 2, 1], rng.standard_normal((5, 6, 5), np.float32)
    together = head(features, state, ids, noise=noise)
    for row in range(5):
        one = slice(row, row + 1)
        alone = head(features[one], state[one], ids[row], noise=noise[one])
        np.testing.assert_array_equal(together[one], alone)


def test_samples_share_a_context_and_have_the_bits_of_single_calls(
    head: saccade.ActionHead, context: saccade.Context, tiny: Released
) -> None:
    noise = np.random.default_rng(1).standard_normal((2, 3, 6, 5), np.float32)
    many = head.sample(context, tiny.state, tiny.embodiment_id, noise=noise, num_samples=3)
    assert many.shape == (2, 3, 6, 5)
    for sample in range(3):
        one = head.sample(context, tiny.state, tiny.embodiment_id, noise=noise[:, sample])
        np.testing.assert_array_equal(many[:, sample], one)
    assert head.sample(context, tiny.state, 0, seed=0, num_samples=1).shape == (2, 1, 6, 5)


def test_seeds(head: saccade.ActionHead, context: saccade.Context, tiny: Released) -> None:
    def draw(**options: Any) -> Any:
        return head.sample(context, tiny.state, 1, **options)

    noise = np.random.default_rng(3).standard_normal((2, 6, 5), dtype=np.float32)
    np.testing.assert_array_equal(draw(seed=3), draw(noise=noise))
    np.testing.assert_array_equal(draw(seed=3), draw(seed=3))
    generator = np.random.default_rng(3)
    np.testing.assert_array_equal(draw(seed=generator), draw(seed=3))
    assert (draw(seed=generator) != draw(seed=3)).any()
    assert (draw() != draw()).any()


def test_euler_steps_are_velocities(
    head: saccade.ActionHead, context: saccade.Context, tiny: Released
) -> None:
    for num_steps, buckets in ((1, [0]), (4, [0, 250, 500, 750]), (7, [0, 142, 285, 428, 571, 714, 857])):
        x = tiny.noise.copy()
        for bucket in buckets:
            v = head.velocity(context, tiny.state, tiny.embodiment_id, x, bucket)
            x += np.float32(1 / num_steps) * np.asarray(v)
        sampled = head.sample(context, tiny.state, tiny.embodiment_id, noise=tiny.noise, num_steps=num_steps)
        np.testing.assert_array_equal(sampled, x)


def test_each_row_has_its_own_timestep(
    head: saccade.ActionHead, context: saccade.Context, tiny: Released
) -> None:
    both = head.velocity(context, tiny.state, tiny.embodiment_id, tiny.noise, [17, 999])
    for row, bucket in enumerate((17, 999)):
        alone = head.velocity(context, tiny.state, tiny.embodiment_id, tiny.noise, bucket)
        np.testing.assert_array_equal(both[row], alone[row])


def test_a_bounded_cache_changes_no_bit(tiny: Released) -> None:
    head = load(tiny)
    context = head.encode(tiny.backbone_features)

    def chunk() -> Any:
        return head.sample(context, tiny.state, tiny.embodiment_id, noise=tiny.noise)

    before = chunk()
    for bucket in range(300):  # more buckets than are kept
        head.velocity(context, tiny.state, tiny.embodiment_id, tiny.noise, bucket)
    np.testing.assert_array_equal(chunk(), before)


def test_encode_then_sample_is_the_call(head: saccade.ActionHead, tiny: Released) -> None:
    context = head.encode(tiny.backbone_features)
    split = [head.sample(context, tiny.state, 2, noise=tiny.noise) for _ in range(2)]
    whole = head(tiny.backbone_features, tiny.state, 2, noise=tiny.noise)
    for chunk in split:
        np.testing.assert_array_equal(chunk, whole)


@pytest.mark.parametrize("convert", ["strided", "float64", "float16", "torch", "torch bfloat16", "list"])
def test_kinds_of_arrays(head: saccade.ActionHead, tiny: Released, convert: str) -> None:
    def converted(array: NDArray[np.float32]) -> Any:
        if convert == "strided":
            return np.repeat(array, 2, axis=-1)[..., ::2]
        if convert == "torch":
            return torch.from_numpy(array.copy()).transpose(0, 1).contiguous().transpose(0, 1)
        if convert == "torch bfloat16":
            return torch.from_numpy(array.copy()).bfloat16().requires_grad_()
        return array.tolist() if convert == "list" else array.astype(convert)

    def plain(array: NDArray[np.float32]) -> NDArray[np.float32]:
        if convert == "torch bfloat16":
            return torch.from_numpy(array.copy()).bfloat16().float().numpy()
        return array.astype(np.float16).astype(np.float32) if convert == "float16" else array

    inputs = tiny.backbone_features, tiny.state, tiny.noise
    features, state, noise = map(converted, inputs)
    result = head(features, state, 1, noise=noise)
    assert isinstance(result, torch.Tensor) == convert.startswith("torch")
    features, state, noise = map(plain, inputs)
    np.testing.assert_array_equal(np.asarray(result), head(features, state, 1, noise=noise))


def test_results_are_torch_if_the_features_were(head: saccade.ActionHead, tiny: Released) -> None:
    context = head.encode(torch.from_numpy(tiny.backbone_features.copy()))
    assert isinstance(context.vl_embs, torch.Tensor)
    assert isinstance(head.sample(context, tiny.state, 0, seed=0), torch.Tensor)
    velocity = head.velocity(context, tiny.state, 0, tiny.noise, 0)
    assert isinstance(velocity, torch.Tensor)
    assert velocity.dtype == torch.float32


def test_out(head: saccade.ActionHead, context: saccade.Context, tiny: Released) -> None:
    expected = head.sample(context, tiny.state, 1, noise=tiny.noise)
    out = np.full((2, 6, 5), 9, np.float32)
    assert head.sample(context, tiny.state, 1, noise=tiny.noise, out=out) is out
    np.testing.assert_array_equal(out, expected)
    tensor = torch.zeros(2, 6, 5)
    assert head.sample(context, tiny.state, 1, noise=tiny.noise, out=tensor) is tensor
    np.testing.assert_array_equal(tensor.numpy(), expected)


def test_out_in_the_memory_of_the_noise(
    head: saccade.ActionHead, context: saccade.Context, tiny: Released
) -> None:
    expected = head.sample(context, tiny.state, 1, noise=tiny.noise)
    for share in (np.asarray, np.ndarray.view, torch.from_numpy):
        in_place = tiny.noise.copy()
        head.sample(context, tiny.state, 1, noise=in_place, out=share(in_place))
        np.testing.assert_array_equal(in_place, expected)
        in_place = tiny.noise.copy()
        head.sample(context, tiny.state, 1, noise=share(in_place), out=in_place)
        np.testing.assert_array_equal(in_place, expected)


def test_context(head: saccade.ActionHead, tiny: Released) -> None:
    mask = np.arange(22).reshape(2, 11) % 3 == 0
    context = head.encode(tiny.backbone_features, image_mask=mask, attention_mask=np.ones((2, 11), bool))
    assert (context.batch, context.num_vl_tokens) == (2, 11)
    assert context.nbytes >= np.asarray(context.vl_embs).nbytes
    np.testing.assert_array_equal(context.image_mask, mask)
    context.vl_embs[:] = 0  # a copy: the context stays as it is
    np.testing.assert_allclose(context.vl_embs, tiny.vl_embs, atol=5e-6)
    assert head.encode(tiny.backbone_features).image_mask is None


def test_dropped_positions_are_as_if_they_had_not_been_there(
    head: saccade.ActionHead, tiny: Released, isa: str
) -> None:
    head = load(tiny)
    keep = np.array([0, 2, 3, 7, 10])
    drop = np.ones((2, 11), bool)
    drop[:, keep] = False
    removed = head(tiny.backbone_features, tiny.state, 1, noise=tiny.noise, drop_vl=drop)
    absent = head(tiny.backbone_features[:, keep], tiny.state, 1, noise=tiny.noise)
    np.testing.assert_allclose(removed, absent, rtol=1e-5, atol=1e-5)
    context = head.encode(tiny.backbone_features, drop_vl=drop)
    assert context.num_vl_tokens == 11
    embs = np.asarray(context.vl_embs)
    assert (embs[drop] == 0).all()
    assert (embs[~drop] != 0).any()
    nothing = np.zeros((2, 11), bool)
    np.testing.assert_array_equal(
        head(tiny.backbone_features, tiny.state, 1, noise=tiny.noise, drop_vl=nothing),
        head(tiny.backbone_features, tiny.state, 1, noise=tiny.noise),
    )


def test_chosen_embodiments_keep_their_numbers(tiny: Released) -> None:
    some, every = load(tiny, embodiment_ids=[3, 1, 3]), load(tiny)
    assert (some.embodiment_ids, every.embodiment_ids) == ((1, 3), (0, 1, 2, 3, 4))
    assert some.nbytes < every.nbytes
    for ids in (3, [1, 3]):
        one, other = (
            head(tiny.backbone_features, tiny.state, ids, noise=tiny.noise) for head in (some, every)
        )
        np.testing.assert_array_equal(one, other)
    with pytest.raises(saccade.InputError, match=r"embodiment_id: 2 is not loaded, only \[1, 3\] are"):
        some(tiny.backbone_features, tiny.state, 2, noise=tiny.noise)


def test_bf16_stays_bf16_in_memory() -> None:
    released = load_released("n15_bf16")
    stored = os.path.getsize(released.path)  # noqa: PTH202
    assert load(released).nbytes < 2 * stored


def test_future_tokens_are_the_checkpoints(head: saccade.ActionHead, tiny: Released) -> None:
    tokens = head.future_tokens
    with safe_open(tiny.path, framework="np") as file:
        stored = file.get_tensor("action_head.future_tokens.weight")
    np.testing.assert_array_equal(tokens, stored)
    assert tokens.dtype == np.float32
    tokens[:] = 0.0
    np.testing.assert_array_equal(head.future_tokens, stored)  # a copy each time


def test_pickle_loads_anew(head: saccade.ActionHead, tiny: Released) -> None:
    copy = pickle.loads(pickle.dumps(head))
    assert copy.config == head.config
    one, other = (each(tiny.backbone_features, tiny.state, 1, noise=tiny.noise) for each in (head, copy))
    np.testing.assert_array_equal(one, other)


def test_warmup(head: saccade.ActionHead) -> None:
    head.warmup(11)
    head.warmup(5, batch=2, num_samples=3)
    with pytest.raises(saccade.InputError, match="num_vl_tokens: expected at least 1, got 0"):
        head.warmup(0)
    for size in (2**40, 2**57, 2**62):
        with pytest.raises(saccade.InputError, match="num_vl_tokens, batch, num_samples: "):
            head.warmup(size)


def test_warmup_of_a_head_with_text_and_image_blocks() -> None:
    head = load(load_released("n17_tiny"))
    for num_vl_tokens in (2, 13):
        head.warmup(num_vl_tokens, batch=3)
    with pytest.raises(saccade.InputError, match="num_vl_tokens: expected at least 2, one of text"):
        head.warmup(1)


def test_a_context_holds_what_its_blocks_see() -> None:
    """Of 16 tokens 4 are of images and 4 are padding, so that blocks see a quarter or a half of them."""
    released = load_released("n17_tiny")
    head = load(released)
    features = np.zeros((1, 16, head.config.context_dim), np.float32)
    is_image, is_attended = np.arange(16)[None] < 4, np.arange(16)[None] < 12
    masked = head.encode(features, image_mask=is_image, attention_mask=is_attended)
    few = head.encode(features[:, :12], image_mask=is_image[:, :12])
    others = 4 * 4 * head.config.context_dim + 4  # the tokens that are padding, and their part of the mask
    assert masked.nbytes == few.nbytes + others


def test_many_threads_share_a_head_and_a_context(tiny: Released) -> None:
    head = load(tiny, num_threads=2)
    context = head.encode(tiny.backbone_features)
    expected = [head.sample(context, tiny.state, 1, seed=seed) for seed in range(8)]
    wrong: list[int] = []

    def work(seed: int) -> None:
        for _ in range(20):
            if not np.array_equal(head.sample(context, tiny.state, 1, seed=seed), expected[seed]):
                wrong.append(seed)

    workers = [threading.Thread(target=work, args=(seed,)) for seed in range(8)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


FORK = """
import os, sys
import numpy as np
import saccade
head = saccade.ActionHead.from_pretrained(sys.argv[1], config=sys.argv[2], num_threads=2)
features = np.random.default_rng(0).standard_normal((1, 40, 64), dtype=np.float32)
state = np.zeros((1, 16), np.float32)
before = head(features, state, 0, seed=0)
child = os.fork()
if child == 0:
    os._exit(0 if (head(features, state, 0, seed=0) == before).all() else 1)
assert os.waitpid(child, 0)[1] == 0
"""


def test_works_after_fork(tmp_path: Path) -> None:
    released = load_released("n15_bf16")
    config = tmp_path / "config.json"
    config.write_text(__import__("json").dumps(released.config))
    command = [sys.executable, "-c", FORK, str(released.path), str(config)]
    subprocess.run(command, check=True, timeout=60)


def cross_tensors(width: int, context_dim: int, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    shapes = {"to_q": (width, width), "to_k": (width, context_dim), "to_v": (width, context_dim)}
    shapes["to_out.0"] = (width, width)
    tensors = {f"{name}.weight": rng.standard_normal(shape, np.float32) / 5 for name, shape in shapes.items()}
    return tensors | {f"{name}.bias": rng.standard_normal(width, np.float32) for name in shapes}


@pytest.mark.parametrize(("num_heads", "head_dim"), [(2, 48), (1, 64), (5, 7)])
def test_cross_attention_against_torch(isa: str, num_heads: int, head_dim: int) -> None:
    width, context_dim, batch, queries, keys = num_heads * head_dim, 33, 2, 9, 70
    tensors = cross_tensors(width, context_dim)
    rng = np.random.default_rng(1)
    x = rng.standard_normal((batch, queries, width), np.float32)
    vl = rng.standard_normal((batch, keys, context_dim), np.float32)
    mask = rng.random((batch, keys)) < 0.7
    bias = rng.standard_normal((batch, keys), np.float32)
    attn = saccade.CrossAttention(tensors, num_heads)
    out, weights = attn(x, attn.project(vl), key_mask=mask, key_bias=bias, return_weights=True)

    double = {name: torch.from_numpy(tensor).double() for name, tensor in tensors.items()}

    def linear(name: str, rows: Any) -> Any:
        return rows @ double[f"{name}.weight"].T + double[f"{name}.bias"]

    def heads(rows: Any) -> Any:
        return rows.unflatten(-1, (num_heads, head_dim)).transpose(1, 2)  # (batch, heads, rows, head_dim)

    states, tokens = torch.from_numpy(x).double(), torch.from_numpy(vl).double()
    q, k, v = heads(linear("to_q", states)), heads(linear("to_k", tokens)), heads(linear("to_v", tokens))
    logits = q @ k.transpose(-1, -2) / head_dim**0.5 + torch.from_numpy(bias).double()[:, None, None]
    logits = logits.masked_fill(~torch.from_numpy(mask)[:, None, None], -torch.inf)
    probabilities = logits.softmax(-1)
    expected = linear("to_out.0", (probabilities @ v).transpose(1, 2).flatten(2))
    np.testing.assert_allclose(weights, probabilities, atol=1e-6)
    np.testing.assert_allclose(out, expected, rtol=1e-5, atol=1e-5)
    assert (np.asarray(weights)[~np.broadcast_to(mask[:, None, None], weights.shape)] == 0).all()


def test_a_query_without_keys_gets_the_output_bias(isa: str) -> None:
    tensors = cross_tensors(12, 5)
    attn = saccade.CrossAttention(tensors, 3)
    kv = attn.project(np.ones((1, 4, 5), np.float32))
    states = np.ones((1, 2, 12), np.float32)
    for options in (
        {"key_mask": np.zeros((1, 4), bool)},
        {"key_bias": np.full((1, 4), -np.inf, np.float32)},
    ):
        out, weights = attn(states, kv, return_weights=True, **options)
        np.testing.assert_array_equal(out[0, 0], tensors["to_out.0.bias"])
        assert (np.asarray(weights) == 0).all()


def test_held_keys_and_values_serve_many_calls() -> None:
    attn = saccade.CrossAttention(cross_tensors(12, 5), 3)
    vl = np.random.default_rng(0).standard_normal((2, 4, 5), np.float32)
    kv = attn.project(torch.from_numpy(vl))
    assert (kv.batch, kv.num_vl_tokens) == (2, 4)
    assert kv.nbytes > 0
    states = np.random.default_rng(1).standard_normal((2, 3, 12), np.float32)
    first = attn(states, kv)
    assert isinstance(first, torch.Tensor)
    out = np.empty((2, 3, 12), np.float32)
    assert attn(states, kv, out=out) is out
    np.testing.assert_array_equal(out, first.numpy())
    assert (attn.width, attn.context_dim, attn.num_heads) == (12, 5, 3)


def test_show_config(capsys: pytest.CaptureFixture[str]) -> None:
    config = saccade.show_config(mode="dicts")
    assert config["isa"] in config["available_isas"]
    assert config["num_threads"] >= 1
    saccade.show_config()
    assert f"isa: {config['isa']}" in capsys.readouterr().out
