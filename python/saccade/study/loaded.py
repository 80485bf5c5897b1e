"""What a worker process keeps between cells, so that neighbours do not load the same things again."""

from __future__ import annotations

import atexit
import functools
from pathlib import Path
from typing import Any

import numpy as np

from saccade.checkpoints import read_tensors
from saccade.config import HeadConfig
from saccade.head import ActionHead
from saccade.sim.environment import TaskEnvironment
from saccade.sim.policy import Float32Array, Policy
from saccade.sim.rollout import environment_for


@functools.lru_cache(maxsize=1)
def policy_of(checkpoint: str, engine: str = "rust") -> Policy:
    """The policy in a directory; its head on one thread, for studies spread out over processes."""
    return Policy.load(checkpoint, engine=engine, num_threads=1)


@functools.lru_cache(maxsize=1)
def head_of(checkpoint: str) -> ActionHead:
    """The head alone, on one thread."""
    return ActionHead.load(Path(checkpoint), num_threads=1)


@functools.lru_cache(maxsize=1)
def learned_tokens(checkpoint: str) -> Float32Array:
    """The future tokens of a policy, `(N, width)`; N is 0 where it has none."""
    head = HeadConfig.from_dict(policy_of(checkpoint).config.head)
    found = read_tensors(checkpoint, "action_head.future_tokens.")
    return found.get("weight", np.zeros((0, head.width), np.float32))


def describe_checkpoint(checkpoint: str) -> dict[str, Any]:
    """What a study's settings say of a policy: its folder's name, its hash and the sizes that matter here."""
    policy = policy_of(checkpoint)
    head = HeadConfig.from_dict(policy.config.head)
    return {
        "name": Path(checkpoint).resolve().name,
        "sha256": policy.checkpoint_sha256(),
        "num_future_tokens": head.num_future_tokens,
        "num_layers": head.num_layers,
        "num_steps": head.num_steps,
        "num_vl_tokens": policy.config.backbone.num_tokens,
    }


_open: dict[tuple[str, str], TaskEnvironment] = {}


def environment_of(checkpoint: str, task: str) -> TaskEnvironment:
    """The task as the policy in that directory sees it. The last two that were asked for stay open."""
    if (checkpoint, task) in _open:
        _open[checkpoint, task] = _open.pop((checkpoint, task))  # now the last one
    else:
        if len(_open) == 2:
            _open.pop(next(iter(_open))).close()
        environment = environment_for(policy_of(checkpoint), task)
        _open[checkpoint, task] = environment
        # MuJoCo sets EGL up when it first draws, and has it ended at exit; what is registered later runs
        # before that.
        environment.restart(0)
        environment.observe()
        close_at_exit()
    return _open[checkpoint, task]


def close_environments() -> None:
    """Frees the OpenGL contexts."""
    while _open:
        _open.popitem()[1].close()


@functools.cache
def close_at_exit() -> None:
    """Has them freed before the interpreter ends, once."""
    atexit.register(close_environments)
