"""Promises of the binding: no panic reaches Python, and no thread waits for another."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

import saccade
from saccade import _saccade
from saccade.errors import CheckpointError, InputError, SaccadeError, ShapeError
from tests.helpers.released import load_released


def test_a_panic_in_the_core_is_an_error_that_asks_for_a_report() -> None:
    with pytest.raises(SaccadeError, match="please report it with the call that led to it: the reason"):
        _saccade.panic_in_core("the reason")


def test_readers_and_getters_of_one_checkpoint_do_not_wait_for_each_other() -> None:
    """A reader that fails makes its exception while others ask for attributes: with a lock, a deadlock."""
    released = load_released("n15_tiny")
    published = _saccade.HeadCheckpoint.open(str(released.path), json.dumps(released.config))
    failed: list[int] = []

    def read() -> None:
        for _ in range(300):
            try:
                published.read("no such tensor", None)
            except CheckpointError:
                failed.append(1)

    def ask() -> None:
        for _ in range(3000):
            assert published.prefix == "action_head."

    threads = [threading.Thread(target=work, daemon=True) for work in (read, read, ask, ask)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert not any(thread.is_alive() for thread in threads)
    assert len(failed) == 600


def test_messages_name_what_python_users_can_call() -> None:
    released = load_released("n15_tiny")
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config)
    mask = np.zeros(released.backbone_features.shape[:2], bool)
    with pytest.raises(InputError, match=r"attention_mask: .*drop_vl=~attention_mask"):
        head.encode(released.backbone_features, attention_mask=mask)
    context = head.encode(released.backbone_features)
    with pytest.raises(ShapeError, match=r"state: .*saccade\.Normalizer"):
        head.sample(context, released.state[:, :, :-1], released.embodiment_id, noise=released.noise)
