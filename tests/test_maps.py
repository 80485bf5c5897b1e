"""Maps of attention: numbers by hand, occlusion, where observations come from, the sheet, the command."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from maps_cases import one_hot_maps
from matplotlib.figure import Figure
from PIL import Image
from released import load_released
from safetensors.numpy import save_file
from safetensors.torch import save_file as save_torch_file
from scipy.stats import spearmanr

import saccade
from saccade import Intervention
from saccade.checkpoints import read_tensors
from saccade.cli import main
from saccade.cli.attention import show
from saccade.errors import InputError, ShapeError
from saccade.maps import occlusion, record
from saccade.maps.drawing import ranges
from saccade.maps.layout import Camera, parse_layout
from saccade.maps.notes import NO_FUTURE, NO_IMAGES
from saccade.maps.occlusion import BlankedFrames, DroppedPositions, cell_for, measure, places_of
from saccade.maps.sheet import DOTS_PER_INCH, WIDTH, Sheet, write_sheet
from saccade.maps.summary import Overlap, entropy, overlap, shuffle, summarize
from saccade.maps.view import LayoutOptions, View, from_file, from_simulator
from saccade.observation import Observation
from saccade.reference import ActionHead as ReferenceHead
from saccade.sim import graphics
from saccade.sim.environment import TaskEnvironment
from saccade.sim.policy import DEMO_CHECKPOINT, Policy
from saccade.sim.rollout import Episode, environment_for, run_episode

torch.set_num_threads(1)


# Numbers about maps.


def numbers(found: Overlap | None) -> tuple[float, ...]:
    assert found is not None
    return dataclasses.astuple(found)


def test_entropy() -> None:
    uniform, one_hot = np.full(7, 1 / 7), np.eye(7)[2]
    assert entropy(uniform) == pytest.approx(math.log(7))
    assert entropy(one_hot) == 0.0
    halves = np.array([0.5, 0.25, 0.25, 0.0])
    assert entropy(np.stack([halves, np.eye(4)[0]])) == pytest.approx([1.5 * math.log(2), 0.0])


def test_overlap_of_identical_maps() -> None:
    assert numbers(overlap(np.tile([0.1, 0.2, 0.7], (5, 1)))) == pytest.approx((0.0, 1.0, 1.0))


def test_overlap_of_maps_that_share_nothing() -> None:
    assert numbers(overlap(np.eye(4))) == pytest.approx((1.0, 0.0, 4.0))
    spread = np.kron(np.eye(3), [0.5, 0.5])  # three tokens with two keys each
    assert numbers(overlap(spread)) == pytest.approx((1.0, 0.0, 3.0))


def test_overlap_by_hand() -> None:
    # The first two: H(.75, .25) - (0 + ln 2) / 2, over ln 2; the third shares nothing with either.
    near = (-0.75 * math.log(0.75) - 0.25 * math.log(0.25)) / math.log(2) - 0.5
    mean = np.array([1.5, 0.5, 1.0]) / 3
    distinct = math.exp(-(mean * np.log(mean)).sum() - math.log(2) / 3)
    found = overlap(np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]))
    assert numbers(found) == pytest.approx(((near + 1 + 1) / 3, 1 / math.sqrt(2) / 3, distinct))


def test_one_map_overlaps_with_nothing() -> None:
    assert overlap(np.full((1, 4), 0.25)) is None


def test_shuffling_keeps_what_each_part_gets() -> None:
    rng = np.random.default_rng(0)
    maps = rng.dirichlet(np.ones(12), size=6)
    parts = {"image": np.arange(0, 8), "text": np.arange(8, 12)}
    shuffled = shuffle(maps, parts, rng)
    for positions in parts.values():
        np.testing.assert_array_equal(
            np.sort(shuffled[:, positions], axis=1), np.sort(maps[:, positions], axis=1)
        )
    assert (shuffled != maps).any()
    assert np.abs(shuffled.mean(axis=0) - maps.mean(axis=0)).max() > 1e-3  # each on its own


def test_a_group_in_numbers() -> None:
    maps = np.array([[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.25, 0.75]], dtype=np.float32)
    parts = {"left": np.array([0, 1]), "text": np.array([2]), "special": np.array([3])}
    found = summarize(maps, parts, parts, np.random.default_rng(0))
    assert found.tokens == 2
    assert found.mass == pytest.approx({"left": 0.5, "text": 0.125, "special": 0.375})
    assert found.entropy.most == pytest.approx(math.log(2))
    assert found.entropy.least == pytest.approx(-0.25 * math.log(0.25) - 0.75 * math.log(0.75))
    assert found.entropy.mean == pytest.approx((found.entropy.most + found.entropy.least) / 2)
    expected = float(np.exp(entropy(maps.mean(axis=0)) - found.entropy.mean))
    assert numbers(found.overlap) == pytest.approx((1.0, 0.0, expected))


# Occlusion.


@pytest.fixture(scope="module")
def tiny() -> saccade.ActionHead:
    released = load_released("n15_tiny")
    return saccade.ActionHead.load(released.path, config=released.config, num_threads=1)


TINY_LAYOUT = parse_layout("text:2,image:2x3=left,image:1x2=top,text:1", 11)


def tiny_occluder() -> DroppedPositions:
    given = load_released("n15_tiny")
    return DroppedPositions(
        Observation(given.backbone_features[:1], given.state[:1], given.embodiment_id[:1], given.noise[:1])
    )


class Blind:
    """A head whose rows do not read the vision-language tokens at all."""

    def __init__(self, head: saccade.ActionHead) -> None:
        self.head = head
        self.cut = Intervention(cut=[(group, "vl") for group in ("state", "future", "action")])

    def encode(self, *args: Any, **options: Any) -> Any:
        return self.head.encode(*args, **options)

    def sample(self, *args: Any, **options: Any) -> Any:
        return self.head.sample(*args, **options, intervention=self.cut)


def no_noise(count: int) -> Any:
    return np.zeros((count, 6, 5), np.float32)


def test_every_patch_is_taken_away_once() -> None:
    places = places_of(TINY_LAYOUT, 2)
    shown = [(p.camera.name, p.rows.start, p.rows.stop, p.columns.start, p.columns.stop) for p in places]
    assert shown == [("left", 0, 2, 0, 2), ("left", 0, 2, 2, 3), ("top", 0, 1, 0, 2)]
    assert len(places_of(TINY_LAYOUT, 1)) == 8
    assert cell_for(TINY_LAYOUT, None) == 1
    assert cell_for(parse_layout("image:16x16,image:4x4", 272), None) == 2
    assert cell_for(TINY_LAYOUT, 3) == 3
    with pytest.raises(InputError, match="cell: given 0"):
        cell_for(TINY_LAYOUT, 0)


def test_a_patch_that_nothing_reads_changes_nothing(tiny: saccade.ActionHead) -> None:
    blind: Any = Blind(tiny)
    found = measure(blind, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1)
    assert {name: change.tolist() for name, change in found.change.items()} == {
        "left": [[0.0] * 3] * 2,
        "top": [[0.0] * 2],
    }
    seeing = measure(tiny, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1)
    assert min(change.min() for change in seeing.change.values()) > 0


def test_occlusion_equals_the_reference_without_these_positions(tiny: saccade.ActionHead) -> None:
    given = load_released("n15_tiny")
    reference = ReferenceHead.load(given.path, config=given.config, dtype=torch.float64)
    embodiment = torch.tensor([int(given.embodiment_id[0])])
    state, noise = (torch.from_numpy(np.array(array[:1], np.float64)) for array in (given.state, given.noise))

    def chunk(kept: Sequence[int]) -> Any:
        features = torch.from_numpy(np.array(given.backbone_features[:1, list(kept)], np.float64))
        with torch.no_grad():
            return reference.sample(reference.encode(features), state, embodiment, noise=noise).numpy()

    found = measure(tiny, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1).change
    places = [("left", 0, 0, 2), ("left", 1, 2, 7), ("top", 0, 1, 9)]
    for camera, row, column, position in places:
        without = chunk([place for place in range(11) if place != position])
        assert found[camera][row, column] == pytest.approx(
            float(np.abs(without - chunk(range(11))).mean()), rel=1e-3, abs=1e-6
        )


@pytest.mark.parametrize("batch", [1, 3, 8, 100])
def test_batches_of_any_size_agree(tiny: saccade.ActionHead, batch: int) -> None:
    done: list[int] = []
    occluder: Any = tiny_occluder()
    occluder.batch = batch
    found = measure(tiny, TINY_LAYOUT, occluder, no_noise, cell=1, on_done=done.append)
    expected = measure(tiny, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1)
    for name, change in expected.change.items():
        np.testing.assert_array_equal(found.change[name], change)
    assert done[-1] == 8


def test_other_noise_is_the_mean_over_pairs(tiny: saccade.ActionHead) -> None:
    def whole(count: int) -> Any:
        return np.stack([np.full((6, 5), float(index == 0), np.float32) for index in range(count)])

    found = measure(tiny, TINY_LAYOUT, tiny_occluder(), whole, cell=1)
    assert found.other_noise == pytest.approx(2 / occlusion.NOISES)  # pairs with the first one differ by 1


# Observations.


@pytest.fixture(scope="module")
def policy() -> Policy:
    return Policy.load(num_threads=1)


@pytest.fixture(scope="module")
def head(policy: Policy) -> saccade.ActionHead:
    found = policy.whole.head
    assert isinstance(found, saccade.ActionHead)
    return found


@pytest.fixture(scope="module")
def pushed(policy: Policy) -> View:
    return from_simulator(policy, "push", 3, 0)


def test_the_observation_is_that_of_the_rollout(policy: Policy) -> None:
    looks = (0, 13)  # at the start, within the second chunk
    seen: dict[int, Any] = {}

    def on_step(environment: TaskEnvironment, episode: Episode) -> None:
        if episode.steps in looks:
            seen[episode.steps] = environment.observe()["images"]

    with contextlib.closing(environment_for(policy, "button-press-topdown")) as environment:
        episode = run_episode(environment, policy, 2, on_step=on_step)
    for steps in looks:
        found = from_simulator(policy, "button-press-topdown", 2, steps)
        assert found.images.keys() == seen[steps].keys()
        for name, picture in found.images.items():
            np.testing.assert_array_equal(picture, seen[steps][name])
    with pytest.raises(InputError, match=f"--after: given 190, but .* ends after {episode.steps} steps"):
        from_simulator(policy, "button-press-topdown", 2, 190)


def test_blanking_a_picture_of_one_colour_changes_nothing(
    policy: Policy, head: saccade.ActionHead, pushed: View
) -> None:
    grey = np.full_like(pushed.images["top"], 90)
    observation = {
        "images": {**pushed.images, "top": grey},
        "proprio": np.asarray(policy.whole.normalizer.unstate(pushed.observation.state)).ravel(),
        "instruction": pushed.source["instruction"],
    }
    nested = policy.observation(observation)
    occluder = BlankedFrames(policy.whole, nested, policy.whole.encode(nested), pushed.observation)
    found = measure(head, pushed.layout, occluder, lambda count: np.zeros((count, 16, 4), np.float32), cell=2)
    assert not found.change["top"].any()
    assert found.change["left"].max() > 0.01
    # One of them by hand: the lower right quarter of what the tower sees of the left picture, rows and
    # columns 2 to 65 of its 68.
    blanked = pushed.images["left"].copy()
    blanked[34:66, 34:66] = np.rint(blanked.mean(axis=(0, 1)))
    chunks = [
        head(
            policy.features({**observation, "images": images}),
            pushed.observation.state,
            0,
            noise=pushed.observation.noise,
        )
        for images in (observation["images"], {**observation["images"], "left": blanked})
    ]
    expected = float(np.abs(np.asarray(chunks[1]) - np.asarray(chunks[0])).mean())
    assert found.change["left"][2:, 2:] == pytest.approx(np.full((2, 2), expected), abs=1e-6)


def feature_arrays() -> dict[str, Any]:
    """What the released single-view head was given, with the prompt that fits its T_vl."""
    given = load_released("n15_single_view")
    ids = [7] * 20 + [151669] * 256 + [8] * 20
    return {
        "backbone_features": given.backbone_features,
        "state": given.state,
        "embodiment_id": given.embodiment_id,
        "noise": given.noise,
        "input_ids": np.array([ids]),
        "images": np.zeros((1, 32, 32, 3), np.uint8),
    }


def written(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez(path, **arrays)
    return path


def taken(path: Path, **options: Any) -> View:
    config = saccade.HeadConfig.from_dict(load_released("n15_single_view").config)
    return from_file(path, config, row=0, options=LayoutOptions(**options), seed=5)


def test_a_file_of_features(tmp_path: Path) -> None:
    arrays = feature_arrays()
    found = taken(written(tmp_path / "f.npz", arrays))
    np.testing.assert_array_equal(found.observation.backbone_features, arrays["backbone_features"])
    np.testing.assert_array_equal(found.observation.noise, arrays["noise"])
    assert found.observation.embodiment_id == arrays["embodiment_id"][0]
    assert found.layout.cameras == (Camera("camera 1", 20, 16, 16),)
    assert found.images["camera 1"].shape == (32, 32, 3)
    by_hand = taken(tmp_path / "f.npz", text="text:20,image:16x16=left,text:*")
    assert list(by_hand.images) == ["left"]
    del arrays["noise"], arrays["images"]
    drawn = taken(written(tmp_path / "g.npz", {f"_in.{name}": array for name, array in arrays.items()}))
    assert drawn.images == {}
    expected = np.random.default_rng(5).standard_normal((16, 32), dtype=np.float32)
    assert drawn.observation.noise is not None
    np.testing.assert_array_equal(drawn.observation.noise[0], expected)


def test_safetensors_with_bfloat16_and_token_strings(tmp_path: Path) -> None:
    arrays = feature_arrays()
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}
    tensors["backbone_features"] = tensors["backbone_features"].bfloat16()
    names = [f"<{place}>" for place in range(296)]
    save_torch_file(tensors, tmp_path / "f.safetensors", metadata={"tokens": json.dumps(names)})
    found = taken(tmp_path / "f.safetensors")
    np.testing.assert_array_equal(
        found.observation.backbone_features, tensors["backbone_features"].float().numpy()
    )
    assert found.layout.tokens[0].name == "<0>"


def test_a_row_of_a_batch(tmp_path: Path) -> None:
    given = load_released("n15_tiny")
    mask = np.zeros((2, 11), np.int64)
    mask[0, 1:5], mask[1, 2:6] = 1, 1  # as tokenizers write masks
    arrays = {
        "backbone_features": given.backbone_features,
        "state": given.state,
        "embodiment_id": given.embodiment_id,
        "image_mask": mask,
        "attention_mask": np.array([[1] * 11, [0] + [1] * 10]),
    }
    config = saccade.HeadConfig.from_dict(given.config)
    path = written(tmp_path / "f.npz", arrays)
    found = from_file(path, config, row=1, options=LayoutOptions(), seed=0)
    np.testing.assert_array_equal(found.observation.backbone_features, given.backbone_features[1:])
    np.testing.assert_array_equal(found.observation.state, given.state[1:])
    assert found.observation.embodiment_id == given.embodiment_id[1]
    assert found.layout.cameras == (Camera("camera 1", 2, 2, 2),)
    assert found.layout.parts()["pad"].tolist() == [0]
    with pytest.raises(InputError, match="--row: given 2"):
        from_file(path, config, row=2, options=LayoutOptions(), seed=0)


FILES: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"backbone_features": None}, InputError, "no backbone_features; there are embodiment_id"),
    ({"state": None, "embodiment_id": None}, InputError, "no state, embodiment_id"),
    (
        {"backbone_features": np.zeros((1, 296, 64), np.float32)},
        ShapeError,
        r"expects \(batch, T_vl, 128\)",
    ),
    ({"backbone_features": np.zeros((296, 128), np.float32)}, ShapeError, "backbone_features: shape"),
    ({"backbone_features": np.zeros((0, 296, 128), np.float32)}, InputError, "expected no empty axis"),
    ({"backbone_features": np.zeros((1, 296, 128), np.int64)}, InputError, "floating point"),
    ({"input_ids": None}, InputError, "neither input_ids nor image_mask; give the positions"),
    ({"input_ids": np.zeros((1, 295), np.int64)}, ShapeError, r"input_ids: shape .* expected \(1, 296\)"),
    ({"input_ids": np.zeros((1, 296))}, InputError, "input_ids: expected integers"),
    ({"image_mask": np.full((1, 296), 2)}, InputError, "image_mask: expected booleans"),
    ({"images": np.zeros((2, 32, 32, 3), np.uint8)}, ShapeError, r"images: shape .* \(1, 1, any, any, 3\)"),
    ({"images": np.zeros((1, 32, 32, 3), np.float32)}, InputError, "images: expected uint8"),
    ({"embodiment_id": np.array([0.5])}, InputError, "embodiment_id: expected an integer"),
    ({"noise": np.zeros((1, 16, 31), np.float32)}, ShapeError, r"noise: shape .* \(1, 16, 32\)"),
    ({"state": np.zeros((2, 64), np.float32)}, ShapeError, "state: shape"),
    ({"tokens": np.array(["x"] * 5)}, ShapeError, "tokens: shape"),
]


@pytest.mark.parametrize(("changed", "error", "message"), FILES)
def test_files_that_do_not_fit(
    tmp_path: Path, changed: dict[str, Any], error: type[Exception], message: str
) -> None:
    arrays = {name: array for name, array in (feature_arrays() | changed).items() if array is not None}
    with pytest.raises(error, match=message):
        taken(written(tmp_path / "f.npz", arrays))


def test_files_that_are_none(tmp_path: Path) -> None:
    for name, message in (("f.npz", r"cannot be read as \.npz"), ("f.safetensors", "cannot be read as")):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(InputError, match=message):
            taken(tmp_path / name)
    (tmp_path / "f.pt").touch()
    with pytest.raises(InputError, match=r"ends in \.npz or \.safetensors"):
        taken(tmp_path / "f.pt")
    with pytest.raises(FileNotFoundError, match="no such file"):
        taken(tmp_path / "missing.npz")


# What is recorded.


def test_maps_are_those_of_the_reference(head: saccade.ActionHead, pushed: View) -> None:
    selection = record.Selection(blocks=(0, 3), steps=(1,), heads=(0, 2), shown_heads=())
    rows, attention = record.attention_maps(head, pushed, selection)
    assert rows == {"state": slice(0, 1), "future": slice(1, 33), "action": slice(33, 49)}
    assert list(attention) == [(1, 0), (1, 3)]
    assert pushed.observation.noise is not None
    reference = ReferenceHead.load(DEMO_CHECKPOINT, dtype=torch.float64)
    tokens = record.random_tokens(head.future_tokens, seed=4)
    other = record.redrawn_maps(head, pushed, selection, tokens)
    for intervention, found in ((None, attention), (Intervention(future_tokens=tokens), other)):
        with torch.no_grad():
            expected = reference.trace(
                reference.encode(torch.from_numpy(pushed.observation.backbone_features.astype(np.float64))),
                torch.from_numpy(pushed.observation.state.astype(np.float64)),
                torch.tensor([0]),
                noise=torch.from_numpy(pushed.observation.noise.astype(np.float64)),
                intervention=intervention,
            ).attention
        for place, maps in found.items():
            whole = expected[place][0, [0, 2]].numpy()
            kept = whole if intervention is None else whole[:, 1:33]
            np.testing.assert_allclose(maps, kept, atol=1e-5)


def test_random_tokens_have_the_lengths_of_the_learned_ones() -> None:
    learned = read_tensors(DEMO_CHECKPOINT, "action_head.future_tokens.")["weight"]
    drawn = record.random_tokens(learned, seed=0)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), np.linalg.norm(learned, axis=1), rtol=1e-5)
    assert np.abs((drawn * learned).sum(axis=1)).max() < 0.6 * np.square(learned).sum(axis=1).min()
    np.testing.assert_array_equal(drawn, record.random_tokens(learned, seed=0))


def test_summaries_of_maps_made_by_hand() -> None:
    maps = one_hot_maps()
    found = {(e["block"], e["group"], e["head"]): e for e in maps.summaries if e["step"] == 1}
    assert set(found) == {
        (block, group, head)
        for block in (0, 1)
        for group in ("state", "future", "action")
        for head in ("mean", 0, 1)
    }
    # Head 0: every future token on a patch of its own; head 1: all of them on the special token.
    own, shared = found[0, "future", 0], found[0, "future", 1]
    assert own["overlap"] == {"jensen_shannon": 1.0, "cosine": 0.0, "distinct": pytest.approx(3.0)}
    assert own["mass"] == {
        "left": pytest.approx(1 / 3),
        "top": pytest.approx(2 / 3),
        "text": 0.0,
        "special": 0.0,
    }
    assert shared["overlap"] == {"jensen_shannon": 0.0, "cosine": 1.0, "distinct": 1.0}
    assert shared["mass"]["special"] == 1.0
    mean = found[0, "future", "mean"]
    assert mean["mass"]["special"] == 0.5
    assert mean["entropy"]["mean"] == pytest.approx(math.log(2))
    assert mean["per_head"]["entropy"] == 0.0
    assert mean["per_head"]["overlap"]["distinct"] == pytest.approx(2.0)
    assert mean["per_head"]["redrawn"]["distinct"] == pytest.approx(1.0)
    assert found[0, "state", "mean"]["overlap"] is None
    assert found[1, "action", 0]["reads"] == "rows"
    assert found[1, "action", 0]["mass"] == pytest.approx({"state": 1 / 6, "future": 3 / 6, "action": 2 / 6})


def test_agreement_is_the_rank_correlation_over_patches() -> None:
    maps = one_hot_maps()  # occlusion: 0, 1, 0, 0 and 0, 0, 0.25 of the patches at positions 1 to 7
    keys = np.array([9, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 9], np.float32)
    expected = spearmanr(keys[1:8], [0, 1, 0, 0, 0, 0, 0.25]).statistic
    assert maps.agreement(keys) == pytest.approx(expected)
    assert maps.agreement(np.square(keys)) == pytest.approx(expected)
    assert maps.agreement(np.ones(9, np.float32)) is None
    found = {(entry["block"], entry["group"]): entry["rank_correlation"] for entry in maps.agreements()}
    assert list(found) == [(0, "state"), (0, "future"), (0, "action")]
    assert found[0, "state"] is None


# The sheet.


def drawn(figure: Figure, shape: tuple[int, int]) -> list[Any]:
    """All maps of this shape on the sheet, in the order in which they were drawn."""
    arrays = [np.asarray(image.get_array()) for axes in figure.axes for image in axes.images]
    return [array for array in arrays if array.shape == shape]


def test_the_sheet_shows_each_patch_where_it_is() -> None:
    maps = one_hot_maps(steps=(1,))
    figure = Sheet(maps).draw()
    left, top = drawn(figure, (2, 2)), drawn(figure, (1, 3))
    # Occlusion, then state, future and action of block 0, then the future tokens one by one.
    assert len(left) == len(top) == 1 + 3 + 3
    np.testing.assert_allclose(left[0], [[0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(left[2], [[0.0, 0.0], [1 / 6, 0.0]], atol=1e-7)  # token 0 of 3, head 0 of 2
    np.testing.assert_allclose(top[2], [[0.0, 1 / 6, 1 / 6]], atol=1e-7)
    np.testing.assert_allclose(left[4], [[0.0, 0.0], [0.5, 0.0]])
    np.testing.assert_allclose(top[5], [[0.0, 0.5, 0.0]])
    np.testing.assert_allclose(top[6], [[0.0, 0.0, 0.5]])


def test_the_sheet_as_a_file(tmp_path: Path) -> None:
    write_sheet(one_hot_maps(), tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.width == WIDTH * DOTS_PER_INCH
        assert sheet.height > 1000
        assert np.asarray(sheet).std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def texts(figure: Figure) -> str:
    return " ".join(" ".join(text.get_text().split()) for text in figure.texts)


def test_the_sheet_says_what_is_missing() -> None:
    without = texts(Sheet(one_hot_maps(future_tokens=0, images=False)).draw())
    assert record.CAVEAT in without
    assert record.OCCLUSION in without
    assert NO_FUTURE in without
    assert "one by one" not in without
    assert "maps are drawn on white" in without


def test_without_image_tokens_there_is_no_occlusion_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = load_released("n15_tiny")
    (tmp_path / "config.json").write_text(json.dumps(given.config))
    names = ("backbone_features", "state", "embodiment_id")
    features = written(tmp_path / "f.npz", {name: getattr(given, name) for name in names})
    arguments = [
        "--checkpoint",
        str(given.path),
        "--config",
        str(tmp_path / "config.json"),
        "--features",
        str(features),
    ]
    chosen = ["--layout", "text:*", "--row", "1", "--steps", "0", "--num-threads", "1"]
    assert main(["attention", *arguments, *chosen, "--out", str(tmp_path / "out")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert NO_IMAGES in shown
    assert record.CAVEAT in shown
    assert "occlusion" not in shown
    found = json.loads((tmp_path / "out/attention.json").read_text())
    assert found["occlusion"] is None
    assert found["caveat"] == record.CAVEAT
    assert {entry["rank_correlation"] for entry in found["agreement"]} == {None}
    page = (tmp_path / "out/page.html").read_text()
    assert NO_IMAGES in page
    assert record.OCCLUSION not in page


def test_ranges() -> None:
    assert ranges((0,)) == "0"
    assert ranges((0, 1, 3, 4, 5, 9)) == "0-1, 3-5, 9"


# The command.


@pytest.fixture
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


@pytest.mark.usefixtures("no_probe")
def test_the_command_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--task", "reach", "--seed", "1", "--after", "8", "--blocks", "1,2", "--steps", "0,3"]
    assert main(["attention", *arguments, "--num-threads", "1", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((tmp_path / "attention.json").read_text())
    assert {path.name for path in tmp_path.iterdir()} == {"attention.json", "page.html", "sheet.png"}
    assert found["source"] == {
        "kind": "simulator",
        "task": "reach",
        "seed": 1,
        "control_steps": 8,
        "instruction": "move the hand to the green ball",
        "views": ["left", "right", "top"],
    }
    assert found["checkpoint"]["sha256"] == Policy.load().checkpoint_sha256()
    assert found["selection"]["blocks"] == [1, 2]
    assert found["caveat"] == f"{record.CAVEAT} {record.OCCLUSION}"
    assert {(entry["step"], entry["block"]) for entry in found["summaries"]} == {
        (0, 1),
        (0, 2),
        (3, 1),
        (3, 2),
    }
    for entry in found["summaries"]:
        assert sum(entry["mass"].values()) == pytest.approx(1.0, abs=1e-5)
    assert np.shape(found["occlusion"]["change"]["top"]) == (4, 4)
    assert found["occlusion"]["other_noise"] > 0


@pytest.mark.usefixtures("no_probe")
def test_a_checkpoint_without_future_tokens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = Path(shutil.copytree(DEMO_CHECKPOINT, tmp_path / "policy"))
    config = json.loads((checkpoint / "config.json").read_text())
    config["action_head_cfg"]["num_target_vision_tokens"] = 0
    (checkpoint / "config.json").write_text(json.dumps(config))
    tensors = read_tensors(DEMO_CHECKPOINT)
    del tensors["action_head.future_tokens.weight"]
    save_file(tensors, checkpoint / "model.safetensors")
    arguments = ["attention", "--checkpoint", str(checkpoint), "--blocks", "0", "--steps", "0", "--cell", "4"]
    assert main([*arguments, "--num-threads", "1", "--out", str(tmp_path / "out")]) == 0
    assert NO_FUTURE in " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "out/attention.json").read_text())
    assert found["num_future_tokens"] == 0
    assert {entry["group"] for entry in found["summaries"]} == {"state", "action"}
    assert "has no future tokens" in (tmp_path / "out/page.html").read_text()


def test_a_file_of_another_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = load_released("n15_single_view")
    (tmp_path / "config.json").write_text(json.dumps(given.config))
    features = written(tmp_path / "f.npz", feature_arrays())
    arguments = [
        "--checkpoint",
        str(given.path),
        "--config",
        str(tmp_path / "config.json"),
        "--features",
        str(features),
    ]
    chosen = ["--blocks", "2", "--steps", "3", "--heads", "1", "--cell", "8", "--num-threads", "1", "--json"]
    assert main(["attention", *arguments, *chosen, "--out", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["head"] for entry in found["summaries"]] == ["mean", 1] * 3
    change = np.array(found["occlusion"]["change"]["camera 1"])
    assert change.shape == (16, 16)
    assert (change == np.kron(change[::8, ::8], np.ones((8, 8)))).all()
    assert "drop_vl" in found["occlusion"]["method"]


def test_the_table_keeps_the_names_of_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("the camera at the left wrist [bold]", "the camera that looks down from above the table")
    layout = parse_layout(f"text:1,image:2x2={names[0]},image:1x3={names[1]},special:1", 9)
    maps = one_hot_maps()
    maps = dataclasses.replace(maps, view=dataclasses.replace(maps.view, layout=layout))
    show(maps, {"summaries": maps.summaries}, tmp_path)
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)  # more than 80 letters, and no markup
    assert "…" not in shown


CASES: list[tuple[list[str], str]] = [
    (["--blocks", "4"], "--blocks: given 4, expected 0 to 3"),
    (["--blocks", "-1"], "--blocks: given -1"),
    (["--steps", "0,4"], "--steps: given 0, 4, expected 0 to 3"),
    (["--heads", "7"], "--heads: given 7, expected 0 to 3"),
    (["--heads", "one"], "--heads: given 'one', expected numbers"),
    (["--heads", "mean", "1"], "--heads: given mean and numbers"),
    (["--task", "fly"], "unknown name 'fly'"),
    (["--seed", "1000000"], "evaluation seeds"),
    (["--after", "-1"], "--after: given -1"),
    (["--num-threads", "0"], "--num-threads: given 0"),
    (["--cell", "0"], "--cell: given 0"),
    (["--out", "f.npz"], "--out: f.npz is not a directory"),
    (["--layout", "text:*"], "--layout: only with --features"),
    (["--grid", "2x2", "--row", "1"], "--grid, --row: only with --features"),
    (["--features", "f.npz", "--task", "push"], "expected one observation"),
    (["--features", "missing.npz"], "missing.npz: no such file"),
    (["--features", "f.npz"], "f.npz: backbone_features: shape (1, 296, 64), the checkpoint expects"),
    (["--features", "fits.npz", "--layout", "image:4x4"], "the features have T_vl 20"),
    (["--features", "fits.npz", "--grid", "3x"], "grid: given '3x'"),
    (["--checkpoint", "nowhere"], "nowhere"),
    (["--checkpoint", "head.safetensors", "--config", "config.json"], "--features FILE"),
]


@pytest.mark.usefixtures("no_probe")
@pytest.mark.parametrize(("arguments", "message"), CASES)
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    others: dict[str, Any] = {"state": np.zeros((1, 4), np.float32), "embodiment_id": np.array([0])}
    np.savez("f.npz", backbone_features=np.zeros((1, 296, 64), np.float32), **others)
    np.savez("fits.npz", backbone_features=np.zeros((1, 20, 128), np.float32), **others)
    shutil.copy(load_released("n15_tiny").path, "head.safetensors")
    Path("config.json").write_text(json.dumps(load_released("n15_tiny").config))
    assert main(["attention", "--out", "out", *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert not Path("out").exists()
