"""saccade.Backbone against the torch backbone in float64: random sizes, padded batches, instruction sets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.published import RELEASED
from saccade_lab.reference import Backbone
from tests.helpers.int4_cases import BACKBONE_BLOCKS, with_int4_weights
from tests.helpers.reference_backbone_cases import config_of, random_inputs, random_sizes, randomised

#: Root mean square of the error relative to that of the features; of few channels some are badly conditioned.
#: That of int4 is against weights that are rounded alike.
TOLERANCE = {"float32": 5e-6, "bfloat16": 0.04, "int8": 0.12, "int4": 0.12}


def test_the_configs_are_those_of_the_sizes() -> None:
    for version in RELEASED:
        sizes = random_sizes(version, np.random.default_rng(0))
        assert BackboneSizes.from_config(config_of(sizes)) == sizes


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("version", RELEASED)
def test_random_sizes(version: str, seed: int, isa: str) -> None:
    rng = np.random.default_rng(seed)
    sizes = random_sizes(version, rng)
    if version == "n1.6":
        sizes = replace(sizes, merge=2, connector_layers=2)
    if version == "n1.5" and seed % 2:
        sizes = replace(sizes, project_to_dim=13)
    reference = randomised(Backbone(sizes), seed)
    inputs = random_inputs(sizes, rng, batch=2, views=1 + seed % 2)
    if version == "n1.6":
        inputs.pixel_values = tuple(np.split(np.asarray(inputs.pixel_values), len(inputs.pixel_values)))
    tensors = {name: tensor.clone() for name, tensor in reference.state_dict().items()}
    expected = {}
    for precision in TOLERANCE:
        if precision == "int4":
            reference.load_state_dict(with_int4_weights(tensors, BACKBONE_BLOCKS))
        with torch.no_grad():
            expected[precision] = reference.double()(inputs).backbone_features.numpy()
    for precision, tolerance in TOLERANCE.items():
        backbone = saccade.Backbone.from_tensors(tensors, config=config_of(sizes), precision=precision)
        features = backbone(inputs)
        exact = expected[precision]
        assert features.backbone_features.shape == exact.shape
        error = np.square(features.backbone_features - exact).mean() / np.square(exact).mean()
        assert error < tolerance**2, (precision, isa)
        np.testing.assert_array_equal(features.image_mask, inputs.input_ids == sizes.image_token)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("version", RELEASED)
def test_holes_in_the_mask(version: str, seed: int, isa: str) -> None:
    """Rows that are not attended to may stand between others: those after them pass them over."""
    rng = np.random.default_rng(seed)
    sizes = random_sizes(version, rng)
    reference = randomised(Backbone(sizes), seed)
    inputs = random_inputs(sizes, rng, batch=2, views=1)
    words = rng.integers(30, size=(2, 12))
    ids = np.hstack([inputs.input_ids, words])
    mask = np.hstack([np.asarray(inputs.attention_mask, bool), rng.random(words.shape) < 0.5])
    mask[:, -3:] = [True, False, True]
    pixels: Any = np.asarray(inputs.pixel_values)
    if version == "n1.6":
        pixels = tuple(np.split(pixels, len(pixels)))
    given = saccade.BackboneInputs(pixels, ids, mask, inputs.image_grid_thw)
    with torch.no_grad():
        expected = reference.double()(given).backbone_features.numpy()
    tensors = dict(reference.float().state_dict())
    backbone = saccade.Backbone.from_tensors(tensors, config=config_of(sizes))
    difference = np.square(backbone(given).backbone_features - expected)
    assert difference.mean() / np.square(expected).mean() < TOLERANCE["float32"] ** 2, isa
