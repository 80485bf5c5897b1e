"""Maps made by hand, and observations that maps are made of."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.maps.layout import parse_layout
from saccade_lab.maps.occlusion import DroppedPositions, Occlusion
from saccade_lab.maps.record import Maps, Selection
from saccade_lab.maps.view import View, from_simulator
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy
from tests.helpers.released import load_released

FUTURE = 3
ACTIONS = 2


def one_hot_maps(
    *,
    future_tokens: int = FUTURE,
    images: bool = True,
    steps: tuple[int, ...] = (0, 1),
) -> Maps:
    """Two blocks, two heads, and one state, three future and two action rows.

    The vision-language tokens are a word, the 2 x 2 patches of camera `left`, the 1 x 3 patches of camera
    `top` and a special token, 9 in all. In step 1 and block 0, head 0, future tokens 0, 1 and 2 look at the
    third patch of `left` (position 3) and the second and third of `top` (6 and 7), the other rows at the
    word; in head 1 all look at the special token. Everywhere else all keys are read alike.
    """
    config = saccade.HeadConfig.from_file(DEMO_CHECKPOINT / "config.json")
    config = dataclasses.replace(config, num_future_tokens=future_tokens, action_horizon=ACTIONS)
    layout = parse_layout("text:1=push,image:2x2=left,image:1x3=top,special:1=</img><b>", 9)
    count = 1 + future_tokens + ACTIONS
    rows = {
        "state": slice(0, 1),
        "future": slice(1, 1 + future_tokens),
        "action": slice(1 + future_tokens, count),
    }
    if not future_tokens:
        del rows["future"]
    looked = np.zeros((2, count, 9), np.float32)
    looked[0, :, 0] = 1.0
    for token, position in enumerate((3, 6, 7)[:future_tokens]):
        looked[0, 1 + token] = np.eye(9)[position]
    looked[1, :, 8] = 1.0
    even = {
        0: np.full((2, count, 9), 1 / 9, np.float32),
        1: np.full((2, count, count), 1 / count, np.float32),
    }
    attention = {
        (step, block): looked if (step, block) == (1, 0) else even[block]
        for step in steps
        for block in (0, 1)
    }
    redrawn = {place: np.full((2, future_tokens, maps.shape[-1]), 1 / maps.shape[-1], np.float32)
               for place, maps in attention.items()}  # fmt: skip
    features, state = (
        np.zeros((1, 9, config.context_dim), np.float32),
        np.zeros((1, config.state_dim), np.float32),
    )
    noise = np.zeros((1, ACTIONS, config.encoder_action_dim), np.float32)
    observation = HeadInputs(features, state, np.array([0]), noise)
    gradient = np.arange(16 * 16 * 3, dtype=np.uint32).reshape(16, 16, 3) % 251
    pictures = {"left": gradient.astype(np.uint8), "top": np.full((8, 24, 3), 200, np.uint8)}
    change = {"left": np.array([[0, 1], [0, 0]], np.float32), "top": np.array([[0, 0, 0.25]], np.float32)}
    return Maps(
        checkpoint={"name": "by-hand", "sha256": "0" * 64},
        config=config,
        view=View(
            title="maps by hand <&>",
            source={"kind": "test"},
            observation=observation,
            layout=layout,
            images=pictures if images else {},
            occluder=DroppedPositions(observation),
        ),
        selection=Selection(blocks=(0, 1), steps=steps, heads=(0, 1), shown_heads=(0, 1)),
        rows=rows,
        attention=attention,
        redrawn=redrawn if future_tokens else None,
        occlusion=Occlusion("by hand", 1, change, 0.5),
    )


@functools.cache
def demo_policy() -> Policy:
    """The bundled policy on one thread."""
    return Policy.from_pretrained(num_threads=1)


def demo_head() -> saccade.ActionHead:
    """The head of the bundled policy."""
    found = demo_policy().whole.head
    assert isinstance(found, saccade.ActionHead)
    return found


@functools.cache
def pushed_view() -> View:
    """The first observation of an episode of the task `push`."""
    return from_simulator(demo_policy(), "push", 3, 0)


def feature_arrays() -> dict[str, Any]:
    """What the released single-view head was given, with the prompt that fits its T_vl."""
    given = load_released("n15_single_view")
    ids = [7] * 20 + [151669] * 256 + [8] * 20
    return {
        "backbone_features": given.backbone_features,
        "state": given.state,
        "embodiment_id": given.embodiment_id,
        "noise": given.noise,
        "input_ids": np.array([ids]),
        "images": np.zeros((1, 32, 32, 3), np.uint8),
    }


def written(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez(path, **arrays)
    return path
