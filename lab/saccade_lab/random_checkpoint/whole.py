"""Writes a random whole checkpoint in NVIDIA's layout: backbone, head, statistics, tokenizer. NumPy only."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.files import write_json
from saccade.errors import InputError
from saccade.robots.data_configs import LANGUAGE_KEY
from saccade_lab.backbone_sizes import BackboneSizes, eagle_config, merged
from saccade_lab.published import CONFIGS, RELEASED, small_config, whole_config
from saccade_lab.random_checkpoint.backbone_tensors import tensor_shapes, unread_tensor_shapes
from saccade_lab.random_checkpoint.robot_metadata import metadata
from saccade_lab.random_checkpoint.robots import ROBOTS, RandomRobot
from saccade_lab.random_checkpoint.tensors import Outliers, Tensor, write_file
from saccade_lab.random_checkpoint.tokenizer import FIRST_ADDED, token_id, tokenizer

#: The added token that stands for an image token.
IMAGE_TOKENS = {"n1.5": "<IMG_CONTEXT>", "n1.6": "<IMG_CONTEXT>", "n1.7": "<|image_pad|>"}

_EAGLE = "NVEagle/eagle_er-qwen3_1_7B-Siglip2_400M_stage1_5_128gpu_er_v7_1mlp_nops"


def small_backbone(version: str) -> dict[str, Any]:
    """A config with the keys of ``RELEASED`` and small sizes, for the tokenizer without gaps.

    Args:
        version: ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``.
    """
    config = copy.deepcopy(dict(RELEASED[version]))
    config |= {"kind": f"{version} backbone", "select_layer": 3}
    config["image_token_index"] = token_id(IMAGE_TOKENS[version], published_ids=False)
    config["text_config"] |= {
        "hidden_size": 128,
        "intermediate_size": 192,
        "num_hidden_layers": 5,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 32,
        "vocab_size": 512,
    }
    if version == "n1.7":
        config["text_config"]["rope_scaling"] = {"mrope_interleaved": True, "mrope_section": [6, 5, 5]}
        config["vision_config"] |= {
            "hidden_size": 64,
            "intermediate_size": 96,
            "depth": 4,
            "num_heads": 2,
            "out_hidden_size": 128,
            "num_position_embeddings": 36,
            "deepstack_visual_indexes": [0, 1, 2],
        }
        return config
    config["vision_config"] |= {
        "hidden_size": 72,
        "intermediate_size": 136,
        "num_hidden_layers": 3,
        "num_attention_heads": 2,
    }
    config["vision_config"] |= {"image_size": 56} if version == "n1.5" else {"num_patches": 16}
    return config


def small_head(version: str) -> dict[str, Any]:
    """The config of a small head for the features of ``small_backbone``, with the published embodiments."""
    return small_config(version) | {"max_num_embodiments": 32}


def write(
    folder: Path,
    version: str = "n1.5",
    *,
    backbone: Mapping[str, Any] | None = None,
    head: Mapping[str, Any] | None = None,
    seed: int = 0,
    head_dtype: str = "BF16",
    outliers: bool = False,
    shard_bytes: int = 2_500_000_000,
    robot: str = "arm",
) -> Path:
    """Writes a checkpoint: shards with an index, ``config.json``, statistics, ``tokenizer.json``.

    Args:
        folder: Where; made if it does not exist, and otherwise empty.
        version: ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``.
        backbone: Config with the keys of :data:`saccade_lab.published.RELEASED`, or those of it
            that differ. Default: the published sizes.
        head: Config of the head in the released keys, for features as wide as the backbone's. Default: the
            published sizes.
        seed: Of all tensors and statistics.
        head_dtype: ``"BF16"`` or ``"F32"``, as published. The backbone is bfloat16.
        outliers: Plants outliers; see :class:`saccade_lab.random_checkpoint.tensors.Outliers`.
        shard_bytes: A shard is complete when it reaches this size.
        robot: ``"arm"`` for five joints and a gripper, or ``"libero"`` for LIBERO's arm and cameras.

    Returns:
        ``folder``.

    Raises:
        InputError: The folder is not empty, the robot is unknown, or the head takes features of another width
            or has too few embodiments.
        CheckpointError: A config is not one of a head or of a backbone.
        OSError: A file cannot be written.

    Example:
        >>> import tempfile, saccade
        >>> folder = Path(tempfile.mkdtemp()) / "checkpoint"
        >>> _ = write(folder, "n1.5", backbone=small_backbone("n1.5"), head=small_head("n1.5"))
        >>> saccade.ActionHead.from_pretrained(folder).config.context_dim
        128
    """
    if head_dtype not in ("BF16", "F32"):
        raise InputError(f"head_dtype: expected 'BF16' or 'F32', got {head_dtype!r}")
    if robot not in ROBOTS:
        raise InputError(f"robot: unknown name {robot!r}, expected one of {', '.join(ROBOTS)}")
    owner = ROBOTS[robot]
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: expected an empty directory")
    config = merged(version, backbone or {})
    sizes = BackboneSizes.from_config({**config, "kind": f"{version} backbone"})
    head_config = dict(CONFIGS[version] if head is None else head)
    width = head_config["backbone_embedding_dim"]
    if width != sizes.features_width:
        raise InputError(f"head: expected features of width {sizes.features_width}, got {width}")
    if head_config["max_num_embodiments"] <= owner.ids[version]:
        raise InputError(
            f"head: expected more than {owner.ids[version]} embodiments, the id of {owner.tags[version]}, "
            f"got {head_config['max_num_embodiments']}"
        )
    tensors = [Tensor(f"backbone.{name}", shape, "BF16") for name, shape in tensor_shapes(sizes)]
    tensors += [Tensor(f"backbone.{name}", shape, "BF16") for name, shape in unread_tensor_shapes(sizes)]
    whole_head = json.dumps(whole_config(head_config))
    tensors += [
        Tensor(f"action_head.{name}", tuple(shape), head_dtype)
        for name, shape in _saccade.tensor_shapes(whole_head)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    _write_tensors(folder, tensors, seed, Outliers(sizes) if outliers else None, shard_bytes)
    write_json(
        folder / "config.json", _config(version, head_config, config, sizes, released=backbone is None)
    )
    write_json(folder / "tokenizer.json", tokenizer(published_ids=sizes.text.vocabulary > FIRST_ADDED))
    _write_statistics(folder, version, head_config, seed, owner)
    return folder


def _write_tensors(
    folder: Path, tensors: Sequence[Tensor], seed: int, outliers: Outliers | None, shard_bytes: int
) -> None:
    """Writes the shards and their index."""
    shards = list(_shards(tensors, shard_bytes))
    weight_map: dict[str, str] = {}
    for number, shard in enumerate(shards, start=1):
        name = f"model-{number:05}-of-{len(shards):05}.safetensors"
        weight_map |= {tensor.name: name for tensor in shard}
        write_file(folder / name, shard, seed, None if outliers is None else outliers.plant)
    total = sum(tensor.nbytes for tensor in tensors)
    index = {"metadata": {"total_size": total}, "weight_map": weight_map}
    write_json(folder / "model.safetensors.index.json", index)


def _shards(tensors: Sequence[Tensor], shard_bytes: int) -> Iterator[list[Tensor]]:
    """The tensors in order, cut where a shard reaches its size."""
    shard: list[Tensor] = []
    for tensor in tensors:
        shard.append(tensor)
        if sum(held.nbytes for held in shard) >= shard_bytes:
            yield shard
            shard = []
    if shard:
        yield shard


def _config(
    version: str,
    head: Mapping[str, Any],
    backbone: Mapping[str, Any],
    sizes: BackboneSizes,
    *,
    released: bool,
) -> dict[str, Any]:
    """The content of ``config.json``, with sizes of the backbone if they are not the published ones."""
    own: dict[str, Any] = {"select_layer": sizes.num_layers}
    if not released:
        own["eagle_config"] = eagle_config(version, backbone)
    if version == "n1.5":
        return {
            **whole_config(head),
            "action_dim": head["max_action_dim"],
            "action_horizon": head["action_horizon"],
            "architectures": ["GR00T_N1_5"],
            "backbone_cfg": {
                "eagle_path": _EAGLE,
                "load_bf16": False,
                "project_to_dim": sizes.project_to_dim,
                "reproject_vision": False,
                "tune_llm": False,
                "tune_visual": True,
                "use_flash_attention": True,
                **own,
            },
            "compute_dtype": "bfloat16",
            "hidden_size": sizes.features_width,
            "model_dtype": "float32",
            "torch_dtype": "bfloat16",
            "transformers_version": "4.51.3",
        }
    return {
        **head,
        "architectures": [head["model_type"]],
        "backbone_model_type": "qwen" if version == "n1.7" else "eagle",
        "model_name": "nvidia/Cosmos-Reason2-2B" if version == "n1.7" else "nvidia/Eagle-Block2A-2B-v2",
        "select_layer": sizes.num_layers,
        "use_relative_action": False,
        **({} if released else {"backbone_cfg": own}),
    }


def _write_statistics(
    folder: Path, version: str, head: Mapping[str, Any], seed: int, robot: RandomRobot
) -> None:
    """The robot's statistics and cameras, in the files of the version."""
    statistics = robot.statistics(np.random.default_rng(seed))
    tag = robot.tags[version]
    if version == "n1.5":
        about = {"resolution": list(robot.resolution), "channels": 3, "fps": 30.0}
        video = {name: dict(about) for name in robot.cameras}
        groups = {"state": robot.state, "action": robot.action}
        (folder / "experiment_cfg").mkdir()
        write_json(folder / "experiment_cfg" / "metadata.json", metadata(tag, statistics, groups, video))
        return
    write_json(folder / "embodiment_id.json", {tag: robot.ids[version]})
    write_json(folder / "statistics.json", {tag: {**statistics, "relative_action": {}}})
    keys: dict[str, tuple[Sequence[str], list[int]]] = {
        "video": (robot.cameras, [0]),
        "state": (list(robot.state), [0]),
        "action": (list(robot.action), list(range(16))),
        "language": ([LANGUAGE_KEY], [0]),
    }
    modality_config = {
        kind: {"delta_indices": indices, "modality_keys": list(names)}
        for kind, (names, indices) in keys.items()
    }
    values = {
        "processor_class": "Gr00tN1d7Processor" if version == "n1.7" else "Gr00tN1d6Processor",
        "processor_kwargs": {
            "clip_outliers": True,
            "crop_fraction": 0.95,
            "formalize_language": True,
            **({"letter_box_transform": False} if version == "n1.7" else {}),
            "max_action_dim": head["max_action_dim"],
            "max_action_horizon": head["action_horizon"],
            "max_state_dim": head["max_state_dim"],
            "modality_configs": {tag: modality_config},
            "shortest_image_edge": 256,
            "use_albumentations": True,
            "use_percentiles": True,
            "use_relative_action": False,
        },
    }
    write_json(folder / "processor_config.json", values)
