"""Backbones against the released code, on every instruction set and in every precision."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import saccade
from tests.helpers.int4_cases import BACKBONE_BLOCKS, with_int4_weights
from tests.helpers.released_backbones import N17, NAMES, relative_error, released_backbone


@pytest.mark.parametrize("name", NAMES)
def test_features_are_the_released_ones(name: str, isa: str) -> None:
    released = released_backbone(name)
    backbone = released.load()
    assert backbone.isa == isa
    features = backbone(released.inputs()).backbone_features
    assert features.shape == released.features.shape
    assert features.dtype == np.float32
    assert (np.abs(features - released.features) <= released.tolerance).all()


@pytest.mark.parametrize("name", NAMES)
def test_masks_and_places_of_views(name: str) -> None:
    released = released_backbone(name)
    features = released.load()(released.inputs())
    ids, mask = released.arrays["_in.input_ids"], released.arrays["_in.attention_mask"]
    is_image = ids == released.image_token_id
    assert np.array_equal(features.attention_mask, mask != 0)
    assert np.array_equal(features.image_mask, is_image)
    assert features.image_mask.dtype == features.attention_mask.dtype == np.bool_
    if "_out.image_mask" in released.arrays:
        assert np.array_equal(features.image_mask, released.arrays["_out.image_mask"] != 0)
    places = np.concatenate([features.views[view] for view in features.views], axis=1)
    assert list(features.views) == [f"view_{index + 1}" for index in range(len(features.views))]
    for row in range(len(ids)):
        assert np.array_equal(places[row][places[row] >= 0], np.flatnonzero(is_image[row]))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("precision", "bound"), [("bfloat16", 0.015), ("int8", 0.08)])
def test_lower_precisions_are_close(name: str, precision: str, bound: float, isa: str) -> None:
    """The released code's own bfloat16 runs are 0.9 % from float64 (n15_bf16)."""
    released = released_backbone(name)
    features = released.load(precision)(released.inputs()).backbone_features
    assert relative_error(np.asarray(features), released.features) < bound


@pytest.mark.parametrize("name", NAMES)
def test_int4_is_as_close_as_int8_to_weights_of_four_bits(name: str, isa: str) -> None:
    """Against the exact backbone with weights that torch rounded; from the released one it is 0.3 to 0.4."""
    released = released_backbone(name)
    rounded = with_int4_weights(released.tensors(), BACKBONE_BLOCKS)
    exact = saccade.Backbone.from_tensors(rounded, config=released.about)(released.inputs())
    features = released.load("int4")(released.inputs()).backbone_features
    assert relative_error(np.asarray(features), np.asarray(exact.backbone_features)) < 0.08


def test_bfloat16_is_as_close_as_the_released_run() -> None:
    released = released_backbone("n15_bf16")
    features = np.asarray(released.load("bfloat16")(released.inputs()).backbone_features)
    runs = ("autocast_bf16", "bf16_weights_autocast")
    own = [
        relative_error(released.arrays[f"_out.backbone_features_{run}"], released.features) for run in runs
    ]
    assert relative_error(features, released.features) < 1.1 * min(own)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
def test_threads_do_not_change_bits(name: str, precision: str) -> None:
    released = released_backbone(name)
    one, three = (
        released.load(precision, threads)(released.inputs()).backbone_features for threads in (1, 3)
    )
    assert np.array_equal(one, three)


@pytest.mark.parametrize("name", ["n15_batch_padded", "n15_pixel_shuffle", "n17_batch_padded"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
def test_rows_of_a_batch_have_their_bits_alone(name: str, precision: str) -> None:
    released = released_backbone(name)
    backbone = released.load(precision)
    inputs = released.inputs()
    together = backbone(inputs).backbone_features
    batch = inputs.batch
    pixels = np.asarray(inputs.pixel_values)
    grids = inputs.image_grid_thw
    patches = [1] * len(pixels) if grids is None else grids.prod(axis=1)
    ends = np.cumsum([0, *patches])
    views = len(patches) // batch
    for row in range(batch):
        first, end = ends[row * views], ends[(row + 1) * views]
        alone = saccade.BackboneInputs(
            pixels[first:end],
            inputs.input_ids[row : row + 1],
            inputs.attention_mask[row : row + 1],
            None if grids is None else grids[row * views : (row + 1) * views],
        )
        assert np.array_equal(backbone(alone).backbone_features[0], together[row])


@pytest.mark.parametrize("name", ["n15_two_views", "n15_pixel_shuffle", "n15_batch_padded"])
def test_what_is_recorded_of_n15(name: str) -> None:
    released = released_backbone(name)
    backbone = released.load()
    features = backbone(released.inputs(), record=("hidden", "vision", "image_tokens"))
    plain = backbone(released.inputs())
    assert plain.record is None
    assert np.array_equal(features.backbone_features, plain.backbone_features)
    record = features.record
    assert record is not None
    assert sorted(record.hidden) == list(range(backbone.config.num_layers))
    for layer, rows in record.hidden.items():
        expected = released.arrays[f"_mid.llm.layer.{layer}"]
        assert np.abs(rows - expected).max() < 2e-5 * max(1, np.abs(expected).max())
    for kept, name_ in ((record.vision, "vision.post_layernorm"), (record.image_tokens, "mlp1.output")):
        if f"_mid.{name_}" in released.arrays:
            expected = released.arrays[f"_mid.{name_}"]
            assert np.abs(np.stack(list(kept.values())) - expected).max() < 2e-5
    assert list(record.vision) == [(row, f"view_{view}") for row in range(features.batch) for view in (1, 2)]
    assert record.nbytes > 0
    assert "hidden=" in repr(record)


@pytest.mark.parametrize("name", N17)
def test_what_is_recorded_of_n17(name: str) -> None:
    released = released_backbone(name)
    record = released.load()(released.inputs(), record=("hidden", "vision", "image_tokens")).record
    assert record is not None
    for layer, rows in record.hidden.items():
        expected = released.arrays[f"_mid.llm.layer.{layer}"]
        assert np.abs(rows - expected).max() < 5e-5
    last = released.about["vision_config"]["depth"] - 1
    for kept, step in ((record.vision, f"layer.{last}"), (record.image_tokens, "merger")):
        rows = np.concatenate(list(kept.values()))
        assert np.abs(rows - released.arrays[f"_mid.vision.{step}"]).max() < 5e-5


@pytest.mark.parametrize("name", ["n15_one_view", "n15_bf16", "n16_two_views", "n17_batch_padded"])
def test_tensors_in_memory_make_the_same_backbone(name: str) -> None:
    released = released_backbone(name)
    stored = saccade._saccade.read_stored(str(released.path))
    tensors = {}
    for key, (dtype, shape, content) in stored.items():
        if key.startswith("_") and not key.startswith("_groot_model."):
            continue
        kind = torch.bfloat16 if dtype == "BF16" else torch.float32
        tensors[key] = torch.frombuffer(bytearray(content), dtype=kind).reshape(shape)
    for precision in ("float32", "int8"):
        backbone = saccade.Backbone.from_tensors(tensors, config=released.about, precision=precision)
        loaded = released.load(precision)
        assert backbone.config == loaded.config
        assert backbone.nbytes == loaded.nbytes
        first, second = (one(released.inputs()).backbone_features for one in (backbone, loaded))
        assert np.array_equal(first, second)
    assert backbone.source is None
    with pytest.raises(saccade.DtypeError, match="cannot be pickled"):
        pickle.dumps(backbone)


def test_torch_in_torch_out() -> None:
    released = released_backbone("n15_one_view")
    backbone = released.load()
    inputs = released.inputs(
        pixel_values=torch.from_numpy(released.pixel_values.copy()),
        input_ids=torch.from_numpy(released.arrays["_in.input_ids"].copy()),
    )
    features = backbone(inputs)
    expected = backbone(released.inputs())
    for name in ("backbone_features", "attention_mask", "image_mask"):
        given = getattr(features, name)
        assert isinstance(given, torch.Tensor)
        assert np.array_equal(given.numpy(), getattr(expected, name))


def test_a_backbone_can_be_pickled_and_features_not() -> None:
    released = released_backbone("n15_one_view")
    backbone = released.load("bfloat16", num_threads=2)
    again = pickle.loads(pickle.dumps(backbone))
    assert (again.precision, again.num_threads, again.config) == ("bfloat16", 2, backbone.config)
    features = backbone(released.inputs())
    assert np.array_equal(again(released.inputs()).backbone_features, features.backbone_features)
    with pytest.raises(saccade.InputError, match="previous: expected features that this backbone made"):
        again(released.inputs(), previous=features)
    with pytest.raises(saccade.DtypeError, match="cannot be pickled"):
        pickle.dumps(features)
    assert copy.deepcopy(features) is features
    assert copy.copy(features) is features


def test_names_of_views() -> None:
    released = released_backbone("n15_two_views")
    backbone = released.load()
    features = backbone(released.inputs(view_names=("front", "wrist")))
    assert list(features.views) == ["front", "wrist"]
    assert features.views["front"].shape == (1, 16)
    assert "views=[front, wrist]" in repr(features)
    with pytest.raises(saccade.InputError, match="view_names: expected 2 names"):
        backbone(released.inputs(view_names=("front",)))


def test_what_a_backbone_says_of_itself() -> None:
    released = released_backbone("n15_pixel_shuffle")
    backbone = released.load("int8", num_threads=3)
    config = backbone.config
    assert (config.version, config.num_layers, config.feature_dim) == ("n1.5", 2, 40)
    assert (config.merge, config.connector_layers, config.image_token_id) == (2, 2, 432)
    assert (backbone.precision, backbone.num_threads) == ("int8", 3)
    assert backbone.source == str(released.path)
    assert backbone.nbytes < released.load("bfloat16").nbytes < released.load().nbytes
    for shown in ("n1.5", "precision=int8", "num_threads=3"):
        assert shown in repr(backbone)


@pytest.mark.parametrize("kind", ["down", "residual", "norm"])
def test_int8_and_int4_bear_outliers(kind: str, isa: str) -> None:
    """Channels far larger than the others, as trained models have."""
    released = released_backbone("n15_one_view")
    tensors = released.tensors()
    for name, tensor in tensors.items():
        if kind == "residual" and name.endswith("patch_embedding.bias"):
            tensor[5], tensor[40] = 1000.0, -1000.0
        if kind == "norm" and name.endswith(("layernorm.weight", "layer_norm1.weight")):
            tensor[[7, 50]] *= 100.0
        if kind == "down" and name.endswith(("up_proj.weight", "gate_proj.weight")):
            tensor[[7, 100]] *= 8.0
        if kind == "down" and name.endswith("down_proj.weight"):
            tensor[:, [7, 100]] /= 32.0

    def features(tensors: Mapping[str, torch.Tensor], precision: str) -> NDArray[np.float32]:
        backbone = saccade.Backbone.from_tensors(tensors, config=released.about, precision=precision)
        return np.asarray(backbone(released.inputs()).backbone_features)

    # Without outliers it is 0.03 to 0.06.
    assert relative_error(features(tensors, "int8"), features(tensors, "float32")) < 0.08
    rounded = with_int4_weights(tensors, BACKBONE_BLOCKS)
    assert relative_error(features(tensors, "int4"), features(rounded, "float32")) < 0.08
