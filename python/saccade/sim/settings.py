"""A policy's config.json: the published head config, the backbone's sizes, cameras, words, statistics."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._arrays import Float32Array
from saccade.config import HeadConfig
from saccade.errors import CheckpointError
from saccade.sim.backbone import BackboneConfig
from saccade.sim.cameras import Camera

CONFIG_FILE, TENSOR_FILE = "config.json", "model.safetensors"


@dataclass(frozen=True)
class Statistics:
    """Mean and standard deviation per dimension, over the demonstrations.

    Example:
        >>> Statistics(mean=(1.0,), std=(2.0,)).normalize(np.array([[3.0]]))
        array([[1.]], dtype=float32)
    """

    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def of(cls, values: npt.NDArray[np.floating[Any]]) -> "Statistics":
        """The statistics of `(samples, dimensions)`; the deviation is at least 0.001."""
        std = np.maximum(values.std(axis=0, dtype=np.float64), 1e-3)
        return cls(mean=rounded(values.mean(axis=0, dtype=np.float64)), std=rounded(std))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Statistics":
        """Reads a dict with the lists `mean` and `std`."""
        return cls(*(tuple(float(value) for value in values[key]) for key in ("mean", "std")))

    def normalize(self, values: npt.ArrayLike) -> Float32Array:
        """Normalises `(..., dimensions)` to zero mean and unit standard deviation."""
        given: Float32Array = np.asarray(values, dtype=np.float32)
        mean, std = np.array(self.mean, dtype=np.float32), np.array(self.std, dtype=np.float32)
        normalised: Float32Array = (given - mean) / std
        return normalised

    def restore(self, values: Float32Array) -> Float32Array:
        """The inverse of `normalize`."""
        mean, std = np.array(self.mean, dtype=np.float32), np.array(self.std, dtype=np.float32)
        restored: Float32Array = values * std + mean
        return restored


@dataclass(frozen=True)
class PolicyConfig:
    """The whole config of a policy.

    Attributes:
        head: The published head config, as in `config.json` under `action_head_cfg`.
        backbone: The sizes of the backbone.
        cameras: The cameras, in the order of the image tokens.
        vocabulary: The words of the tokenizer.
        execute_steps: Actions of a chunk that are executed before the next observation.
        tasks: The tasks it was trained on.
        state: Statistics of the proprioception.
        action: Statistics of the actions.
    """

    head: Mapping[str, Any]
    backbone: BackboneConfig
    cameras: tuple[Camera, ...]
    vocabulary: tuple[str, ...]
    execute_steps: int
    tasks: tuple[str, ...]
    state: Statistics
    action: Statistics

    @classmethod
    def from_file(cls, path: Path) -> "PolicyConfig":
        """Reads `config.json`.

        Raises:
            FileNotFoundError: there is none.
            CheckpointError: a key is missing, or values do not fit each other.
        """
        try:
            return cls.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{path}: no such config; a policy is a directory with {CONFIG_FILE}"
            ) from None
        except KeyError as error:
            raise CheckpointError(
                f"{path}: key {error} is missing; is this a policy of saccade.sim?"
            ) from None
        except (TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"{path}: {error}") from None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "PolicyConfig":
        """Reads a dict that `to_dict` returned; any other may raise `KeyError`, `TypeError` or similar."""
        policy = values["policy_cfg"]
        config = cls(
            head=dict(values["action_head_cfg"]),
            backbone=BackboneConfig.from_dict(values["backbone_cfg"]),
            cameras=tuple(Camera.from_dict(camera) for camera in policy["cameras"]),
            vocabulary=tuple(str(word) for word in policy["vocabulary"]),
            execute_steps=int(policy["execute_steps"]),
            tasks=tuple(str(task) for task in policy["tasks"]),
            state=Statistics.from_dict(policy["statistics"]["state"]),
            action=Statistics.from_dict(policy["statistics"]["action"]),
        )
        config.check()
        return config

    def check(self) -> None:
        """Raises `CheckpointError` that lists every inconsistency."""
        head = HeadConfig.from_dict(self.head)
        pairs = {
            "backbone width and backbone_embedding_dim": (self.backbone.width, head.context_dim),
            "cameras and num_cameras": (len(self.cameras), self.backbone.num_cameras),
            "vocabulary and vocabulary_size": (len(self.vocabulary), self.backbone.vocabulary_size),
            "state statistics and max_state_dim": (len(self.state.mean), head.state_dim),
            "action statistics and action_dim": (len(self.action.mean), head.action_dim),
        }
        problems = [f"{what} differ: {a} and {b}" for what, (a, b) in pairs.items() if a != b]
        if not 1 <= self.execute_steps <= head.action_horizon:
            problems.append(f"execute_steps {self.execute_steps} is not in 1..{head.action_horizon}")
        if problems:
            raise CheckpointError("; ".join(problems))

    def to_dict(self) -> dict[str, Any]:
        """For `config.json`; the head's part has the keys of published checkpoints."""
        return {
            "model_type": "gr00t_n1_5",
            "action_dim": self.head["action_dim"],
            "action_horizon": self.head["action_horizon"],
            "hidden_size": self.head["backbone_embedding_dim"],
            "action_head_cfg": dict(self.head),
            "backbone_cfg": vars(self.backbone),
            "policy_cfg": {
                "tasks": list(self.tasks),
                "cameras": [camera.to_dict() for camera in self.cameras],
                "vocabulary": list(self.vocabulary),
                "execute_steps": self.execute_steps,
                "statistics": {
                    "state": {"mean": list(self.state.mean), "std": list(self.state.std)},
                    "action": {"mean": list(self.action.mean), "std": list(self.action.std)},
                },
            },
        }


def head_config(
    *,
    width: int,
    num_layers: int,
    num_heads: int,
    vl_num_layers: int,
    num_future_tokens: int,
    horizon: int,
    num_steps: int,
    state_dim: int,
    action_dim: int,
) -> dict[str, Any]:
    """A head config with the published keys, all widths equal and one embodiment."""
    attention = {"num_attention_heads": num_heads, "attention_head_dim": width // num_heads}
    common = {"dropout": 0.0, "final_dropout": False, "positional_embeddings": None}
    return {
        "action_dim": action_dim,
        "action_horizon": horizon,
        "add_pos_embed": True,
        "backbone_embedding_dim": width,
        "hidden_size": width,
        "input_embedding_dim": width,
        "max_action_dim": action_dim,
        "max_num_embodiments": 1,
        "max_seq_len": horizon,
        "max_state_dim": state_dim,
        "model_dtype": "float32",
        "noise_beta_alpha": 1.5,
        "noise_beta_beta": 1.0,
        "noise_s": 0.999,
        "num_inference_timesteps": num_steps,
        "num_target_vision_tokens": num_future_tokens,
        "num_timestep_buckets": 1000,
        "use_vlln": True,
        "diffusion_model_cfg": {
            "num_layers": num_layers,
            **attention,
            "cross_attention_dim": width,
            "output_dim": width,
            "interleave_self_attention": True,
            "norm_type": "ada_norm",
            **common,
        },
        "vl_self_attention_cfg": {"num_layers": vl_num_layers, **attention, **common},
    }


def rounded(values: Sequence[float] | npt.NDArray[np.floating[Any]]) -> tuple[float, ...]:
    """Rounds to six decimals, so that a config stays readable."""
    return tuple(round(float(value), 6) for value in values)
