"""The sizes of the small LIBERO policies, as configs in the published keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from saccade.errors import InputError
from saccade_lab.libero.checkpoint import PATCH_SIZE, VERSIONS, LiberoConfig
from saccade_lab.libero.layout import ACTION_DIM, STATE_DIM
from saccade_lab.random_checkpoint.tokenizer import token_id
from saccade_lab.sim.settings import vocabulary
from saccade_lab.training.settings import TrainingSettings
from saccade_lab.training.sizes import small_configs

MERGE = 2  # patches along each side of an image token, in both versions


def libero_config(settings: TrainingSettings, said: Sequence[str], frame_size: int) -> LiberoConfig:
    """The config of the policy that a run trains, without statistics.

    Args:
        settings: The settings of the run.
        said: The instructions of the tasks.
        frame_size: Pixels along each side of a recorded frame.

    Raises:
        InputError: Settings that no LIBERO policy has.
    """
    if settings.version not in VERSIONS:
        raise InputError(f"version: given {settings.version!r}, expected one of {', '.join(VERSIONS)}")
    side = MERGE * PATCH_SIZE
    if settings.patch_size != side:
        raise InputError(
            f"patch_size: given {settings.patch_size}, expected {side} on demonstrations of LIBERO"
        )
    if settings.view_size < side or settings.view_size % side:
        raise InputError(f"view_size: given {settings.view_size}, expected a multiple of {side}")
    if settings.absent_share:
        raise InputError(
            f"absent_share: given {settings.absent_share}, expected 0: which objects a scene of LIBERO lacks "
            "is not recorded"
        )
    is_n17 = settings.version == "n1.7"
    if is_n17 and settings.language_dropout:
        raise InputError(
            f"language_dropout: given {settings.language_dropout}, expected 0 with n1.7, which has no "
            "default for a missing instruction"
        )
    words = vocabulary(said)
    head, backbone = small_configs(
        settings,
        state_dim=STATE_DIM,
        action_dim=ACTION_DIM,
        image_size=frame_size,
        patch_size=side,
        words=words,
    )
    if is_n17:
        head, backbone = n17_head(head), n17_backbone(backbone, settings, words)
    else:
        backbone["vision_config"]["image_size"] = settings.view_size
    return LiberoConfig(
        version=settings.version,
        head=head,
        backbone=backbone,
        said=tuple(said),
        frame_size=frame_size,
        view_size=settings.view_size,
    )


def n17_head(n15: dict[str, Any]) -> dict[str, Any]:
    """The config of N1.7's head with the sizes of one of N1.5: no future tokens, alternating attention."""
    config = {
        key: value for key, value in n15.items() if key not in ("action_dim", "num_target_vision_tokens")
    }
    diffusion = {
        key: value for key, value in n15["diffusion_model_cfg"].items() if key != "cross_attention_dim"
    }
    return {
        **config,
        "model_type": "Gr00tN1d7",
        "attend_text_every_n_blocks": 2,
        "diffusion_model_cfg": diffusion,
        "state_dropout_prob": 0.0,
        "state_history_length": 1,
        "use_alternate_vl_dit": True,
    }


def n17_backbone(n15: dict[str, Any], settings: TrainingSettings, words: Sequence[str]) -> dict[str, Any]:
    """The config of N1.7's backbone with the sizes of one of N1.5.

    The outputs of the tower's first blocks are added inside the language model, one to each layer, as in
    the published checkpoint.
    """
    half = settings.features_width // settings.num_heads // 2  # rotary angles of an attention head
    axis = 5 * half // 16  # of height and of width; the published sections are 24, 20 and 20
    stacked = min(settings.language_layers, settings.vision_layers - 1)
    return {
        "select_layer": n15["select_layer"],
        "image_token_index": token_id("<|image_pad|>", published_ids=False, words=words),
        "text_config": {
            **n15["text_config"],
            "rope_scaling": {"mrope_interleaved": True, "mrope_section": [half - 2 * axis, axis, axis]},
        },
        "vision_config": {
            "hidden_size": settings.vision_width,
            "intermediate_size": 2 * settings.vision_width,
            "depth": settings.vision_layers,
            "num_heads": settings.vision_heads,
            "patch_size": PATCH_SIZE,
            "temporal_patch_size": 2,
            "spatial_merge_size": MERGE,
            "out_hidden_size": settings.features_width,
            "num_position_embeddings": (settings.view_size // PATCH_SIZE) ** 2,
            "deepstack_visual_indexes": list(range(stacked)),
        },
    }
