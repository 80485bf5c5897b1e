"""The backbone in torch against the released code's fixtures, transformers' and lerobot's classes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from saccade import BackboneInputs, CheckpointError, InputError, ShapeError
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.published import RELEASED
from saccade_lab.random_checkpoint import backbone_tensors
from saccade_lab.reference import Backbone, BackboneFeatures
from saccade_lab.reference.backbone.loading import is_unread
from tests.helpers import upstream_backbones
from tests.helpers.reference_backbone_cases import random_inputs, random_sizes, randomised

DATA = Path(__file__).parents[2] / "data" / "backbone"
FIXTURES = sorted(path.stem for path in DATA.glob("n1?_*.safetensors"))
TOLERANCE = 1e-10

torch.set_num_threads(1)


def fixture(name: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a file says about itself, and the tensors that are not weights."""
    with safe_open(DATA / f"{name}.safetensors", framework="pt") as file:
        held = {key: file.get_tensor(key) for key in file.keys() if key.startswith("_")}  # noqa: SIM118
        return json.loads(file.metadata()["about"]), held


def inputs_of(held: dict[str, Tensor]) -> BackboneInputs:
    pixels: Any = held.get("_in.pixel_values")
    if pixels is None:  # N1.6: one array a view
        pixels = [held[key] for key in sorted(held) if key.startswith("_in.pixel_values.")]
    return BackboneInputs(
        pixels, held["_in.input_ids"], held["_in.attention_mask"], held.get("_in.image_grid_thw")
    )


def recorded(backbone: Backbone, inputs: BackboneInputs) -> tuple[BackboneFeatures, dict[str, Tensor]]:
    """The features, and the outputs of modules by the names of the fixtures' `_mid` tensors."""
    outputs: dict[str, list[Tensor]] = {}

    def keep(name: str, module: nn.Module, *, before: bool = False) -> None:
        def hook(_: nn.Module, given: Any, result: Any) -> None:
            value = given[0] if before else result
            outputs.setdefault(name, []).append(value[0] if isinstance(value, tuple) else value)

        module.register_forward_hook(hook)

    model: Any = backbone.eagle_model if backbone.sizes.version == "n1.5" else backbone.model
    if backbone.sizes.version == "n1.7":
        model = model.model
        tower, decoder = model.visual, model.language_model
        keep("vision.patch_embed", tower.patch_embed)
        keep("vision.embeddings", tower.blocks[0], before=True)
        keep("vision.merger", tower.merger)
        layers = tower.blocks
        for index, merger in enumerate(tower.deepstack_merger_list):
            keep(f"vision.deepstack.{index}", merger)
    else:
        tower, decoder = model.vision_model.vision_model, model.language_model.model
        keep("vision.embeddings", tower.embeddings)
        keep("vision.post_layernorm", tower.post_layernorm)
        keep("vision.output", tower.post_layernorm)
        keep("mlp1.input", model.mlp1, before=True)
        keep("mlp1.output", model.mlp1)
        keep("llm.norm", decoder.norm)
        layers = tower.encoder.layers
    for index, layer in enumerate(layers):
        keep(f"vision.layer.{index}", layer)
    for index, layer in enumerate(decoder.layers):
        keep(f"llm.layer.{index}", layer)
    keep("llm.inputs_embeds", decoder.layers[0], before=True)
    features = backbone(inputs)
    joined = {
        name: values[0] if len(values) == 1 else torch.cat(values, dim=1) for name, values in outputs.items()
    }
    return features, joined


@pytest.mark.parametrize("name", FIXTURES)
def test_every_intermediate_of_the_released_code_in_float64(name: str) -> None:
    about, held = fixture(name)
    backbone = Backbone.from_pretrained(DATA / f"{name}.safetensors", config=about, dtype=torch.float64)
    with torch.no_grad():
        features, found = recorded(backbone, inputs_of(held))
    compared = 0
    for key, expected in held.items():
        if not key.startswith("_mid.") or key == "_mid.position_ids":
            continue
        got = found[key.removeprefix("_mid.")].reshape(expected.shape)
        assert (got - expected).abs().max() < TOLERANCE, key
        compared += 1
    assert compared >= 4
    assert (features.backbone_features - held["_out.backbone_features"]).abs().max() < TOLERANCE
    assert torch.equal(features.attention_mask, held["_in.attention_mask"].bool())
    if "_out.image_mask" in held:
        assert torch.equal(features.image_mask, held["_out.image_mask"].bool())


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_upstream_classes_of_random_sizes(version: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = random_sizes(version, rng)
    backbone = randomised(Backbone(sizes), seed).double()
    theirs = (upstream_backbones.Eagle if version == "n1.5" else upstream_backbones.Qwen3Vl)(sizes)
    loaded = theirs.load_state_dict(backbone.state_dict(), strict=False)
    unread = ("lm_head.weight", "model.language_model.norm.weight")
    assert not loaded.unexpected_keys
    assert all(".vision_model.head." in key or key.endswith(unread) for key in loaded.missing_keys)
    theirs.double()
    inputs = random_inputs(sizes, rng, batch=2, views=1 + seed % 2)
    with torch.no_grad():
        got = backbone(inputs).backbone_features
        expected = theirs(inputs)
    # They compute RMSNorm and rotary positions in float32.
    assert (got - expected).abs().max() < 3e-6 * expected.abs().max()


@pytest.mark.parametrize("version", ["n1.5", "n1.6", "n1.7"])
def test_gradients_of_a_padded_batch_are_those_of_finite_differences(version: str) -> None:
    rng = np.random.default_rng(3)
    sizes = replace(random_sizes(version, rng), merge=1 if version == "n1.5" else 2)
    backbone = randomised(Backbone(sizes), 0).double()
    inputs = random_inputs(sizes, rng, batch=2, views=1)
    if version == "n1.6":
        inputs.pixel_values = tuple(np.split(np.asarray(inputs.pixel_values), len(inputs.pixel_values)))
    assert not inputs.attention_mask.all()
    target = torch.randn(*inputs.input_ids.shape, sizes.features_width, dtype=torch.float64)
    parameters = list(backbone.parameters())
    direction = [torch.randn_like(parameter) for parameter in parameters]

    def loss(step: float) -> Tensor:
        for parameter, change in zip(parameters, direction, strict=True):
            parameter.data += step * change
        try:
            features: Tensor = backbone(inputs).backbone_features
            return (features * target).sum()
        finally:
            for parameter, change in zip(parameters, direction, strict=True):
                parameter.data -= step * change

    gradients = torch.autograd.grad(loss(0.0), parameters)
    assert all(gradient.isfinite().all() and gradient.any() for gradient in gradients)
    slope = sum((g * d).sum() for g, d in zip(gradients, direction, strict=True))
    with torch.no_grad():
        measured = (loss(1e-6) - loss(-1e-6)) / 2e-6
    torch.testing.assert_close(slope, measured, rtol=1e-6, atol=1e-6)


def test_training_lowers_a_loss() -> None:
    about, held = fixture("n15_one_view")
    backbone = Backbone.from_pretrained(DATA / "n15_one_view.safetensors", config=about)
    inputs = inputs_of(held)
    target = torch.zeros_like(backbone(inputs).backbone_features)
    optimiser = torch.optim.AdamW(backbone.parameters(), lr=1e-3)
    losses = []
    for _ in range(4):
        loss = (backbone(inputs).backbone_features - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses == sorted(losses, reverse=True)


@pytest.mark.parametrize("name", FIXTURES)
def test_float32_is_as_exact_as_the_released_code(name: str) -> None:
    about, held = fixture(name)
    backbone = Backbone.from_pretrained(DATA / f"{name}.safetensors", config=about)
    with torch.no_grad():
        features = backbone(inputs_of(held)).backbone_features
    worst = (features - held["_out.backbone_features"]).abs().max()
    assert worst <= 4 * about["f32_max_abs_vs_f64"]


@pytest.mark.parametrize("version", RELEASED)
def test_names_and_shapes_are_listed_without_torch(version: str) -> None:
    sizes = BackboneSizes.from_config({"kind": f"{version} backbone"})
    with torch.device("meta"):
        held = {name: tuple(tensor.shape) for name, tensor in Backbone(sizes).state_dict().items()}
    listed = dict(backbone_tensors.tensor_shapes(sizes))
    assert listed == held
    unread = dict(backbone_tensors.unread_tensor_shapes(sizes))
    assert not unread.keys() & listed.keys()
    assert all(is_unread(name, sizes) for name in unread)
    assert not any(is_unread(name, sizes) for name in listed)


def test_the_size_of_the_published_backbone() -> None:
    sizes = BackboneSizes.from_config({"model_type": "gr00t_n1_5"})
    counts = {
        name: math.prod(shape) for name, shape in backbone_tensors.tensor_shapes(sizes)
    }  # the published numbers of parameters
    assert sum(count for name, count in counts.items() if ".vision_model." in name) == 412_442_352
    assert sum(count for name, count in counts.items() if ".mlp1." in name) == 2_361_344
    decoder = [count for name, count in counts.items() if ".layers." in name and ".language_model." in name]
    assert sum(decoder) + 2048 == 604_034_048
    unread = (math.prod(shape) for _, shape in backbone_tensors.unread_tensor_shapes(sizes))
    assert sum(unread) == 15_238_352


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"model_type": "gr00t_n9"}, "expected model_type to be one of gr00t_n1_5, Gr00tN1d6, Gr00tN1d7"),
        ({"kind": "n1.5 backbone", "vision_config": {"num_attention_heads": 5}}, "heads divide"),
        ({"kind": "n1.6 backbone", "vision_config": {"num_patches": 15}}, "square table"),
        ({"kind": "n1.7 backbone", "text_config": {"num_key_value_heads": 3}}, "key heads"),
    ],
)
def test_configs_that_do_not_fit(config: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        BackboneSizes.from_config(config)


def test_tensors_that_do_not_fit_are_listed(tmp_path: Path) -> None:
    about, _ = fixture("n15_one_view")
    with safe_open(DATA / "n15_one_view.safetensors", framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    layer = "backbone.eagle_model.language_model.model.layers"
    del tensors[f"{layer}.1.mlp.up_proj.weight"]
    tensors[f"{layer}.0.mlp.up_proj.weight"] = torch.zeros(3, 3)
    tensors["backbone.eagle_model.vision_model.new.weight"] = torch.zeros(3)
    tensors[f"{layer}.9.mlp.up_proj.weight"] = torch.zeros(3)  # a layer that is not computed
    save_file(tensors, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"3 tensors do not fit.*shape \(3, 3\).*missing.*unknown"):
        Backbone.from_pretrained(tmp_path / "model.safetensors", config=about)
    with pytest.raises(CheckpointError, match="no config"):
        Backbone.from_pretrained(tmp_path / "model.safetensors")
    with pytest.raises(FileNotFoundError):
        Backbone.from_pretrained(tmp_path / "none")


def test_inputs_that_do_not_fit() -> None:
    about, held = fixture("n15_one_view")
    backbone = Backbone.from_pretrained(DATA / "n15_one_view.safetensors", config=about)
    pixels, ids = held["_in.pixel_values"], held["_in.input_ids"]
    with pytest.raises(InputError, match="expected 16 image tokens, as many as the views give, got 15"):
        backbone(BackboneInputs(pixels, ids[:, : int((ids[0] == 432).nonzero()[-1])]))
    with pytest.raises(ShapeError, match="expected 16 patches, got 12"):
        backbone(BackboneInputs(pixels[:, :, :42], ids))
    with pytest.raises(InputError, match="expected 0 to 447"):
        backbone(BackboneInputs(pixels, ids + 400))
    about, held = fixture("n17_one_view")
    backbone = Backbone.from_pretrained(DATA / "n17_one_view.safetensors", config=about)
    pixels, ids, grid = (held[f"_in.{name}"] for name in ("pixel_values", "input_ids", "image_grid_thw"))
    with pytest.raises(InputError, match="expected the grid of each view, got None"):
        backbone(BackboneInputs(pixels, ids))
    with pytest.raises(InputError, match="24 patches"):
        backbone(BackboneInputs(pixels, ids, image_grid_thw=grid * 2))
    with pytest.raises(ShapeError, match=r"expected \(patches, 1536\)"):
        backbone(BackboneInputs(pixels[:, :9], ids, image_grid_thw=grid))
