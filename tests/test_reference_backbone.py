"""The backbone in torch against the released code's fixtures, transformers' and lerobot's classes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from torch import Tensor, nn

from saccade import BackboneInputs
from saccade.reference import Backbone, BackboneFeatures

DATA = Path(__file__).parent / "data" / "backbone"
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
    backbone = Backbone.load(DATA / f"{name}.safetensors", config=about, dtype=torch.float64)
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
