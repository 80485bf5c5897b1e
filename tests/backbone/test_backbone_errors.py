"""Inputs, configs and checkpoints that a backbone refuses, each with a message that says what is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import saccade
from tests.helpers.released_backbones import released_backbone

N15, N17 = "n15_two_views", "n17_two_views"


def refused(name: str, error: type[Exception], message: str, **changes: Any) -> None:
    released = released_backbone(name)
    backbone = released.load()
    with pytest.raises(error, match=message):
        backbone(released.inputs(**changes))
    # It stays usable.
    features = backbone(released.inputs()).backbone_features
    assert (np.abs(features - released.features) <= released.tolerance).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite(value: float) -> None:
    for name in (N15, N17):
        pixels = released_backbone(name).pixel_values.copy()
        pixels.reshape(-1)[-1] = value
        refused(name, saccade.InputError, "pixel_values: expected finite values", pixel_values=pixels)
    views = [view.copy() for view in released_backbone("n16_two_views").pixel_values]
    views[1][0, 0, 0, 0] = value
    refused("n16_two_views", saccade.InputError, r"pixel_values\[1\]: expected finite", pixel_values=views)


@pytest.mark.parametrize("token", [-1, 448, 2**40, -(2**63)])
def test_ids_out_of_range(token: int) -> None:
    ids = released_backbone(N15).arrays["_in.input_ids"].copy()
    ids[0, 3] = token
    message = rf"input_ids: expected ids of 0 to 447, got {token} at index \(0, 3\)"
    refused(N15, saccade.InputError, message, input_ids=ids)


def test_image_tokens_that_views_do_not_fill() -> None:
    released = released_backbone(N15)
    ids = released.arrays["_in.input_ids"].copy()
    ids[0, np.flatnonzero(ids[0] == released.image_token_id)[0]] = 1
    refused(N15, saccade.InputError, "prompt 0 has 31 image tokens .* 16, 16 tokens", input_ids=ids)
    pixels = released.pixel_values
    refused(N15, saccade.InputError, "prompt 0 has 32 image tokens", pixel_values=pixels[:1])
    refused(N15, saccade.InputError, "prompt 0 has 32 image tokens .* no more views", pixel_values=pixels[:0])
    three = np.concatenate([pixels, pixels[:1]])
    refused(N15, saccade.InputError, "3 views were given, but .* for 2", pixel_values=three)
    text = np.full((1, 9), 4)
    refused(N15, saccade.InputError, "2 views were given, but .* for 0", input_ids=text, attention_mask=None)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        (N15, (2, 3, 56, 70), r"expected \(views, 3, 56, 56\), got \(2, 3, 56, 70\)"),
        (N15, (2, 1, 56, 56), r"expected \(views, 3, 56, 56\)"),
        (N15, (2, 56 * 56), r"expected \(views, 3, 56, 56\)"),
        ("n16_two_views", (2, 3, 56, 60), "sides that are multiples of 28"),
        ("n16_two_views", (2, 3, 0, 56), "sides that are multiples of 28"),
        (N17, (40, 100), r"expected \(patches, 1536\)"),
        (N17, (40, 3, 16, 16), r"expected \(patches, 1536\)"),
        (N17, (36, 1536), "expected grids of the 36 patches"),
        (N17, (44, 1536), "expected grids of the 44 patches"),
    ],
)
def test_pixels_of_other_shapes(name: str, shape: tuple[int, ...], message: str) -> None:
    refused(name, saccade.ShapeError, message, pixel_values=np.zeros(shape, np.float32))


@pytest.mark.parametrize(
    "grid",
    [[[1, 3, 8], [1, 4, 4]], [[2, 4, 4], [1, 4, 2]], [[1, 0, 4], [1, 4, 4]], [[1, -4, -6], [1, 4, 4]],
     [[1, 2**62, 2**62], [1, 4, 4]]],
)  # fmt: skip
def test_grids_that_do_not_fit(grid: list[list[int]]) -> None:
    refused(N17, (saccade.InputError, saccade.ShapeError), "image_grid_thw: expected", image_grid_thw=grid)  # type: ignore[arg-type]


def test_grids_are_for_patches() -> None:
    refused(N15, saccade.InputError, "image_grid_thw: expected none", image_grid_thw=[[1, 4, 4], [1, 4, 4]])
    refused(N17, saccade.InputError, "image_grid_thw: expected", image_grid_thw=None)


def test_views_of_n17_are_whole() -> None:
    """Positions of N1.7 count the tokens of a view together."""
    released = released_backbone(N17)
    mask = released.arrays["_in.attention_mask"].copy()
    places = np.flatnonzero(released.arrays["_in.input_ids"][0] == released.image_token_id)
    mask[0, places[2]] = 0
    refused(N17, saccade.InputError, "tokens of a view one after the other and attended", attention_mask=mask)


def test_prompts_without_tokens() -> None:
    for shape in ((0, 5), (2, 0)):
        refused(
            N15,
            saccade.ShapeError,
            "input_ids: expected .* at least one prompt and token",
            input_ids=np.zeros(shape, np.int64),
            attention_mask=None,
        )


def test_what_is_not_of_a_backbone() -> None:
    backbone = released_backbone(N15).load()
    inputs = released_backbone(N15).inputs()
    with pytest.raises(saccade.InputError, match=r"inputs: expected saccade\.BackboneInputs, got dict"):
        backbone({})  # type: ignore[arg-type]
    with pytest.raises(
        saccade.InputError, match=r"previous: expected saccade\.BackboneFeatures, got ndarray"
    ):
        backbone(inputs, previous=np.zeros(3))  # type: ignore[arg-type]
    for record in ("hidden", ("attention",), 3):
        with pytest.raises(
            saccade.InputError, match="record: expected a tuple of names among hidden, vision"
        ):
            backbone(inputs, record=record)  # type: ignore[arg-type]
    other = released_backbone(N15).load()(inputs)
    with pytest.raises(saccade.InputError, match="previous: expected features that this backbone made"):
        backbone(inputs, previous=other)


def test_options_out_of_range() -> None:
    released = released_backbone(N15)
    with pytest.raises(saccade.InputError, match="precision: expected one of"):
        released.load("float16")
    with pytest.raises(saccade.InputError, match="num_threads: expected at least 1, got 0"):
        released.load(num_threads=0)
    with pytest.raises(FileNotFoundError, match="no such file"):
        saccade.Backbone.from_pretrained(released.path.with_name("nothing.safetensors"))


Change = Callable[[dict[str, torch.Tensor]], object]
BLOCK = "_groot_model.backbone.eagle_model.language_model.model.layers.1."


def rewritten(tmp_path: Path, change: Change) -> Path:
    """The weights of a released backbone with some change."""
    tensors = {
        name: tensor
        for name, tensor in load_file(released_backbone(N15).path).items()
        if name.startswith("_groot_model.")
    }
    change(tensors)
    path = tmp_path / "model.safetensors"
    save_file(tensors, path)
    return path


def test_every_tensor_that_does_not_fit_is_listed(tmp_path: Path) -> None:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        del tensors[BLOCK + "mlp.up_proj.weight"]
        tensors[BLOCK + "self_attn.q_proj.weight"] = torch.zeros(3, 5)
        tensors[BLOCK + "self_attn.q_proj.bias"] = torch.zeros(3)
        tensors[BLOCK + "mlp.gate_proj.weight"] = torch.zeros(160, 64, dtype=torch.int32)

    path = rewritten(tmp_path, change)
    with pytest.raises(saccade.CheckpointError) as caught:
        saccade.Backbone.from_pretrained(path, config=released_backbone(N15).about)
    message = str(caught.value)
    assert "4 tensors do not fit the backbone of GR00T N1.5" in message
    for problem in (
        "mlp.up_proj.weight is missing, expected (160, 64)",
        "q_proj.weight has shape (3, 5), expected (64, 64)",
        "q_proj.bias is unknown",
        "gate_proj.weight is I32, expected F32, BF16 or F16",
    ):
        assert problem in message


def test_tensors_that_nothing_reads(tmp_path: Path) -> None:
    """A table next to its twin, and layers beyond the last one."""

    def change(tensors: dict[str, torch.Tensor]) -> None:
        start = "_groot_model.backbone.eagle_model.language_model."
        tensors[start + "model.embed_tokens.weight"] = tensors[start + "lm_head.weight"]
        tensors[start + "lm_head.weight"] = torch.full((448, 64), 9.0)
        for name in [name for name in tensors if name.startswith(BLOCK)]:
            tensors[name.replace("layers.1.", "layers.27.")] = tensors[name] + 1
        tensors["_groot_model.action_head.anything"] = torch.zeros(1)

    released = released_backbone(N15)
    backbone = saccade.Backbone.from_pretrained(rewritten(tmp_path, change), config=released.about)
    expected = released.load()(released.inputs()).backbone_features
    assert np.array_equal(backbone(released.inputs()).backbone_features, expected)


def test_weights_that_are_not_finite(tmp_path: Path) -> None:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        tensors["_groot_model.backbone.eagle_model.language_model.lm_head.weight"][5, 6] = torch.nan

    path = rewritten(tmp_path, change)
    with pytest.raises(
        saccade.CheckpointError, match=r"lm_head.weight: expected finite .* NaN at index \(5, 6\)"
    ):
        saccade.Backbone.from_pretrained(path, config=released_backbone(N15).about)


def test_without_a_config_the_sizes_are_the_published_ones(tmp_path: Path) -> None:
    with pytest.raises(
        saccade.CheckpointError, match=r"tensors do not fit .*(?s:.)*expected \(151680, 2048\)"
    ):
        saccade.Backbone.from_pretrained(rewritten(tmp_path, dict))


def test_sizes_in_the_config_of_a_checkpoint(tmp_path: Path) -> None:
    """NVIDIA's layout: the sizes stand under `backbone_cfg.eagle_config`."""
    released = released_backbone(N15)
    about = released.about
    rewritten(tmp_path, dict)
    expected = released.load()(released.inputs()).backbone_features
    sizes = {key: about[key] for key in ("text_config", "vision_config")}
    of_backbone = {
        "select_layer": 3,
        "project_to_dim": None,
        "eagle_config": {**sizes, "eagle": about["eagle"]},
    }
    nested = {"model_type": "gr00t_n1_5", "backbone_cfg": of_backbone}
    plain = {"backbone_cfg": {"select_layer": 3, "eagle_config": {**sizes, **about["eagle"]}}}
    whole = {"backbone_cfg": {"eagle_config": about}}
    for config in (nested, plain, whole):
        (tmp_path / "config.json").write_text(json.dumps(config))
        features = saccade.Backbone.from_pretrained(tmp_path)(released.inputs()).backbone_features
        assert np.array_equal(features, expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "n1.7 backbone"}, "kind is .* but the tensors are those of GR00T N1.5"),
        ({"kind": "n2 backbone"}, "kind is .* expected one of"),
        ({"select_layer": 0}, "select_layer is 0, expected a whole number from 1 to 1024"),
        ({"select_layer": "x"}, "select_layer is .* expected a whole number"),
        ({"project_to_dim": -1}, "project_to_dim is -1"),
        ({"eagle": {"select_layer": -2}}, "eagle.select_layer is -2, expected -1"),
        ({"eagle": {"use_pixel_shuffle": 3}}, "eagle.use_pixel_shuffle is 3, expected true or false"),
        ({"eagle": 3}, "eagle: expected an object"),
        ({"text_config": {"hidden_act": "gelu"}}, "hidden_act is .gelu., expected .silu."),
        ({"text_config": {"num_key_value_heads": 3}}, "expected a num_attention_heads that 3 heads"),
        ({"text_config": {"rope_scaling": {"rope_type": "yarn"}}}, "expected interleaved mrope"),
        ({"text_config": {"rope_theta": -1}}, "rope_theta is -1, expected a positive number"),
        ({"vision_config": {"image_size": 57}}, "expected an image_size of whole tokens of 14 pixels"),
        ({"vision_config": {"num_attention_heads": 5}}, "expected a hidden_size that 5 heads divide"),
        ({"vision_config": {"hidden_size": 2**40}}, "hidden_size is 1099511627776, expected"),
    ],
)
def test_configs_that_do_not_fit(changes: dict[str, Any], message: str) -> None:
    released = released_backbone(N15)
    about = json.loads(json.dumps(released.about))
    for key, value in changes.items():
        if isinstance(value, dict):
            about[key].update(value)
        else:
            about[key] = value
    with pytest.raises(saccade.CheckpointError, match=message):
        saccade.Backbone.from_pretrained(released.path, config=about)


def test_checkpoints_without_a_backbone(tmp_path: Path) -> None:
    path = tmp_path / "head.safetensors"
    save_file({"action_head.vlln.weight": torch.zeros(3)}, path)
    with pytest.raises(saccade.CheckpointError, match="there is no backbone among the 1 tensors"):
        saccade.Backbone.from_pretrained(path)
    save_file({"backbone.language_model.transformer.h.0.ln_1.weight": torch.zeros(3)}, path)
    with pytest.raises(saccade.CheckpointError, match="the backbone is of a model that is not known"):
        saccade.Backbone.from_pretrained(path)
    both = {
        f"{prefix}eagle_model.mlp1.0.bias": torch.zeros(3)
        for prefix in ("backbone.", "_groot_model.backbone.")
    } | {
        f"{prefix}eagle_model.language_model.model.norm.weight": torch.zeros(3)
        for prefix in ("backbone.", "_groot_model.backbone.")
    }
    save_file(both, path)
    with pytest.raises(saccade.CheckpointError, match="two backbones in one checkpoint"):
        saccade.Backbone.from_pretrained(path)
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(saccade.CheckpointError):
        saccade.Backbone.from_pretrained(path)
