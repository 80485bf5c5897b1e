"""Every kind of head: N1, N1.5, N1.6, N1.7, forks with several decoders, a bias on future tokens.

Properties of the Rust head on each instruction set and of the torch reference, masks that are refused, and
what only training uses.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator, union-attr"

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade import Chunking, InputError, Intervention
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import TOLERANCE, arrays, both, random_masks, same, save
from tests.helpers.reference_cases import KINDS, relative_error, variant_config

# Bits


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
@pytest.mark.parametrize("kind", ["n1.6", "n1.7", "split-arms", "biased"])
def test_bits_do_not_depend_on_batch_samples_or_threads(
    isa: str, kind: str, precision: str, tmp_path: Path
) -> None:
    config = variant_config(kind, num_layers=6, num_heads=2, head_dim=20, context_dim=34, hidden_dim=51)
    save(tmp_path, random_head(config, 1), config)
    heads = [
        saccade.ActionHead.from_pretrained(tmp_path, precision=precision, num_threads=threads)
        for threads in (1, 2, 5)
    ]
    head = heads[0].config
    inputs = arrays(random_inputs(head, 2, batch=3, num_vl_tokens=37))
    inputs |= random_masks(head, np.random.default_rng(3), 3, 37)
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((3, 2, head.action_horizon, head.encoder_action_dim), np.float32)
    previous = rng.standard_normal((3, head.action_horizon, head.action_dim), np.float32)
    chunking = Chunking(overlap=3, frozen=1)

    def run(of: saccade.ActionHead, rows: slice, noise: Any, **options: Any) -> Any:
        of_rows = {name: value[rows] for name, value in inputs.items()} | {"noise": noise[rows]}
        return of(**of_rows, previous_chunk=previous[rows], chunking=chunking, **options)

    everyone = slice(None)
    together = run(heads[0], everyone, noise, num_samples=2)
    assert np.isfinite(together).all()
    for one in heads:
        assert same(run(one, everyone, noise, num_samples=2), together)
    for sample in range(2):
        assert same(run(heads[0], everyone, noise[:, sample]), together[:, sample])
    for row in range(3):
        assert same(run(heads[0], slice(row, row + 1), noise[:, 1])[0], together[row, 1])


# Properties


@pytest.mark.parametrize("copies", [2, 5])
def test_copies_with_less_weight_are_one_token(isa: str, copies: int, tmp_path: Path) -> None:
    """I2: r copies of a token with -ln r each are that token; so future tokens can be split and merged."""
    config = variant_config("n1.5", num_future_tokens=3)
    head, reference = both(config, seed=5)
    tokens = reference.future_tokens.weight.detach()
    grown = variant_config("n1.5", num_future_tokens=2 + copies)
    grown["saccade"] = {"future_key_bias": [0.0, 0.0, *[-math.log(copies)] * copies]}
    larger = random_head(grown, 0, dtype=torch.float64)
    repeated = {"future_tokens.weight": torch.cat((tokens[:2], tokens[2:].repeat(copies, 1)))}
    larger.load_state_dict(reference.state_dict() | repeated)
    save(tmp_path, larger, grown)
    inputs = random_inputs(head.config, 6, batch=2, num_vl_tokens=7)
    with torch.no_grad():
        expected = reference(**inputs)
        assert relative_error(larger(**inputs), expected) <= 1e-6  # the config holds float32
    biased = saccade.ActionHead.from_pretrained(tmp_path)
    assert biased.config.future_key_bias == pytest.approx(grown["saccade"]["future_key_bias"])
    assert relative_error(biased(**arrays(inputs)), expected) <= TOLERANCE
    plain = Intervention(key_bias={("future", tuple(range(2, 2 + copies))): math.log(copies)})
    assert relative_error(biased(**arrays(inputs), intervention=plain), expected) > TOLERANCE


def test_other_tokens_come_without_the_bias(isa: str) -> None:
    """An intervention's future tokens replace the learned ones and their bias."""
    config = variant_config("biased")
    head, reference = both(config, seed=7)
    plain, _ = both({key: value for key, value in config.items() if key != "saccade"}, seed=7)
    inputs = arrays(random_inputs(head.config, 8, batch=2, num_vl_tokens=7))
    tokens = reference.future_tokens.weight.detach().numpy()
    replaced = Intervention(future_tokens=tokens)
    assert same(head(**inputs, intervention=replaced), plain(**inputs))
    assert not same(head(**inputs), plain(**inputs))
    bias = np.array(config["saccade"]["future_key_bias"], np.float32)
    back = Intervention(future_tokens=tokens, key_bias={"future": bias})
    assert relative_error(head(**inputs, intervention=back), head(**inputs)) <= TOLERANCE


def test_a_bias_of_zero_is_none(isa: str) -> None:
    config = variant_config("n1.5")
    head, _ = both(config, seed=9)
    zeros, _ = both(config | {"saccade": {"future_key_bias": [0.0] * 4}}, seed=9)
    inputs = arrays(random_inputs(head.config, 10, batch=2, num_vl_tokens=7))
    assert same(zeros(**inputs), head(**inputs))


@pytest.mark.parametrize("kind", ["n1.6", "n1.7"])
def test_a_masked_token_is_as_if_it_had_not_been_there(isa: str, kind: str) -> None:
    """I9: without VL self-attention, padding is removed by the mask as well as by hand."""
    config = variant_config(kind, num_layers=7, vl_num_layers=0)
    head, reference = both(config, seed=11)
    inputs: dict[str, Any] = random_inputs(head.config, 12, batch=1, num_vl_tokens=11)
    masks = random_masks(head.config, np.random.default_rng(13), 1, 11)
    kept = masks["attention_mask"][0] & ~masks["drop_vl"][0]
    assert 2 <= kept.sum() < 11
    shorter = inputs | {
        "backbone_features": inputs["backbone_features"][:, torch.from_numpy(kept)],
        "attention_mask": None,
        "image_mask": masks["image_mask"][:, kept],
    }
    with torch.no_grad():
        expected = reference(**shorter)
        assert relative_error(reference(**(inputs | masks)), expected) <= 1e-12
    assert relative_error(head(**(inputs | masks)), expected) <= TOLERANCE
    assert relative_error(head(**shorter), expected) <= TOLERANCE


def test_the_vl_self_attention_sees_padding(isa: str) -> None:
    """As released: the masks are for the transformer, so padding still moves the tokens that are kept."""
    head, reference = both(variant_config("n1.7", vl_num_layers=1), seed=14)
    inputs = random_inputs(head.config, 15, batch=1, num_vl_tokens=9)
    masks: dict[str, Any] = {
        "attention_mask": np.arange(9)[None] >= 3,
        "image_mask": (np.arange(9)[None] >= 4) & (np.arange(9)[None] < 7),
    }
    features = inputs["backbone_features"].numpy()
    other = features.copy()
    other[:, :3] += 1.0
    assert not same(head.encode(features, **masks).vl_embs, head.encode(other, **masks).vl_embs)
    dropped = {**masks, "drop_vl": ~masks["attention_mask"]}
    kept = np.asarray(head.encode(features, **dropped).vl_embs)[:, 3:]
    assert relative_error(np.asarray(head.encode(other, **dropped).vl_embs)[:, 3:], kept) <= TOLERANCE
    with torch.no_grad():
        expected = reference.encode(features, drop_vl=dropped["drop_vl"])[:, 3:]
    assert relative_error(kept, expected) <= TOLERANCE


@pytest.mark.parametrize("kind", ["n1.6", "n1.7"])
def test_text_and_image_blocks_alternate(isa: str, kind: str) -> None:
    """Which keys a block reads, written out; and in a block of text no image token has any weight."""
    for every in (1, 2, 3):
        config = variant_config(kind, num_layers=9, attend_text_every_n_blocks=every)
        head, _ = both(config, seed=16)
        inputs = arrays(random_inputs(head.config, 17, batch=2, num_vl_tokens=12))
        masks = {name: inputs.pop(name) for name in ("attention_mask", "image_mask")}
        context = head.encode(inputs.pop("backbone_features"), **masks)
        trace = head.trace(context, **inputs, num_steps=1)
        for block in range(0, 9, 2):
            text = block % (2 * every) == 0
            read = masks["attention_mask"] & (masks["image_mask"] != text)
            weights = np.asarray(trace.attention[0, block])
            assert ((weights > 0).any(axis=(1, 2)) == read).all()
            assert relative_error(weights.sum(axis=-1), np.ones(weights.shape[:-1])) <= 1e-5


def test_no_image_block_needs_no_image(isa: str) -> None:
    """One and two blocks read text alone."""
    head, reference = both(variant_config("n1.6", num_layers=2), seed=18)
    inputs = random_inputs(head.config, 19, batch=1, num_vl_tokens=4)
    inputs["image_mask"] = torch.zeros(1, 4, dtype=torch.bool)
    inputs["attention_mask"] = torch.ones(1, 4, dtype=torch.bool)
    with torch.no_grad():
        assert relative_error(head(**arrays(inputs)), reference(**inputs)) <= TOLERANCE


@pytest.mark.parametrize("kind", ["n1.6", "n1.7"])
def test_masks_that_leave_nothing_are_refused(kind: str) -> None:
    head, reference = both(variant_config(kind, num_layers=5), seed=20)
    inputs: dict[str, Any] = arrays(random_inputs(head.config, 21, batch=2, num_vl_tokens=6))
    image = np.array([[False] * 3 + [True] * 3] * 2)
    attended = np.ones((2, 6), bool)
    good = inputs | {"attention_mask": None, "image_mask": image}
    for run in (head, reference):
        run(**good)
        for wrong in (
            {"image_mask": None},
            {"image_mask": np.ones((2, 6), bool)},
            {"image_mask": np.zeros((2, 6), bool)},
            {"attention_mask": np.array([[True] * 6, [False] * 3 + [True] * 3])},
            {"attention_mask": np.array([[True] * 6, [True] * 3 + [False] * 3])},
            {"attention_mask": np.zeros((2, 6), bool)},
            {"drop_vl": np.array([[False] * 6, [True] * 3 + [False] * 3])},
        ):
            with pytest.raises(InputError, match="mask"):
                run(**(good | {"attention_mask": attended} | wrong))


@pytest.mark.parametrize("kind", ["n1", "n1.5", "fork"])
def test_heads_that_ignore_padding_say_so(kind: str) -> None:
    head, reference = both(variant_config(kind), seed=22)
    inputs = arrays(random_inputs(head.config, 23, batch=2, num_vl_tokens=6))
    mask = np.ones((2, 6), bool)
    for run in (head, reference):
        expected = run(**inputs)
        assert same(run(**inputs, attention_mask=mask, image_mask=mask).tolist(), expected.tolist())
        with pytest.raises(InputError, match="attention_mask"):
            run(**inputs, attention_mask=mask & False)


@pytest.mark.parametrize("kind", ["fork", "split-arms"])
def test_dimensions_that_are_not_decoded_do_not_matter(isa: str, kind: str) -> None:
    head, reference = both(variant_config(kind, action_dim=5, encoder_action_dim=9), seed=24)
    inputs = random_inputs(head.config, 25, batch=2, num_vl_tokens=6)
    assert inputs["noise"].shape[-1] == 9
    expected = np.asarray(head(**arrays(inputs)))
    assert expected.shape == (2, 5, 5)
    other = inputs | {"noise": torch.cat((inputs["noise"][..., :5], 7 + inputs["noise"][..., 5:]), dim=-1)}
    assert same(head(**arrays(other)), expected)
    with torch.no_grad():
        assert torch.equal(reference(**other), reference(**inputs))
    # The velocity is a function of all of them.
    context = head.encode(inputs["backbone_features"])
    observed: dict[str, Any] = {"state": inputs["state"], "embodiment_id": inputs["embodiment_id"]}
    velocities = [
        head.velocity(context, **observed, actions=of["noise"], timestep=500) for of in (inputs, other)
    ]
    assert not same(*velocities)


@pytest.mark.parametrize("kind", ["fork", "split-arms"])
def test_decoders_are_concatenated_in_order(isa: str, kind: str) -> None:
    """A decoder of zeros moves its own dimensions only: the first step is x + v dt, with v the decoded."""
    config = variant_config(kind, num_steps=1)
    head, reference = both(config, seed=26)
    inputs = random_inputs(head.config, 27, batch=2, num_vl_tokens=6)
    expected, first = np.asarray(head(**arrays(inputs))), 0
    for name, width in head.config.decoders:
        changed = {f"{name}.layer2.{part}": torch.zeros_like for part in ("W", "b")}
        tensors = reference.state_dict()
        tensors |= {key: zero(tensors[key]) for key, zero in changed.items()}
        silenced = random_head(config, 0, dtype=torch.float64)
        silenced.load_state_dict(tensors)
        with torch.no_grad():
            actions = silenced(**inputs).numpy()
        own = slice(first, first + width)
        start = inputs["noise"][..., own].numpy()
        assert relative_error(actions[..., own], start) == 0
        rest = np.delete(actions - expected, np.arange(first, first + width), axis=-1)
        assert np.abs(rest).max(initial=0) <= TOLERANCE
        first += width
    assert first == head.config.action_dim


@pytest.mark.parametrize("kind", ["n1", "n1.6", "n1.7"])
def test_no_future_tokens_is_n15_without_them(isa: str, kind: str) -> None:
    """I6: with the same weights, the rows of these heads are those of N1.5 with N = 0."""
    config = variant_config(kind, vl_num_layers=0, use_vlln=False, num_layers=1)
    head, reference = both(config, seed=28)
    sizes = {"vl_num_layers": 0, "use_vlln": False, "num_layers": 1, "num_future_tokens": 0}
    if kind == "n1":
        sizes["context_dim"] = head.config.context_dim
    plain = random_head(variant_config("n1.5", **sizes), 0, dtype=torch.float64)
    none = {"future_tokens.weight": torch.empty(0, head.config.width)}
    plain.load_state_dict(reference.state_dict() | none)
    inputs = random_inputs(head.config, 29, batch=2, num_vl_tokens=6)
    read = {name: inputs.pop(name) for name in ("attention_mask", "image_mask") if name in inputs}
    options: dict[str, Any] = {}
    if read:
        options["drop_vl"] = ~(read["attention_mask"] & ~read["image_mask"])
    with torch.no_grad():
        expected = plain(**inputs, **options)
    assert relative_error(head(**arrays(inputs | read)), expected) <= TOLERANCE


def test_state_history_is_one_row(isa: str) -> None:
    config = variant_config("n1.7", state_history=3)
    head, reference = both(config, seed=30)
    inputs = random_inputs(head.config, 31, batch=2, num_vl_tokens=6)
    assert inputs["state"].shape == (2, 3, 6)
    with torch.no_grad():
        assert relative_error(head(**arrays(inputs)), reference(**inputs)) <= TOLERANCE
    for wrong in (inputs["state"][:, :2], inputs["state"][:, 0]):
        for run, given_state in ((head, wrong.numpy()), (reference, wrong)):
            with pytest.raises(saccade.ShapeError, match="state"):
                run(**(arrays(inputs) | {"state": given_state}))


# Training


@pytest.mark.parametrize("kind", KINDS)
def test_the_loss_is_the_masked_error_of_the_velocity(kind: str) -> None:
    head = random_head(variant_config(kind), 32, dtype=torch.float64)
    config = head.config
    inputs: dict[str, Any] = random_inputs(config, 33, batch=3, num_vl_tokens=6)
    rng = np.random.default_rng(34)
    shape = (3, config.action_horizon, config.action_dim)
    actions, noise = rng.standard_normal(shape), rng.standard_normal(shape)
    weights = rng.integers(0, 2, shape)
    time = np.array([0.0, 0.25, 0.999])
    inputs.pop("noise")
    loss = head.loss(**inputs, actions=actions, noise=noise, time=time, action_mask=weights)
    loss.backward()
    for name, parameter in head.named_parameters():
        learned = "task_log_sigma" not in name
        assert (parameter.grad is not None) == learned, name
    noisy = np.zeros((3, config.action_horizon, config.encoder_action_dim))
    noisy[..., : config.action_dim] = time[:, None, None] * actions + (1 - time[:, None, None]) * noise
    with torch.no_grad():
        vl_embs = head.encode(inputs.pop("backbone_features"))
        velocity = head.velocity(vl_embs, **inputs, actions=noisy, timestep=np.array([0, 250, 999])).numpy()
    squares = (velocity - (actions - noise)) ** 2
    assert loss.item() == pytest.approx((squares * weights).sum() / weights.sum(), rel=1e-12)


# Parameters that only the released training uses


def test_unused_parameters_are_kept(tmp_path: Path) -> None:
    config = variant_config("n1.6") | {"state_dropout_prob": 0.2}
    head = random_head(config, 35)
    assert head.mask_token.shape == (1, 1, head.config.width)
    save(tmp_path, head, config)
    again = Reference.from_pretrained(tmp_path)
    assert again.state_dict().keys() == head.state_dict().keys()
    assert torch.equal(again.mask_token, head.mask_token)
    inputs = random_inputs(head.config, 36, batch=1, num_vl_tokens=6)
    actions = saccade.ActionHead.from_pretrained(tmp_path)(**arrays(inputs))
    head.mask_token.data += 1.0
    with torch.no_grad():
        assert relative_error(actions, head.double()(**inputs)) <= TOLERANCE


def test_unused_parameters_must_have_their_shape(tmp_path: Path) -> None:
    config = variant_config("fork")
    head = random_head(config, 37)
    save(tmp_path, head, config)
    path = tmp_path / "model.safetensors"
    from safetensors.torch import load_file, save_file

    tensors = load_file(path)
    save_file(tensors | {"action_head.task_log_sigma.arm": torch.zeros(2)}, path)
    for load in (Reference.from_pretrained, saccade.ActionHead.from_pretrained):
        with pytest.raises(saccade.CheckpointError, match=r"task_log_sigma\.arm"):
            load(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text()) == config
