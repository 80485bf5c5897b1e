"""A signal ends a running call of any size, and the head can be used afterwards."""

from __future__ import annotations

import collections
import itertools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

import saccade
from saccade import _saccade
from tests.helpers.interrupts import Stopped, stopped_after

DEMO = str(saccade.demo_checkpoint())


@pytest.fixture(scope="module")
def head() -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(DEMO, num_threads=2)


@pytest.fixture(scope="module")
def state(head: saccade.ActionHead) -> Any:
    return np.zeros((1, head.config.state_dim), np.float32)


def encoded(head: saccade.ActionHead, batch: int = 1, tokens: int = 60) -> saccade.Context:
    features = np.random.default_rng(0).standard_normal((batch, tokens, head.config.context_dim), np.float32)
    return head.encode(features)


def endless(call: Callable[[], object]) -> Callable[[], None]:
    """Repeats a call, which is stopped within one of them or between two."""

    def repeat() -> None:
        while True:
            call()

    return repeat


def test_calls_are_stopped_and_the_head_stays_usable(head: saccade.ActionHead, state: Any) -> None:
    context = encoded(head)
    expected = head.sample(context, state, 0, seed=3)
    many = encoded(head, batch=8)
    states = np.repeat(state, 8, axis=0)
    layer = saccade.CrossAttention(
        {
            f"{name}.{kind}": np.zeros((256, 256) if kind == "weight" else 256, np.float32)
            for name in ("to_q", "to_k", "to_v", "to_out.0")
            for kind in ("weight", "bias")
        },
        4,
    )
    rows = np.zeros((4, 2000, 256), np.float32)
    keys = layer.project(rows)
    for call in (
        # One call of several minutes, which only a look from inside can stop.
        lambda: head.sample(context, state, 0, seed=0, num_samples=2000, num_steps=1000),
        lambda: head.sample(many, states, 0, seed=0, num_samples=64, num_steps=1000),
        lambda: head.trace(context, state, 0, seed=0, num_steps=1000, record=("hidden",), steps=[0]),
        lambda: head.sample(context, state, 0, seed=0, num_samples=500, num_steps=1000, future_refresh=3),
        # Shorter calls, again and again: stopped wherever they are.
        endless(lambda: encoded(head, batch=64, tokens=500)),
        endless(lambda: head.velocity(many, states, 0, np.zeros((8, 16, 4), np.float32), 7)),
        endless(lambda: head.warmup(200, batch=8, num_samples=8)),
        endless(lambda: saccade.ActionHead.from_pretrained(DEMO)),
        endless(lambda: layer.project(rows)),
        endless(lambda: layer(rows, keys)),
    ):
        with pytest.raises(Stopped), stopped_after(0.2):
            call()
        np.testing.assert_array_equal(head.sample(context, state, 0, seed=3), expected)


def test_what_was_stopped_is_not_remembered(state: Any) -> None:
    """Modulations and time biases are cached by timestep: those of a call that was stopped must not be."""
    fresh = saccade.ActionHead.from_pretrained(DEMO, num_threads=1)
    context = encoded(fresh)
    actions = np.zeros((1, 16, 4), np.float32)

    def all_buckets() -> None:
        for bucket in range(1000):
            fresh.velocity(context, state, 0, actions, bucket)
        threading.Event().wait()

    for delay in np.geomspace(1e-4, 2e-2, 20):
        with pytest.raises(Stopped), stopped_after(float(delay)):
            all_buckets()
    other = saccade.ActionHead.from_pretrained(DEMO, num_threads=1)
    theirs = encoded(other)
    for bucket in range(200):
        np.testing.assert_array_equal(
            fresh.velocity(context, state, 0, actions, bucket),
            other.velocity(theirs, state, 0, actions, bucket),
        )


def test_only_the_main_threads_calls_are_stopped(head: saccade.ActionHead, state: Any) -> None:
    context = encoded(head)
    results: list[Any] = []
    worker = threading.Thread(
        target=lambda: results.append(head.sample(context, state, 0, seed=1, num_samples=50, num_steps=50))
    )
    worker.start()
    with pytest.raises(Stopped), stopped_after(0.05):
        head.sample(context, state, 0, seed=0, num_samples=2000, num_steps=1000)
    worker.join()
    expected = head.sample(context, state, 0, seed=1, num_samples=50, num_steps=50)
    np.testing.assert_array_equal(results[0], expected)


def test_reading_many_small_tensors_is_stopped(tmp_path: Path) -> None:
    """None of them takes long enough to ask whether to go on, so that the loop over them must."""
    path = tmp_path / "model.safetensors"
    save_file({f"tensor.{index}": np.zeros(1, np.float32) for index in range(2000)}, path)
    paths = iter([str(path)] * 200)
    # The interpreter looks for signals between bytecodes, not between the calls of `map`.
    calls = map(_saccade.read_tensors, paths, itertools.repeat(""))
    with pytest.raises(Stopped), stopped_after(0.05):
        collections.deque(calls, maxlen=0)
    assert list(paths)
