"""What describes a small policy besides its weights: config, tokenizer and statistics, in NVIDIA's files."""

import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.files import write_json
from saccade.errors import CheckpointError
from saccade.head.config import HeadConfig
from saccade.processor import Processor
from saccade.robots import LANGUAGE_KEY, Normalizer
from saccade_lab.backbone_sizes import BackboneSizes, eagle_config
from saccade_lab.random_checkpoint.robot_metadata import metadata
from saccade_lab.random_checkpoint.tokenizer import token_id, tokenizer
from saccade_lab.sim.cameras import CameraPose
from saccade_lab.sim.tasks import TASKS

CONFIG_FILE, TENSOR_FILE = "config.json", "model.safetensors"
TOKENIZER_FILE, METADATA_FILE = "tokenizer.json", "experiment_cfg/metadata.json"
DATA_CONFIG_FILE = "experiment_cfg/data_config.json"

#: Every file of a policy.
FILES = (CONFIG_FILE, TENSOR_FILE, TOKENIZER_FILE, METADATA_FILE)

EMBODIMENT = "metaworld_sawyer"
EMBODIMENT_ID = 0
#: The parts of state and action, and how many numbers each has.
GROUPS = {"hand": 3, "gripper": 1}
CROP_SHARE = 0.95  # of each side of a frame; Isaac-GR00T's preprocessing crops to it


@dataclass(frozen=True)
class SimulationConfig:
    """How a policy is run in the simulator: ``simulation_cfg`` in its config.

    Attributes:
        tasks: The tasks it was trained on.
        cameras: The cameras, in the order of the prompt.
        image_size: Pixels along each side of a frame.
        execute_steps: Actions of a chunk that are executed before the next observation.
    """

    tasks: tuple[str, ...]
    cameras: tuple[CameraPose, ...]
    image_size: int
    execute_steps: int

    @classmethod
    def from_file(cls, path: Path) -> "SimulationConfig":
        """Reads it from a ``config.json``.

        Raises:
            FileNotFoundError: There is no such file.
            CheckpointError: A key is missing, or values do not fit.
        """
        try:
            whole = json.loads(path.read_text(encoding="utf-8"))
            values = whole["simulation_cfg"]
            config = cls(
                tasks=tuple(str(task) for task in values["tasks"]),
                cameras=tuple(CameraPose.from_dict(camera) for camera in values["cameras"]),
                image_size=int(values["image_size"]),
                execute_steps=int(values["execute_steps"]),
            )
            horizon = int(whole["action_head_cfg"]["action_horizon"])
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{path}: no such config; a policy is a directory with {CONFIG_FILE}"
            ) from None
        except KeyError as error:
            raise CheckpointError(
                f"{path}: key {error} is missing; is this a policy of saccade_lab.sim?"
            ) from None
        except (TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"{path}: {error}") from None
        problems = []
        if not config.tasks:
            problems.append("tasks: expected at least one")
        if not config.cameras:
            problems.append("cameras: expected at least one")
        if config.image_size < 8:
            problems.append(f"image_size: expected at least 8, got {config.image_size}")
        if not 1 <= config.execute_steps <= horizon:
            problems.append(f"execute_steps: expected 1 to {horizon}, got {config.execute_steps}")
        if problems:
            raise CheckpointError(f"{path}: simulation_cfg: {'; '.join(problems)}")
        return config

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "tasks": list(self.tasks),
            "cameras": [camera.to_dict() for camera in self.cameras],
            "image_size": self.image_size,
            "execute_steps": self.execute_steps,
        }


@dataclass(frozen=True)
class PolicyConfig:
    """All of a small policy that is decided before its training.

    Attributes:
        head: Config of the head, in the published keys.
        backbone: Config of the backbone, in the keys of ``saccade_lab.published.RELEASED``.
        simulation: How it is run in the simulator.
        words: Words that are one token each.
        statistics: Statistics of ``state`` and ``action``, by group, see ``statistics_of``; empty before the
            demonstrations are read.
    """

    head: Mapping[str, Any]
    backbone: Mapping[str, Any]
    simulation: SimulationConfig
    words: tuple[str, ...]
    statistics: Mapping[str, Mapping[str, Mapping[str, list[float]]]] = field(default_factory=dict)

    @property
    def instructions(self) -> tuple[tuple[str, ...], ...]:
        """The wordings of every task in ``TASKS``."""
        return tuple(task.instructions for task in TASKS.values())

    @property
    def impossible(self) -> tuple[tuple[int, ...], ...]:
        """Per task in ``TASKS``, the tasks of this policy that cannot be done in its scene."""
        tasks = list(TASKS.values())
        known = [list(TASKS).index(name) for name in self.simulation.tasks]
        return tuple(
            tuple(other for other in known if tasks[other].objects != task.objects) for task in tasks
        )

    @property
    def num_cameras(self) -> int:
        """Views of an observation."""
        return len(self.simulation.cameras)

    @property
    def frame_size(self) -> int:
        """Pixels along each side of a frame."""
        return self.simulation.image_size

    @property
    def head_config(self) -> HeadConfig:
        """The head's config."""
        return HeadConfig.from_dict(self.head)

    @property
    def backbone_sizes(self) -> BackboneSizes:
        """The backbone's sizes."""
        return BackboneSizes.from_config({**self.backbone, "kind": "n1.5 backbone"})

    @property
    def normalizer(self) -> Normalizer:
        """What the policy's states and actions are normalised by."""
        head = self.head_config
        return Normalizer.from_pretrained(
            self.metadata(),
            EMBODIMENT,
            data_config=self.data_config(),
            state_dim=head.state_dim,
            action_dim=head.action_dim,
        )

    def processor(self) -> Processor:
        """What prepares images and instruction, as found by :meth:`saccade.Policy.from_pretrained`."""
        vision = self.backbone["vision_config"]
        merged = 2 * vision["patch_size"]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / TOKENIZER_FILE
            write_json(path, tokenizer(published_ids=False, words=self.words))
            return Processor(
                "n1.5",
                path,
                preprocessing="isaac",
                image_size=vision["image_size"],
                tokens_per_view=(vision["image_size"] // merged) ** 2,
            )

    def to_dict(self) -> dict[str, Any]:
        """The content of ``config.json``: the published keys, and ``simulation_cfg``."""
        return {**n15_config(self.head, self.backbone), "simulation_cfg": self.simulation.to_dict()}

    def metadata(self) -> dict[str, Any]:
        """The content of ``experiment_cfg/metadata.json``: statistics, joints and cameras."""
        size = self.simulation.image_size
        about = {"resolution": [size, size], "channels": 3, "fps": 80.0}
        video = {camera.name: about for camera in self.simulation.cameras}
        groups = {"state": GROUPS, "action": GROUPS}
        return metadata(EMBODIMENT, self.statistics, groups, video)

    def data_config(self) -> dict[str, Any]:
        """The content of ``experiment_cfg/data_config.json``: groups and cameras, scaled by their bounds."""
        keys = {kind: [f"{kind}.{name}" for name in GROUPS] for kind in ("state", "action")}
        return {
            "video_keys": [f"video.{camera.name}" for camera in self.simulation.cameras],
            "state_keys": keys["state"],
            "action_keys": keys["action"],
            "language_keys": [LANGUAGE_KEY],
            "observation_indices": [0],
            "action_indices": list(range(self.head["action_horizon"])),
            "state_modes": dict.fromkeys(keys["state"], "min_max"),
            "action_modes": dict.fromkeys(keys["action"], "min_max"),
            "target_rotations": {},
        }

    def write(self, folder: Path) -> None:
        """Writes all files of the policy except its weights."""
        (folder / METADATA_FILE).parent.mkdir(parents=True, exist_ok=True)
        write_json(folder / METADATA_FILE, self.metadata())
        write_json(folder / DATA_CONFIG_FILE, self.data_config())
        write_json(folder / TOKENIZER_FILE, tokenizer(published_ids=False, words=self.words))
        write_json(folder / CONFIG_FILE, self.to_dict())


def statistics_of(
    values: npt.NDArray[np.floating[Any]], groups: Mapping[str, int] = GROUPS
) -> dict[str, dict[str, list[float]]]:
    """Statistics by group, as ``metadata.json`` has them.

    Args:
        values: ``(samples, width)``, the groups one after the other.
        groups: How many numbers each group has.
    """
    found, first = {}, 0
    for name, width in groups.items():
        group = values[:, first : first + width].astype(np.float64)
        first += width
        low, high = np.quantile(group, (0.01, 0.99), axis=0)
        found[name] = {
            key: [round(float(value), 6) for value in numbers]
            for key, numbers in {
                "min": group.min(axis=0),
                "max": group.max(axis=0),
                "mean": group.mean(axis=0),
                "std": group.std(axis=0),
                "q01": low,
                "q99": high,
            }.items()
        }
    return found


def n15_config(head: Mapping[str, Any], backbone: Mapping[str, Any]) -> dict[str, Any]:
    """The published keys of ``config.json`` of a whole N1.5 checkpoint."""
    return {
        "model_type": "gr00t_n1_5",
        "architectures": ["GR00T_N1_5"],
        "action_dim": head["action_dim"],
        "action_horizon": head["action_horizon"],
        "hidden_size": head["backbone_embedding_dim"],
        "action_head_cfg": dict(head),
        "backbone_cfg": {
            "select_layer": backbone["select_layer"],
            "project_to_dim": None,
            "eagle_config": eagle_config("n1.5", backbone),
        },
    }


def vocabulary(said: Sequence[str]) -> tuple[str, ...]:
    """The words of instructions, each of which becomes a token."""
    return tuple(sorted(set(re.findall("[a-z]+", " ".join(said)))))


def head_config(
    *,
    width: int,
    features_width: int,
    num_layers: int,
    num_heads: int,
    vl_num_layers: int,
    num_future_tokens: int,
    horizon: int,
    num_steps: int,
    state_dim: int,
    action_dim: int,
) -> dict[str, Any]:
    """A head config with the published keys, one embodiment, and one width except for the features."""
    heads = {"num_attention_heads": num_heads}
    common = {"dropout": 0.0, "final_dropout": False, "positional_embeddings": None}
    return {
        "action_dim": action_dim,
        "action_horizon": horizon,
        "add_pos_embed": True,
        "backbone_embedding_dim": features_width,
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
            **heads,
            "attention_head_dim": width // num_heads,
            "cross_attention_dim": features_width,
            "output_dim": width,
            "interleave_self_attention": True,
            "norm_type": "ada_norm",
            **common,
        },
        "vl_self_attention_cfg": {
            "num_layers": vl_num_layers,
            **heads,
            "attention_head_dim": features_width // num_heads,
            **common,
        },
    }


def backbone_config(
    *,
    width: int,
    num_layers: int,
    num_heads: int,
    vision_width: int,
    vision_layers: int,
    vision_heads: int,
    image_size: int,
    patch_size: int,
    words: tuple[str, ...],
) -> dict[str, Any]:
    """A backbone config with the published keys: a small SigLIP and a small Qwen3.

    The tower's patches have half the side of an image token's, four of which the connector joins
    (``use_pixel_shuffle``). A fine grid locates objects; few tokens keep the language model and the head
    fast.

    Args:
        width, num_layers, num_heads: Of the language model.
        vision_width, vision_layers, vision_heads: Of the tower.
        image_size: Pixels along each side of a frame, before preprocessing crops it.
        patch_size: Pixels along each side of the patch behind an image token, after preprocessing.
        words: See ``PolicyConfig``.
    """
    view = max(1, round(CROP_SHARE * image_size / patch_size)) * patch_size
    vocabulary = tokenizer(published_ids=False, words=words)["model"]["vocab"]
    return {
        "select_layer": num_layers,
        "project_to_dim": None,
        "use_pixel_shuffle": True,
        "downsample_ratio": 0.5,
        "mlp_connector_layers": 1,
        "image_token_index": token_id("<IMG_CONTEXT>", published_ids=False, words=words),
        "text_config": {
            "hidden_size": width,
            "intermediate_size": 2 * width,
            "num_hidden_layers": num_layers,
            "num_attention_heads": num_heads,
            "num_key_value_heads": max(1, num_heads // 2),
            "head_dim": width // num_heads,
            "vocab_size": len(vocabulary),
            "rms_norm_eps": 1e-6,
            "rope_theta": 1e4,
        },
        "vision_config": {
            "hidden_size": vision_width,
            "intermediate_size": 2 * vision_width,
            "num_hidden_layers": vision_layers,
            "num_attention_heads": vision_heads,
            "patch_size": patch_size // 2,
            "image_size": view,
            "layer_norm_eps": 1e-6,
        },
    }
