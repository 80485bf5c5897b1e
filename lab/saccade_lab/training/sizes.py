"""The configs of a small policy, from the sizes in the settings of its training."""

from __future__ import annotations

from typing import Any

from saccade_lab.sim.settings import backbone_config, head_config
from saccade_lab.training.settings import TrainingSettings


def small_configs(
    settings: TrainingSettings,
    *,
    state_dim: int,
    action_dim: int,
    image_size: int,
    patch_size: int,
    words: tuple[str, ...],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Configs of the head and of the backbone with N1.5's published keys.

    Args:
        settings: The settings of the run.
        state_dim, action_dim: Numbers of the robot's state and of its actions.
        image_size: Pixels along each side of a recorded frame.
        patch_size: Pixels along each side of the patch behind an image token.
        words: The words of the instructions.
    """
    head = head_config(
        width=settings.width,
        features_width=settings.features_width,
        num_layers=settings.num_layers,
        num_heads=settings.num_heads,
        vl_num_layers=settings.vl_num_layers,
        num_future_tokens=settings.num_future_tokens,
        horizon=settings.horizon,
        num_steps=settings.num_steps,
        state_dim=state_dim,
        action_dim=action_dim,
    )
    backbone = backbone_config(
        width=settings.features_width,
        num_layers=settings.language_layers,
        num_heads=settings.num_heads,
        vision_width=settings.vision_width,
        vision_layers=settings.vision_layers,
        vision_heads=settings.vision_heads,
        image_size=image_size,
        patch_size=patch_size,
        words=words,
    )
    return head, backbone
