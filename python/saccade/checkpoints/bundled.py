"""The bundled policy: a small whole N1.5 checkpoint for five simulated tasks."""

from __future__ import annotations

from pathlib import Path


def demo_checkpoint() -> Path:
    """The directory of the bundled policy, a small whole GR00T N1.5 checkpoint.

    It drives a simulated arm in five tasks from camera images and an instruction. ``make rollout`` runs it.

    Example:
        >>> import saccade
        >>> policy = saccade.Policy.from_pretrained(saccade.demo_checkpoint())
        >>> policy.act(policy.example_observation(), seed=0)["hand"].shape
        (1, 16, 3)
    """
    return Path(__file__).parent / "demo"
