"""The sizes of a vision-language backbone, read from a config.

Used by the torch reference and by the writer of random checkpoints. The engine reads configs on its own, so
that each can check the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from saccade.errors import CheckpointError
from saccade_lab.published import RELEASED

#: ``model_type`` of a checkpoint's config, and the version of its backbone.
MODEL_TYPES: Mapping[str, str] = {"gr00t_n1_5": "n1.5", "Gr00tN1d6": "n1.6", "Gr00tN1d7": "n1.7"}


@dataclass(frozen=True)
class VisionSizes:
    """Sizes of the vision tower."""

    width: int
    mlp_width: int
    num_layers: int
    num_heads: int
    patch_size: int
    num_positions: int
    """Rows of the table of positions, a square grid."""
    eps: float
    deepstack: tuple[int, ...] = ()
    """N1.7: the blocks whose outputs are added inside the language model."""
    temporal_patch_size: int = 1
    """N1.7: how often a frame is repeated in a patch."""


@dataclass(frozen=True)
class TextSizes:
    """Sizes of the language model."""

    width: int
    mlp_width: int
    num_heads: int
    num_key_heads: int
    head_dim: int
    vocabulary: int
    eps: float
    theta: float
    sections: tuple[int, ...] = ()
    """N1.7: how many of the rotary angles use the time, height and width axis."""


@dataclass(frozen=True)
class BackboneSizes:
    """Sizes and switches of a backbone.

    Example:
        >>> sizes = BackboneSizes.from_config({"kind": "n1.5 backbone"})
        >>> sizes.num_layers, sizes.features_width
        (12, 2048)
    """

    version: str
    """``"n1.5"``, ``"n1.6"`` or ``"n1.7"``."""
    num_layers: int
    """Layers of the language model that are computed (``select_layer``)."""
    image_token: int
    """The token whose embeddings are replaced by image tokens."""
    connector_layers: int
    """1: one linear layer; 2: LayerNorm, linear, GELU, linear. N1.7's merger is of its own kind: 2."""
    merge: int
    """Patches along a side of the square that becomes one image token."""
    project_to_dim: int | None
    """Width of the linear layer after the last norm, or None if there is none."""
    vision: VisionSizes
    text: TextSizes

    @property
    def features_width(self) -> int:
        """Width of the features."""
        return self.text.width if self.project_to_dim is None else self.project_to_dim

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> BackboneSizes:
        """The sizes in a config.

        Args:
            config: A checkpoint's whole ``config.json``, or an object with the keys of `RELEASED` whose
                ``kind`` starts with the version. What is absent has the published size.

        Raises:
            CheckpointError: The version is unknown, or a size contradicts another.
        """
        version = _version(config)
        whole = merged(version, config)
        text, vision = whole["text_config"], whole["vision_config"]
        is_siglip = version != "n1.7"
        merge = 1
        if not is_siglip:
            merge = int(vision["spatial_merge_size"])
        elif whole["use_pixel_shuffle"]:
            merge = round(1 / whole["downsample_ratio"])
        if "image_size" in vision:
            num_positions = (vision["image_size"] // vision["patch_size"]) ** 2
        else:
            num_positions = vision["num_patches" if is_siglip else "num_position_embeddings"]
        sizes = cls(
            version=version,
            num_layers=whole["select_layer"],
            image_token=whole["image_token_index"],
            connector_layers=whole.get("mlp_connector_layers", 2),
            merge=merge,
            project_to_dim=whole.get("project_to_dim"),
            vision=VisionSizes(
                width=vision["hidden_size"],
                mlp_width=vision["intermediate_size"],
                num_layers=vision["num_hidden_layers" if is_siglip else "depth"],
                num_heads=vision["num_attention_heads" if is_siglip else "num_heads"],
                patch_size=vision["patch_size"],
                num_positions=num_positions,
                eps=vision.get("layer_norm_eps", 1e-6),
                deepstack=tuple(vision.get("deepstack_visual_indexes", ())),
                temporal_patch_size=vision.get("temporal_patch_size", 1),
            ),
            text=TextSizes(
                width=text["hidden_size"],
                mlp_width=text["intermediate_size"],
                num_heads=text["num_attention_heads"],
                num_key_heads=text["num_key_value_heads"],
                head_dim=text["head_dim"],
                vocabulary=text["vocab_size"],
                eps=text["rms_norm_eps"],
                theta=float(text["rope_theta"]),
                sections=tuple((text.get("rope_scaling") or {}).get("mrope_section", ())),
            ),
        )
        sizes._check()
        return sizes

    def _check(self) -> None:
        side = round(self.vision.num_positions**0.5)
        problems = {
            "a square table of positions": side * side == self.vision.num_positions,
            "a vision width that its heads divide": self.vision.width % self.vision.num_heads == 0,
            "key heads that divide the heads": self.text.num_heads % self.text.num_key_heads == 0,
            "1 or 2 connector layers": self.connector_layers in (1, 2),
        }
        missing = [expected for expected, holds in problems.items() if not holds]
        if missing:
            raise CheckpointError(f"config: expected {', '.join(missing)}, got {self}")


def _version(config: Mapping[str, Any]) -> str:
    """The version of a config."""
    kind = str(config.get("kind", "")).split(" ")[0]
    if kind in RELEASED:
        return kind
    if config.get("type") == "groot":  # lerobot's config has no size of the backbone
        return "n1.5"
    model_type = str(config.get("model_type"))
    if model_type not in MODEL_TYPES:
        expected = ", ".join(MODEL_TYPES)
        raise CheckpointError(f"config: expected model_type to be one of {expected}, got {model_type!r}")
    return MODEL_TYPES[model_type]


def merged(version: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """The released config, with what a config says instead, under the keys of `RELEASED`."""
    backbone = config.get("backbone_cfg") or {}
    whole = dict(RELEASED[version])
    for part in (config, config.get("eagle") or {}, backbone, backbone.get("eagle_config") or {}):
        # Inside Eagle's own config, select_layer is the layer of the vision tower; -1 is the last one.
        found = {key: value for key, value in part.items() if key in whole or key == "project_to_dim"}
        if found.get("select_layer", 0) < 0:
            del found["select_layer"]
        for nested in ("text_config", "vision_config"):
            if nested in found:
                found[nested] = {**whole[nested], **found[nested]}
        whole |= found
        ids = part.get("token_ids") or {}
        token = ids.get("image_token_id", part.get("image_token_id"))
        if token is not None:
            whole["image_token_index"] = token
    return whole


def eagle_config(version: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """A config with the keys of `RELEASED` as it stands in a checkpoint, under ``backbone_cfg.eagle_config``.

    ``select_layer`` and ``project_to_dim`` stand above it, in ``backbone_cfg``.
    """
    outer = ("select_layer", "project_to_dim", "image_token_index")
    inner = {key: value for key, value in config.items() if key not in outer}
    token = config["image_token_index"]
    if version == "n1.7":
        return inner | {"token_ids": {"image_token_id": token}}
    return inner | {"image_token_index": token, "select_layer": -1}
