"""What a policy of the plan costs in multiply-adds, and what else the cost of its future tokens would buy.

Where only the head is trained, a training step counts the head's forward and backward alone. That leaves out
the training of the backbone and its features of the recording, which are computed once for all heads and do
not depend on N, and the optimiser.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benches.work import encode_work, sample_work, total
from saccade_lab.timing import Call
from saccade_lab.training.settings import TrainingSettings
from why_32.plan import Recording


@dataclass(frozen=True)
class Cost:
    """Multiply-adds of a policy.

    Attributes:
        chunk: Of one chunk of actions: backbone, encode and all Euler steps. Of a backbone without a head,
            its part.
        sample: Of one sample of a training step: forward and backward of what is trained.
    """

    chunk: int
    sample: int


def cost(training: TrainingSettings, recording: Recording) -> Cost:
    """Counts the multiply-adds of a policy.

    Those of the head are the engine's own (`benches.work`). Those of backbone and training are counted
    by torch while a policy of these sizes runs once. The prompt is the longest one of the recording's tasks.

    Args:
        training: Settings of the policy.
        recording: Its demonstrations.
    """
    import torch

    from saccade_lab.sim.tasks import find_task
    from saccade_lab.training.learner import NUM_TARGETS, Batch, Learner
    from saccade_lab.training.train import policy_config

    config = policy_config(training, recording.settings, list(recording.counts))
    size, head = recording.settings.image_size, config.head_config
    frames = [np.zeros((size, size, 3), np.uint8)] * len(recording.settings.cameras)
    texts = [text for name in recording.counts for text in find_task(name).instructions]
    processor = config.processor()
    inputs = max((processor(frames, text) for text in texts), key=lambda one: one.input_ids.shape[1])
    learner = Learner(config.backbone_sizes, head, training.aligned_block, training.only)
    with torch.no_grad():
        prepared = learner.backbone.prepare(inputs)
        of_backbone = counted(lambda: learner.backbone(prepared))
        seen = learner.backbone(prepared) if training.only == "head" else prepared
    horizon = head.action_horizon
    batch = Batch(
        seen,
        state=torch.zeros(1, head.state_dim),
        actions=torch.zeros(1, horizon, head.action_dim),
        mask=torch.ones(1, horizon, 1),
        targets=torch.zeros(1, NUM_TARGETS),
        later=None if training.aligned_block is None else seen,
    )

    noise, time = learner.draw_noise(batch, torch.Generator().manual_seed(0))

    def train() -> None:
        losses = learner.losses(batch, noise, time, learner.policy_tensors())
        sum(losses.values(), torch.zeros(())).backward()

    call = Call.of(head, inputs.input_ids.shape[1])
    of_head = 0
    if training.only != "backbone":
        of_head = total(encode_work(head, call)).multiply_adds + total(sample_work(head, call)).multiply_adds
    return Cost(of_head + of_backbone, counted(train))


def counted(work: Callable[[], Any]) -> int:
    """The multiply-adds of torch's matrix products and convolutions in `work`."""
    from torch.nn.attention import SDPBackend, sdpa_kernel
    from torch.utils.flop_counter import FlopCounterMode

    # The counter knows the products of attention, and not the kernel that fuses them on CPUs.
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        work()
    return int(counter.get_total_flops()) // 2


def matched_width(training: TrainingSettings, recording: Recording) -> int:
    """The width at which a head without future tokens, on the same backbone, has the most similar cost of a
    chunk.

    Args:
        training: Settings of a policy with future tokens.
        recording: Its demonstrations.
    """
    wanted = cost(training, recording).chunk
    step = 2 * training.num_heads  # of widths that the heads can have
    without = replace(
        training, num_future_tokens=0, alignment_weight=0.0, language_width=training.features_width
    )

    def chunk(width: int) -> int:
        return cost(replace(without, width=width), recording).chunk

    width = training.width
    while chunk(width + step) < wanted:
        width += step
    return min(width, width + step, key=lambda one: abs(chunk(one) - wanted))


def matched_steps(training: TrainingSettings, recording: Recording) -> int:
    """The training steps of a policy without future tokens that cost as much as the training of this one."""
    without = replace(training, num_future_tokens=0, alignment_weight=0.0)
    return round(training.steps * cost(training, recording).sample / cost(without, recording).sample)
