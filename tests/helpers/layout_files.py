"""The files of small checkpoints in each published layout: weights, configs, statistics and processors.

Names and keys are those of the published files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from tests.helpers.layout_heads import Config

#: Ids that the published code gives to the tags of its data.
N15_EMBODIMENTS = {"gr1": 24, "oxe_droid": 17, "agibot_genie1": 26}
N17_EMBODIMENTS = {"libero_sim": 2, "new_embodiment": 10}

#: What the statistics of a robot are over, and their widths; `hand` holds one constant.
STATE_GROUPS = {"arm": 5, "hand": 2}
ACTION_GROUPS = {"arm": 5, "hand": 1}


def backbone_tensors(seed: int) -> dict[str, Tensor]:
    """Tensors outside the head, in bfloat16 as frozen language models are stored."""
    generator = torch.Generator().manual_seed(seed + 1)
    names = (
        "eagle_model.language_model.model.layers.0.mlp.up_proj.weight",
        "eagle_model.vision_model.vision_model.embeddings.patch_embedding.bias",
    )
    return {name: torch.randn(6, 8, generator=generator).bfloat16() for name in names}


def write_json(path: Path, value: object) -> None:
    """Indented as the published files are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2))


def save(folder: Path, tensors: Mapping[str, Tensor]) -> None:
    """`model.safetensors` with the metadata that transformers and lerobot write."""
    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    save_file(contiguous, folder / "model.safetensors", {"format": "pt"})


# --- NVIDIA and Isaac-GR00T ---


def write_nvidia(folder: Path, config: Config, head: dict[str, Tensor], seed: int) -> None:
    """N1 and N1.5: `config.json` with `action_head_cfg`, `backbone.*` and `action_head.*`, statistics in
    `experiment_cfg/metadata.json`."""
    model_type = config.pop("model_type")
    architecture = {"gr00t_n1": "GR00T_N1", "gr00t_n1_5": "GR00T_N1_5"}[model_type]
    write_json(
        folder / "config.json",
        {
            "action_dim": config["max_action_dim"],
            "action_head_cfg": config,
            "action_horizon": config["action_horizon"],
            "architectures": [architecture],
            "attn_implementation": None,
            "backbone_cfg": {
                "eagle_path": "NVEagle/eagle_er-qwen3_1_7B-Siglip2_400M_stage1_5_128gpu_er_v7_1mlp_nops",
                "load_bf16": False,
                "project_to_dim": None,
                "reproject_vision": False,
                "select_layer": 12,
                "tune_llm": False,
                "tune_visual": True,
                "use_flash_attention": True,
            },
            "compute_dtype": "bfloat16",
            "hidden_size": 2048,
            "model_dtype": "float32",
            "model_type": model_type,
            "torch_dtype": "bfloat16",
            "transformers_version": "4.51.3",
        },
    )
    tensors = {f"action_head.{name}": tensor for name, tensor in head.items()}
    save(folder, tensors | {f"backbone.{name}": tensor for name, tensor in backbone_tensors(seed).items()})
    write_metadata(folder, [*N15_EMBODIMENTS, "new_embodiment"], seed)


def write_isaac(folder: Path, config: Config, head: dict[str, Tensor], seed: int) -> None:
    """A fine-tune of N1.5: as NVIDIA's, with the statistics of one robot and the trainer's own file."""
    write_nvidia(folder, config, head, seed)
    write_metadata(folder, ["new_embodiment"], seed)
    write_json(folder / "trainer_state.json", {"global_step": 10000, "max_steps": 10000})


def write_metadata(folder: Path, tags: Sequence[str], seed: int) -> None:
    """`experiment_cfg/metadata.json`: statistics of each robot."""
    write_json(
        folder / "experiment_cfg" / "metadata.json",
        {tag: dataset_metadata(tag, seed + index) for index, tag in enumerate(tags)},
    )


def dataset_metadata(tag: str, seed: int) -> Config:
    """One embodiment's entry of `experiment_cfg/metadata.json`."""
    return {
        "statistics": {
            "state": group_statistics(STATE_GROUPS, seed),
            "action": group_statistics(ACTION_GROUPS, seed + 100),
        },
        "modalities": {
            "video": {"front": {"resolution": [640, 480], "channels": 3, "fps": 30.0}},
            **{
                kind: {
                    name: {"absolute": True, "rotation_type": None, "shape": [width], "continuous": True}
                    for name, width in groups.items()
                }
                for kind, groups in (("state", STATE_GROUPS), ("action", ACTION_GROUPS))
            },
        },
        "embodiment_tag": tag,
    }


def group_statistics(groups: Mapping[str, int], seed: int) -> Config:
    """Statistics of each group of joints; the last dimension of `hand` never moves."""
    generator = torch.Generator().manual_seed(seed)
    statistics = {}
    for name, width in groups.items():
        centre, half = torch.randn(2, width, generator=generator, dtype=torch.float64)
        half = half.abs() + 0.1
        if name == "hand":
            half[-1] = 0.0
        statistics[name] = {
            key: (centre + share * half).tolist()
            for key, share in (("max", 1.0), ("min", -1.0), ("mean", 0.1), ("q01", -0.9), ("q99", 0.9))
        } | {"std": (half / 2).tolist()}
    return statistics


def write_flat(folder: Path, config: Config, head: dict[str, Tensor], seed: int) -> None:
    """N1.6 and N1.7: a flat `config.json`, statistics and ids of embodiments in files of their own."""
    is_n17 = config["model_type"] == "Gr00tN1d7"
    write_json(
        folder / "config.json",
        {
            "architectures": [config["model_type"]],
            "backbone_model_type": "qwen" if is_n17 else "eagle",
            "backbone_trainable_params_fp32": True,
            "dtype": "bfloat16",
            "image_crop_size": [230, 230],
            "image_target_size": [256, 256],
            "load_bf16": False,
            "model_dtype": "bfloat16",
            "model_name": "nvidia/Cosmos-Reason2-2B" if is_n17 else "nvidia/Eagle-Block2A-2B-v2",
            "select_layer": 16,
            "transformers_version": "4.57.3",
            "tune_diffusion_model": True,
            "tune_llm": False,
            "tune_projector": True,
            "tune_visual": False,
            "tune_vlln": True,
            "use_flash_attention": True,
            "use_relative_action": False,
            **config,
        },
    )
    extra = {} if is_n17 else {"mask_token": 0.02 * torch.ones(1, 1, config["input_embedding_dim"])}
    tensors = {f"action_head.{name}": tensor for name, tensor in (head | extra).items()}
    save(folder, tensors | {f"backbone.{name}": tensor for name, tensor in backbone_tensors(seed).items()})
    write_json(folder / "embodiment_id.json", N17_EMBODIMENTS)
    write_json(
        folder / "statistics.json",
        {
            tag: {
                "state": group_statistics(STATE_GROUPS, seed + index),
                "action": group_statistics(ACTION_GROUPS, seed + index + 100),
                "relative_action": {},
            }
            for index, tag in enumerate(N17_EMBODIMENTS)
        },
    )
    write_json(
        folder / "processor_config.json",
        {
            "processor_class": "Gr00tN1d7Processor" if is_n17 else "Gr00tN1d6Processor",
            "processor_kwargs": {
                "clip_outliers": True,
                "max_action_dim": config["max_action_dim"],
                "max_action_horizon": config["action_horizon"],
                "max_state_dim": config["max_state_dim"],
                "modality_configs": {tag: modality_config() for tag in N17_EMBODIMENTS},
                "use_percentiles": True,
                "use_relative_action": False,
            },
        },
    )


def modality_config() -> Config:
    """One embodiment's groups, as `processor_config.json` names them."""
    keys = {
        "video": (["front"], [0]),
        "state": (list(STATE_GROUPS), [0]),
        "action": (list(ACTION_GROUPS), list(range(16))),
        "language": (["annotation.human.action.task_description"], [0]),
    }
    return {
        kind: {"delta_indices": indices, "modality_keys": names} for kind, (names, indices) in keys.items()
    }


# --- lerobot and the forks ---


def write_lerobot(folder: Path, config: Config, head: dict[str, Tensor], seed: int) -> None:
    """lerobot up to 0.5.1 and the forks of it: one file under `_groot_model.`, the policy's own `config.json`
    without a size of the head, statistics next to the processors."""
    is_fork = bool(config.get("use_multi_action_heads"))
    chunk_size = 32 if is_fork else 50
    policy = lerobot_policy("nvidia/GR00T-N1.5-3B") | {
        "chunk_size": chunk_size,
        "n_action_steps": chunk_size,
        "max_state_dim": config["max_state_dim"],
        "max_action_dim": config["max_action_dim"],
        "image_size": [224, 224],
        "tokenizer_assets_repo": "lerobot/eagle2hg-processor-groot-n1p5",
        "lora_rank": 0,
        "lora_alpha": 16,
        "lora_dropout": 0.1,
        "lora_full_model": False,
        "video_backend": "decord",
    }
    write_json(folder / "config.json", policy)
    save_lerobot(folder, head, seed)
    state, action = flat_statistics("observation.state", 7, seed), flat_statistics("action", 6, seed + 100)
    pack = {
        "state_horizon": 1,
        "action_horizon": min(chunk_size, 16),
        "max_state_dim": config["max_state_dim"],
        "max_action_dim": config["max_action_dim"],
        "language_key": "task",
        "formalize_language": False,
        "embodiment_tag": "new_embodiment",
        "embodiment_mapping": {"new_embodiment": 31, **N15_EMBODIMENTS, "so100": 2, "unitree_g1": 3},
        "normalize_min_max": True,
    }
    write_processors(
        folder, "groot_pack_inputs_v3", pack, "groot_action_unpack_unnormalize_v1", state | action
    )


def write_lerobot_n17(folder: Path, config: Config, head: dict[str, Tensor], seed: int) -> None:
    """lerobot after 0.5.1: N1.7 only."""
    policy = lerobot_policy("nvidia/GR00T-N1.7-3B") | {
        "chunk_size": 40,
        "n_action_steps": 40,
        "max_state_dim": config["max_state_dim"],
        "max_action_dim": config["max_action_dim"],
        "action_decode_transform": None,
        "tune_vlln": True,
        "tune_top_llm_layers": 0,
        "num_inference_timesteps": None,
        "rtc_ramp_rate": None,
        "use_relative_actions": False,
        "relative_exclude_joints": [],
        "model_params_fp32": True,
        "image_size": [256, 256],
        "tokenizer_assets_repo": None,
    }
    write_json(folder / "config.json", policy)
    save_lerobot(folder, head, seed)
    state, action = flat_statistics("observation.state", 7, seed), flat_statistics("action", 6, seed + 100)
    pack = {
        "state_horizon": 1,
        "action_horizon": config["action_horizon"],
        "valid_action_horizon": config["action_horizon"],
        "video_horizon": None,
        "max_state_dim": config["max_state_dim"],
        "max_action_dim": config["max_action_dim"],
        "language_key": "task",
        "formalize_language": True,
        "embodiment_tag": "new_embodiment",
        "embodiment_mapping": N17_EMBODIMENTS,
        "normalize_min_max": True,
        "state_dropout_prob": 0.0,
        "clip_outliers": True,
        "use_percentiles": False,
        "video_modality_keys": None,
        "raw_stats": None,
        "modality_config": None,
    }
    write_processors(
        folder, "groot_n1_7_pack_inputs_v1", pack, "groot_action_unpack_unnormalize_v2", state | action
    )


def lerobot_policy(base_model: str) -> Config:
    """What the `config.json` of every lerobot GR00T policy holds."""
    return {
        "type": "groot",
        "n_obs_steps": 1,
        "input_features": {
            "observation.images.front": {"type": "VISUAL", "shape": [3, 480, 640]},
            "observation.state": {"type": "STATE", "shape": [7]},
        },
        "output_features": {"action": {"type": "ACTION", "shape": [6]}},
        "device": "cuda",
        "use_amp": False,
        "push_to_hub": False,
        "repo_id": None,
        "private": None,
        "tags": None,
        "license": None,
        "pretrained_path": None,
        "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
        "base_model_path": base_model,
        "embodiment_tag": "new_embodiment",
        "tune_llm": False,
        "tune_visual": False,
        "tune_projector": True,
        "tune_diffusion_model": True,
        "optimizer_lr": 0.0001,
        "optimizer_betas": [0.95, 0.999],
        "optimizer_eps": 1e-08,
        "optimizer_weight_decay": 1e-05,
        "warmup_ratio": 0.05,
        "use_bf16": True,
    }


def save_lerobot(folder: Path, head: Mapping[str, Tensor], seed: int) -> None:
    """Head and backbone under lerobot's prefix."""
    tensors = {f"_groot_model.action_head.{name}": tensor for name, tensor in head.items()}
    backbone = {f"_groot_model.backbone.{name}": tensor for name, tensor in backbone_tensors(seed).items()}
    save(folder, tensors | backbone)


def flat_statistics(key: str, width: int, seed: int) -> dict[str, Tensor]:
    """`key.min`, `key.max`, ...: what lerobot keeps of a dataset; the last dimension never moves."""
    generator = torch.Generator().manual_seed(seed)
    centre, half = torch.randn(2, width, generator=generator)
    half = half.abs() + 0.1
    half[-1] = 0.0
    shares = {"min": -1.0, "max": 1.0, "mean": 0.1, "q01": -0.9, "q99": 0.9}
    return {f"{key}.{name}": centre + share * half for name, share in shares.items()} | {
        f"{key}.std": half / 2
    }


def write_processors(
    folder: Path, pack_name: str, pack: Config, unpack_name: str, statistics: Mapping[str, Tensor]
) -> None:
    """lerobot's two pipelines, each with its statistics in a file that its entry names."""
    for name, index, registry_name, step_config, others in (
        (
            "policy_preprocessor",
            2,
            pack_name,
            pack,
            [
                {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
                {"registry_name": "to_batch_processor", "config": {}},
            ],
        ),
        ("policy_postprocessor", 0, unpack_name, {"env_action_dim": 6, "normalize_min_max": True}, []),
    ):
        state_file = f"{name}_step_{index}_{registry_name}.safetensors"
        save_file(dict(statistics), folder / state_file)
        step = {"registry_name": registry_name, "config": step_config, "state_file": state_file}
        device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
        write_json(folder / f"{name}.json", {"name": name, "steps": [*others, step, device]})


# --- saccade ---


def write_saccade(folder: Path, config: Config, head: dict[str, Tensor], seed: int) -> None:
    """What `saccade train` and `saccade convert` write: the head's tensors, nothing else needed."""
    write_json(folder / "config.json", {"action_head_cfg": config})
    save(folder, {f"action_head.{name}": tensor for name, tensor in head.items()})
