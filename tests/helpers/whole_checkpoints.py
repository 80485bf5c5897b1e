"""Small whole checkpoints in the published layouts: a backbone, a head, a tokenizer, processors, statistics.

The backbones are those of `tests/data/backbone`, so their names, shapes and features are the released code's.
The heads and the other files are those of `layouts`, as wide as these backbones.
"""

from __future__ import annotations

import atexit
import functools
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.helpers import layout_files, layout_heads, layouts

DATA = Path(__file__).parents[1] / "data" / "backbone"

Config = dict[str, Any]

#: The layouts, and the file whose backbone each has. Each layout is one of `layouts.LAYOUTS`.
BACKBONES = {
    "nvidia": "n15_one_view",
    "isaac": "n15_one_view",
    "lerobot": "n15_two_views",
    "n16": "n16_two_views",
    "n17": "n17_two_views",
    "lerobot-n17": "n17_one_view",
}
LAYOUTS = tuple(BACKBONES)

#: The cameras of every robot, in the order of the prompt, and the size of their frames.
CAMERAS = ("wrist", "front")
HEIGHT, WIDTH = 40, 48

#: The robot that every layout has.
EMBODIMENT = "new_embodiment"


def about_backbone(layout: str) -> Config:
    """What `tests/data/backbone` says of the backbone of a layout."""
    with safe_open(DATA / f"{BACKBONES[layout]}.safetensors", "pt") as file:
        about: Config = json.loads(file.metadata()["about"])
    return about


def backbone_tensors(layout: str) -> dict[str, Tensor]:
    """The tensors of a layout's backbone, by their name in a checkpoint of NVIDIA or of lerobot."""
    prefix = "_groot_model.backbone." if layout.startswith("lerobot") else "backbone."
    with safe_open(DATA / f"{BACKBONES[layout]}.safetensors", "pt") as file:
        return {
            prefix + name.partition("backbone.")[2]: file.get_tensor(name)
            for name in file.keys()  # noqa: SIM118 (it is not a mapping)
            if not name.startswith("_") or name.startswith("_groot_model.")
        }


def head_config(layout: str) -> Config:
    """The head's config of a layout, for features as wide as the backbone's."""
    config = layout_heads.head_config(layout)
    width = about_backbone(layout)["text_config"]["hidden_size"]
    config["backbone_embedding_dim"] = width
    if "cross_attention_dim" in config["diffusion_model_cfg"]:
        config["diffusion_model_cfg"]["cross_attention_dim"] = width
    if config.get("vl_self_attention_cfg"):
        config["vl_self_attention_cfg"] |= {"num_attention_heads": 1, "attention_head_dim": width}
    return config


def data_config(*cameras: str) -> Config:
    """A data config of three actions for the robot of `isaac`, which looks through these cameras."""
    return {
        "video_keys": [f"video.{name}" for name in cameras],
        "state_keys": ["state.hand", "state.arm"],
        "action_keys": ["action.arm", "action.hand"],
        "language_keys": ["annotation.human.task_description"],
        "observation_indices": [0],
        "action_indices": [0, 1, 2],
        "state_modes": {"state.arm": "q99", "state.hand": "min_max"},
        "action_modes": {"action.arm": "min_max", "action.hand": "min_max"},
        "target_rotations": {},
    }


def write(folder: Path, layout: str, *, seed: int = 0, tokenizer: bool = True) -> Path:
    """Writes a whole checkpoint.

    Args:
        folder: Where; made if it is not there.
        layout: One of `LAYOUTS`.
        seed: Of the head and the statistics.
        tokenizer: Whether `tokenizer.json` is among the files, which NVIDIA's checkpoints lack.

    Returns:
        `folder`.
    """
    layouts.write(folder, layout, seed=seed, config=head_config(layout))
    shards = sorted(folder.glob("model*.safetensors"))
    # Not the statistics of lerobot's processors, which are in safetensors too.
    tensors = {name: tensor for shard in shards for name, tensor in load_file(shard).items()}
    tensors = {name: tensor for name, tensor in tensors.items() if "backbone." not in name}
    for path in [*shards, *folder.glob("*.index.json")]:
        path.unlink()
    save_file(tensors | backbone_tensors(layout), folder / "model.safetensors", {"format": "pt"})
    if len(shards) > 1:
        layouts.split(folder, len(shards))
    _edit(folder / "config.json", lambda config: config.update(backbone_cfg=_backbone_config(layout, config)))
    _name_cameras(folder, layout)
    if tokenizer:
        shutil.copy(DATA / "tiny_tokenizer.json", folder / "tokenizer.json")
    return folder


@functools.cache
def whole(layout: str, seed: int = 0) -> Path:
    """A whole checkpoint, written once; not to be changed."""
    folder = Path(tempfile.mkdtemp(prefix=f"saccade-whole-{layout}-"))
    atexit.register(shutil.rmtree, folder)
    return write(folder, layout, seed=seed)


def _backbone_config(layout: str, config: Config) -> Config:
    """`backbone_cfg` with the sizes of the backbone, under the keys of `about`."""
    about = about_backbone(layout)
    keys = ("text_config", "vision_config", "token_ids", "image_token_index", "downsample_ratio")
    sizes = {key: about[key] for key in keys if key in about} | about.get("eagle", {})
    found = {**config.get("backbone_cfg", {}), "select_layer": about["select_layer"], "eagle_config": sizes}
    if "project_to_dim" in about:
        found["project_to_dim"] = about["project_to_dim"]
    return found


def _name_cameras(folder: Path, layout: str) -> None:
    """Replaces the camera of `layouts` by `CAMERAS`."""
    if layout.startswith("lerobot"):
        visual = {"type": "VISUAL", "shape": [3, HEIGHT, WIDTH]}

        def lerobot(config: Config) -> None:
            features = {f"observation.images.{name}": dict(visual) for name in CAMERAS}
            config["input_features"] = features | {"observation.state": {"type": "STATE", "shape": [7]}}

        _edit(folder / "config.json", lerobot)
    elif layout in ("n16", "n17"):

        def processor(config: Config) -> None:
            kwargs = config["processor_kwargs"]
            kwargs |= {"shortest_image_edge": 256, "crop_fraction": 0.95, "use_albumentations": True}
            kwargs |= {"letter_box_transform": False, "formalize_language": True}
            for modalities in kwargs["modality_configs"].values():
                modalities["video"]["modality_keys"] = list(CAMERAS)

        _edit(folder / "processor_config.json", processor)
        _edit(folder / "config.json", lambda config: config.update(select_layer=_layers(layout)))
    else:

        def metadata(robots: Config) -> None:
            for robot in robots.values():
                camera = {"resolution": [WIDTH, HEIGHT], "channels": 3, "fps": 30.0}
                robot["modalities"]["video"] = {name: dict(camera) for name in CAMERAS}

        _edit(folder / "experiment_cfg" / "metadata.json", metadata)


def _layers(layout: str) -> int:
    return int(about_backbone(layout)["select_layer"])


def _edit(path: Path, change: Callable[[Config], None]) -> None:
    values = json.loads(path.read_text())
    change(values)
    layout_files.write_json(path, values)
