"""Policies of saccade's own parts encode in one call of the engine, with the bits of the separate calls."""

from __future__ import annotations

import functools
import signal
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import saccade
import saccade._saccade as _saccade
from saccade import BackboneInputs, InputError, Policy, PolicyContext, ShapeError
from saccade.policy.encoding import compute_features, encode_features
from tests.helpers import whole_checkpoints
from tests.helpers.policy_cases import inputs_of, noise, with_parts
from tests.helpers.whole_checkpoints import EMBODIMENT, whole

Observation = dict[str, Any]


class ForeignBackbone:
    """A backbone of another program: its features are arrays. Those of saccade's backbone, here."""

    def __init__(self, backbone: saccade.Backbone) -> None:
        self._backbone = backbone
        self.nbytes = backbone.nbytes

    def encode_many(self, inputs: Sequence[BackboneInputs], *, previous: Sequence[Any] = ()) -> list[Any]:
        found = self._backbone.encode_many(inputs)
        return [
            SimpleNamespace(backbone_features=f.backbone_features, image_mask=f.image_mask) for f in found
        ]


@functools.cache
def load(layout: str, num_threads: int = 1) -> Any:
    return Policy.from_pretrained(whole(layout), embodiment=EMBODIMENT, num_threads=num_threads)


def separately(policy: Any) -> Policy:
    """The policy whose parts are called one after the other, with arrays between them."""
    return with_parts(policy, backbone=ForeignBackbone(policy.backbone))


def seen(policy: Policy, text: str = "push the button", seed: int = 0) -> Observation:
    example = policy.example_observation(seed)
    return example | {"language": {key: [[text]] for key in example["language"]}}


def assert_same_context(found: PolicyContext, expected: PolicyContext) -> None:
    assert (found.batch, found.num_vl_tokens) == (expected.batch, expected.num_vl_tokens)
    assert np.array_equal(np.asarray(found.context.vl_embs), np.asarray(expected.context.vl_embs))
    masks = [context.context.image_mask for context in (found, expected)]
    assert all(mask is not None for mask in masks)
    assert np.array_equal(*masks)  # type: ignore[arg-type]
    for one, other in zip(found.features, expected.features, strict=True):
        assert np.array_equal(one.backbone_features, other.backbone_features)
        assert np.array_equal(one.image_mask, other.image_mask)


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_one_call_has_the_bits_of_the_separate_calls(layout: str) -> None:
    policy = load(layout)
    apart = separately(policy)
    texts = ("push", "pick up the red block and put it behind the mug", "open the drawer", "push")
    observations = [seen(policy, text, seed) for seed, text in enumerate(texts)]
    for given in ([observations[1]], observations):
        found, expected = policy.encode(given), apart.encode(given)
        assert_same_context(found, expected)
        start = noise(policy, len(given))
        for one, other in zip(policy.act(given, noise=start), apart.act(given, noise=start), strict=True):
            assert all(np.array_equal(one[key], other[key]) for key in other)
        reused = policy.encode(given[::-1], previous=found)
        assert_same_context(reused, apart.encode(given[::-1]))
    lengths = {one.num_tokens for one in found.features}
    assert len(lengths) > 1


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_features_are_those_of_the_backbone(layout: str) -> None:
    policy = load(layout)
    observation = seen(policy)
    (found,) = policy.encode(observation).features
    (inputs,) = inputs_of(policy, observation)
    expected = policy.backbone(inputs)
    assert found.backbone_features is found.backbone_features
    for name in ("backbone_features", "attention_mask", "image_mask"):
        one, other = (np.asarray(getattr(features, name)) for features in (found, expected))
        assert (one.dtype, one.shape) == (other.dtype, other.shape), name
        assert np.array_equal(one, other), name
    assert list(found.views) == list(expected.views) == list(inputs.view_names or ())
    assert all(np.array_equal(found.views[name], expected.views[name]) for name in expected.views)
    assert (found.batch, found.num_tokens, found.record) == (1, expected.num_tokens, None)
    # From features of the backbone a later call takes as from a policy's own.
    own = PolicyContext(policy.encode(observation).context, (expected,))
    assert_same_context(policy.encode(observation, previous=own), policy.encode(observation))
    again = policy.encode(observation, previous=own).features[0]
    assert np.array_equal(again.backbone_features, expected.backbone_features)


def test_own_parts_are_called_once(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = load("n17")
    observation, start = seen(policy), noise(policy, 1)
    expected = policy.act(observation, noise=start)

    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("a part was called by itself")

    monkeypatch.setattr(saccade.Processor, "__call__", refuse)
    monkeypatch.setattr(saccade.Backbone, "encode_many", refuse)
    monkeypatch.setattr(saccade.ActionHead, "encode", refuse)
    found = policy.act(observation, noise=start)
    assert all(np.array_equal(found[key], expected[key]) for key in expected)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"seed": -1}, "seed: "),
        ({"seed": 0, "noise": np.zeros((1, 1, 1), np.float32)}, "noise, seed: "),
        ({"num_samples": 0}, "num_samples: "),
    ],
)
def test_options_that_do_not_fit_are_refused_before_images_are_encoded(
    options: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = load("n17")

    def refuse(*args: Any) -> Any:
        raise AssertionError("something was encoded")

    monkeypatch.setattr(_saccade, "Policy", refuse)
    with pytest.raises(InputError, match=f"^{said}"):
        policy.act(seen(policy), **options)


def test_an_observation_that_does_not_fit_draws_nothing() -> None:
    policy, generator = load("n17"), np.random.default_rng(0)
    observation = seen(policy)
    expected = policy.act(observation, seed=0)
    short = {key: part[:, :1] for key, part in expected.items()}
    with pytest.raises(ShapeError, match=r"^previous_chunk: "):
        policy.act(observation, seed=generator, previous_chunk=short, chunking=saccade.Chunking(2, 1))
    found = policy.act(observation, seed=generator)
    assert all(np.array_equal(found[key], expected[key]) for key in expected)
    again = policy.act(observation, seed=generator)  # the generator has advanced
    assert any(not np.array_equal(again[key], expected[key]) for key in expected)


def test_a_head_of_another_class_gets_the_seed() -> None:
    policy = load("n17")
    given: list[dict[str, Any]] = []

    class OwnHead(saccade.ActionHead):
        def sample(self, *args: Any, **options: Any) -> Any:
            given.append(options)
            return super().sample(*args, **options)

    expected = policy.act(seen(policy), seed=7)
    found = with_parts(policy, head=OwnHead.from_pretrained(whole("n17"))).act(seen(policy), seed=7)
    assert given == [{"seed": 7}]
    assert all(np.array_equal(found[key], expected[key]) for key in expected)


def test_a_replaced_method_is_called(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = with_parts(load("n16"), backbone=saccade.Backbone.from_pretrained(whole("n16")))
    called: list[int] = []
    backbone: Any = policy.backbone
    encode_many = backbone.encode_many

    def watched(inputs: Sequence[BackboneInputs], **options: Any) -> Any:
        called.append(len(inputs))
        return encode_many(inputs, **options)

    monkeypatch.setattr(backbone, "encode_many", watched)
    policy.encode([seen(policy), seen(policy)])
    assert called == [2]


def test_a_part_of_another_class_is_called() -> None:
    policy = load("n16")
    called: list[str] = []

    class OwnProcessor(saccade.Processor):
        def __call__(self, *args: Any, **kwargs: Any) -> BackboneInputs:
            called.append("processor")
            return super().__call__(*args, **kwargs)

    class OwnBackbone(saccade.Backbone):
        def encode_many(self, *args: Any, **kwargs: Any) -> Any:
            called.append("backbone")
            return super().encode_many(*args, **kwargs)

    class OwnHead(saccade.ActionHead):
        def encode(self, *args: Any, **kwargs: Any) -> Any:
            called.append("head")
            return super().encode(*args, **kwargs)

    expected = policy.encode(seen(policy))
    for name, kind in (("processor", OwnProcessor), ("backbone", OwnBackbone), ("head", OwnHead)):
        loaded: Any = kind.from_pretrained(whole("n16"))
        found = with_parts(policy, **{name: loaded}).encode(seen(policy))
        assert called == [name]
        called.clear()
        assert np.array_equal(np.asarray(found.context.vl_embs), np.asarray(expected.context.vl_embs))


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_errors_are_those_of_the_separate_calls(layout: str) -> None:
    policy = load(layout)
    good = seen(policy)
    (inputs,) = inputs_of(policy, good)
    other = Policy.from_pretrained(whole(layout), embodiment=EMBODIMENT).encode(good)
    bad = seen(policy, "<image-2><IMG_CONTEXT><|image_pad|>")
    tall = good | {"video": {name: view[:, :, :1] for name, view in good["video"].items()}}
    wide = good | {"video": {name: np.tile(view, (1, 1, 1, 400, 1)) for name, view in tall["video"].items()}}
    cases: tuple[tuple[Any, Any], ...] = (
        (bad, None),
        ([good, bad], None),
        (wide, None),
        (good, other),
        (good, 3),
        (good, inputs),
        (bad, other),
        (bad, 3),
    )
    for observation, previous in cases:
        expected: Any = None
        try:
            compute_features(inputs_of(policy, observation), policy.backbone, previous)
        except Exception as error:
            expected = error
        for call in (policy.encode, policy.act):
            if expected is None:
                call(observation, previous=previous)
                continue
            with pytest.raises(type(expected)) as raised:
                call(observation, previous=previous)
            assert (type(raised.value), str(raised.value)) == (type(expected), str(expected))


def test_what_the_head_refuses_is_refused_with_the_same_words() -> None:
    policy, demo = load("isaac"), Policy.from_pretrained(saccade.demo_checkpoint())
    (features,) = policy.encode(seen(policy)).features
    with pytest.raises(
        ShapeError, match=r"backbone_features: expected \(batch, num_vl_tokens, 128\)"
    ) as apart:
        demo.head.encode(features.backbone_features, image_mask=features.image_mask)
    with pytest.raises(ShapeError) as raised:
        encode_features([features], demo.head)
    assert str(raised.value) == str(apart.value)
    both = [features, *demo.encode(seen(demo)).features]
    with pytest.raises(ShapeError, match="backbone_features: expected features of one width, got "):
        encode_features(both, policy.head)


def test_threads_may_encode_at_the_same_time() -> None:
    policy = load("isaac", 2)
    observations = [
        seen(policy, text, seed) for seed, text in enumerate(("push", "open it", "pick up the mug"))
    ]
    expected = [policy.encode(observation) for observation in observations]
    with ThreadPoolExecutor(4) as pool:
        rounds = [
            [pool.submit(policy.encode, one, previous=expected[0]) for one in observations] for _ in range(8)
        ]
        for calls in rounds:
            for call, context in zip(calls, expected, strict=True):
                assert_same_context(call.result(), context)


def test_a_signal_ends_the_call() -> None:
    """Its handler runs while the engine computes, and what it raises is raised."""

    class Stopped(Exception):
        pass

    def stop(number: int, frame: Any) -> None:
        raise Stopped

    policy = load("isaac")
    many = [seen(policy, f"push {seed}", seed) for seed in range(64)]
    expected = policy.encode(many[0])

    def encode_for_ever() -> None:
        while True:
            policy.encode(many)

    before = signal.signal(signal.SIGALRM, stop)
    try:
        # Again and again, since Python drops what is raised within a callback of its garbage collector.
        signal.setitimer(signal.ITIMER_REAL, 0.05, 2.0)
        with pytest.raises(Stopped):
            encode_for_ever()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert_same_context(policy.encode(many[0]), expected)
