"""Random whole checkpoints: that everything loads them, and that they are what they say."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import Tensor, nn

import saccade
from saccade import BackboneInputs, InputError
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.published import RELEASED
from saccade_lab.random_checkpoint import small_backbone, small_head, write
from saccade_lab.random_checkpoint import tensors as random_tensors
from saccade_lab.random_checkpoint.__main__ import main
from saccade_lab.random_checkpoint.tensors import Outliers, bfloat16, blocks
from saccade_lab.random_checkpoint.tokenizer import tokenizer
from saccade_lab.reference import Backbone

Tokenizer = pytest.importorskip("tokenizers").Tokenizer  # it has no types
DATA = Path(__file__).parents[1] / "data" / "backbone"

torch.set_num_threads(1)


def small(folder: Path, version: str = "n1.5", **options: object) -> Path:
    return write(folder, version, backbone=small_backbone(version), head=small_head(version), **options)  # type: ignore[arg-type]


def prompt(sizes: BackboneSizes, rng: np.random.Generator) -> BackboneInputs:
    """One view of noise and a few words."""
    side, grid = sizes.vision.patch_size, round(sizes.vision.num_positions**0.5)
    num_tokens = sizes.vision.num_positions // sizes.merge**2
    ids = [[1, 2, *[sizes.image_token] * num_tokens, 3, 4]]
    if sizes.version == "n1.7":
        patches = rng.standard_normal((grid * grid, 3 * 2 * side * side))
        return BackboneInputs(patches, ids, image_grid_thw=np.array([[1, grid, grid]]))
    pixels = rng.standard_normal((1, 3, grid * side, grid * side))
    return BackboneInputs(pixels if sizes.version == "n1.5" else [pixels], ids)


@pytest.mark.parametrize("version", RELEASED)
def test_every_part_loads(version: str, tmp_path: Path) -> None:
    folder = small(tmp_path / "checkpoint", version)
    head = saccade.ActionHead.from_pretrained(folder)
    assert head.config.version == version
    normalizer = saccade.Normalizer.from_pretrained(folder)
    assert normalizer.embodiment_id in head.embodiment_ids
    backbone = Backbone.from_pretrained(folder)
    assert backbone.sizes == BackboneSizes.from_config(small_backbone(version))
    assert backbone.sizes.features_width == head.config.context_dim
    ids = json.loads((folder / "tokenizer.json").read_text())["model"]["vocab"]
    assert max(ids.values()) < backbone.sizes.text.vocabulary
    with torch.no_grad():
        features = backbone(prompt(backbone.sizes, np.random.default_rng(0))).backbone_features
    assert 0.1 < features.std() < 10


def test_shards_have_an_index_and_the_content_does_not_depend_on_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, many = small(tmp_path / "one"), tmp_path / "many"
    monkeypatch.setattr(random_tensors, "BLOCK", 1000)
    small(many, shard_bytes=500_000)
    assert len(list(many.glob("*.safetensors"))) > 3
    index = json.loads((many / "model.safetensors.index.json").read_text())
    with safe_open(one / "model-00001-of-00001.safetensors", framework="pt") as whole:
        assert sorted(whole.keys()) == sorted(index["weight_map"])
        for name, file in index["weight_map"].items():
            with safe_open(many / file, framework="pt") as shard:
                assert torch.equal(shard.get_tensor(name), whole.get_tensor(name)), name
    total = sum(math.prod(t.shape) * t.dtype.itemsize for t in tensors(one).values())
    assert index["metadata"]["total_size"] == total


def tensors(folder: Path) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for path in folder.glob("*.safetensors"):
        with safe_open(path, framework="pt") as file:
            found |= {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    return found


def test_dtypes_are_those_of_the_published_files(tmp_path: Path) -> None:
    for dtype, expected in (("F32", torch.float32), ("BF16", torch.bfloat16)):
        for name, tensor in tensors(small(tmp_path / dtype, head_dtype=dtype)).items():
            assert tensor.dtype == (expected if name.startswith("action_head.") else torch.bfloat16)


def test_rounding_to_bfloat16_is_torchs() -> None:
    values = np.random.default_rng(0).standard_normal(100_000, np.float32)
    values[:4] = 1.00390625, 1.01171875, 0.0, -0.0  # halfway between two numbers, and zeros
    expected = torch.from_numpy(values).bfloat16().view(torch.int16).numpy().view(np.uint16)
    np.testing.assert_array_equal(bfloat16(values), expected)


def test_blocks_are_small_and_their_mean_and_deviation_right() -> None:
    tensor = random_tensors.Tensor("x.mlp.up_proj.weight", (3000, 2000), "F32")
    found = list(blocks(tensor, seed=0))
    assert all(len(block) <= 4 * random_tensors.BLOCK for block in found)
    values = np.frombuffer(b"".join(found), np.float32)
    assert values.size * 4 == tensor.nbytes
    assert abs(values.std() * 2000**0.5 - 1) < 1e-2


@pytest.mark.parametrize("version", RELEASED)
def test_outliers_are_where_trained_models_have_them(version: str, tmp_path: Path) -> None:
    """The largest value over the typical one, in the tower's residual stream and before down projections."""
    ratios = {}
    for outliers in (False, True):
        backbone = Backbone.from_pretrained(small(tmp_path / str(outliers), version, outliers=outliers))
        found: dict[str, list[float]] = {"vision": [], "down": []}

        def keep(part: str, module: nn.Module, found: dict[str, list[float]] = found) -> None:
            def hook(_: nn.Module, given: tuple[Tensor, ...]) -> None:
                found[part].append(float(given[0].abs().max() / given[0].abs().median()))

            module.register_forward_pre_hook(hook)

        for name, module in backbone.named_modules():
            if name.endswith("down_proj"):
                keep("down", module)
            elif name.endswith(("layer_norm1", "norm1")):
                keep("vision", module)
        with torch.no_grad():
            features = backbone(prompt(backbone.sizes, np.random.default_rng(0))).backbone_features
        assert 0.1 < features.std() < 10
        ratios[outliers] = {part: float(np.median(values)) for part, values in found.items()}
    assert ratios[True]["vision"] > 3 * ratios[False]["vision"]
    assert ratios[True]["down"] > 3 * ratios[False]["down"]


def test_channels_are_distinct_and_inside() -> None:
    outliers = Outliers(BackboneSizes.from_config({"kind": "n1.5 backbone"}))
    for width in (4, 9, 72, 1152, 6144):
        channels = outliers.channels(width)
        assert len(set(channels)) == random_tensors.NUM_CHANNELS
        assert 0 <= channels.min() <= channels.max() < width


def test_prompts_of_known_words_have_the_published_ids() -> None:
    made = Tokenizer.from_str(json.dumps(tokenizer(published_ids=True)))
    with safe_open(DATA / "tokens_qwen3.safetensors", framework="np") as file:
        about = json.loads(file.metadata()["about"])
        compared = 0
        for index, views, instruction, text, _ in about["prompts"]:
            if instruction not in about["instructions"][:3]:
                continue
            for view in range(1, views + 1):
                image = f"<image {view}><img>{'<IMG_CONTEXT>' * 256}</img>"
                text = text.replace(f"<image-{view}>", image)
            expected = file.get_tensor(f"prompt.{index}.{views}").ravel().tolist()
            assert made.encode(text, add_special_tokens=False).ids == expected
            compared += 1
        assert compared == 6


def test_the_tokenizer_without_gaps_is_the_fixtures_apart_from_its_words() -> None:
    theirs = json.loads((DATA / "tiny_tokenizer.json").read_text())
    mine = tokenizer(published_ids=False)
    vocabulary = mine["model"]["vocab"]
    assert sorted(vocabulary.values()) == list(range(len(vocabulary)))
    first = {token: index for token, index in theirs["model"]["vocab"].items() if index < 256}
    assert first.items() <= vocabulary.items()
    assert mine["pre_tokenizer"]["pretokenizers"][0] == theirs["pre_tokenizer"]["pretokenizers"][0]
    keys = ("content", "special", "normalized", "lstrip", "rstrip", "single_word")
    assert [[token[key] for key in keys] for token in mine["added_tokens"]] == [
        [token[key] for key in keys] for token in theirs["added_tokens"]
    ]
    made = Tokenizer.from_str(json.dumps(mine))
    text = "größe <IMG_CONTEXT>[\x00] 🤖 it's\n\n"
    assert made.decode(made.encode(text).ids, skip_special_tokens=False) == text


def test_the_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "checkpoint"
    assert main([str(folder), "--small", "--version", "n1.7"]) == 0
    assert "statistics.json" in capsys.readouterr().out
    assert main([str(folder), "--small"]) == 1
    assert "expected an empty directory" in capsys.readouterr().err


def test_arguments_that_do_not_fit(tmp_path: Path) -> None:
    head = small_head("n1.5")
    for changed, message in (
        ({"backbone_embedding_dim": 64}, "expected features of width 128, got 64"),
        ({"max_num_embodiments": 31}, "expected more than 31 embodiments"),
    ):
        with pytest.raises(InputError, match=message):
            write(tmp_path / "x", backbone=small_backbone("n1.5"), head={**head, **changed})
    with pytest.raises(InputError, match="head_dtype"):
        small(tmp_path / "x", head_dtype="F64")
    assert not (tmp_path / "x").exists()
