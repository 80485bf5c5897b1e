"""Maps on a whole policy's own pictures: where tokens lie on frames, occlusion in pixels, the command."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

import saccade
from saccade import Policy, Processor
from saccade.cli import main
from saccade.observations import view_places
from saccade_lab.inside import features_of, inputs_of, parts_of
from saccade_lab.maps.drawing import HEAT, show
from saccade_lab.maps.grid import by_token, region_of, view_pictures
from saccade_lab.maps.layout import ViewLayout
from saccade_lab.maps.occlusion import Place, behind, measure
from saccade_lab.maps.view import View, from_policy
from tests.helpers.frames_cases import write_pictures, write_pictures_of
from tests.helpers.whole_checkpoints import CAMERAS, DATA, EMBODIMENT, HEIGHT, WIDTH, whole

LAYOUTS = ("isaac", "lerobot", "n16", "n17")
TOKENIZER = DATA / "tiny_tokenizer.json"


@functools.cache
def loaded(layout: str) -> Policy:
    return Policy.from_pretrained(whole(layout), embodiment=EMBODIMENT, num_threads=1)


@functools.cache
def view_of(layout: str) -> View:
    policy = loaded(layout)
    return from_policy(
        policy, policy.example_observation(), rng=np.random.default_rng(3), title="", source={}
    )


def region(layout: str, height: int, width: int) -> tuple[float, ...]:
    parts = parts_of(loaded(layout))
    return region_of(parts.processor, parts.backbone.config, height, width)


@pytest.mark.parametrize(("height", "width"), [(480, 640), (HEIGHT, WIDTH), (101, 37)])
def test_regions_are_the_crops_of_the_released_code(height: int, width: int) -> None:
    # Isaac-GR00T's N1.5 keeps int(0.95 * side) pixels from round((side - kept) / 2) on; lerobot keeps all.
    def crop(side: int) -> tuple[float, float]:
        kept = int(0.95 * side)
        start = round((side - kept) / 2)
        return start / side, (start + kept) / side

    (left, right), (top, bottom) = crop(width), crop(height)
    assert region("isaac", height, width) == pytest.approx((left, top, right, bottom), abs=2e-3)
    assert region("lerobot", height, width) == pytest.approx((0, 0, 1, 1), abs=2e-3)
    # N1.7 crops after it has resized, so whole pixels of another size are kept. N1.6 adds bars first.
    assert region("n17", height, width) == pytest.approx((0.025, 0.025, 0.975, 0.975), abs=6e-3)


def test_bars_of_a_processor_lie_beside_the_frame() -> None:
    options = {"letter_box_transform": True, "shortest_image_edge": 256, "use_albumentations": True}
    processor = Processor("n1.6", TOKENIZER, options={**options, "crop_fraction": 1.0})
    config = parts_of(loaded("n16")).backbone.config
    # 480 x 640 becomes a square of 640 with 80 rows above and below.
    assert region_of(processor, config, 480, 640) == pytest.approx((0, -80 / 480, 1, 560 / 480), abs=5e-3)
    assert region_of(processor, config, 640, 480) == pytest.approx((-80 / 480, 0, 560 / 480, 1), abs=5e-3)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_layout_is_that_of_the_features(layout: str) -> None:
    policy, view = loaded(layout), view_of(layout)
    (inputs,) = inputs_of(policy, policy.example_observation())
    (features,) = features_of(policy, [inputs])
    found = view.layout
    parts = found.parts()
    for name, positions in features.views.items():
        assert np.array_equal(parts[name], positions[0])
    assert [camera.name for camera in found.cameras] == list(view.images)
    words = [token for token in found.tokens if token.kind == "text"]
    assert "block" in [token.name for token in words]
    specials = [token for token in found.tokens if token.kind == "special"]
    assert {token.name for token in specials} >= {"<|im_start|>", "<|im_end|>"}
    processor = parts_of(policy).processor
    for token in words:
        (text,) = processor.texts(inputs.input_ids[0, token.position : token.position + 1])
        assert processor.tokens(text).tolist() == [inputs.input_ids[0, token.position]]


def test_texts_of_no_tokens() -> None:
    processor = parts_of(loaded("isaac")).processor
    assert processor.texts(np.empty(0, np.int64)) == []
    for wrong in (-1, 10**6, 2**40):
        with pytest.raises(saccade.InputError, match=f"of the tokenizer's .* got {wrong}"):
            processor.texts([wrong])
    with pytest.raises(saccade.ShapeError, match=r"expected \(tokens,\)"):
        processor.texts([[1]])


def grey(frames: NDArray[np.uint8], rows: slice, columns: slice) -> NDArray[np.uint8]:
    """Frames `(1, 1, height, width, 3)` with a part in their mean colour."""
    changed = frames.copy()
    changed[0, 0, rows, columns] = np.rint(frames.mean(axis=(0, 1, 2, 3))).astype(np.uint8)
    return changed


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_frame_behind_a_token_is_what_the_token_sees(layout: str) -> None:
    policy, view = loaded(layout), view_of(layout)
    config = parts_of(policy).backbone.config
    seen = policy.example_observation()
    camera = view.layout.cameras[-1]
    place = Place(camera, slice(1, 2), slice(2, 3))
    video = seen["video"]
    changed = grey(video[camera.name], *behind(place, *video[camera.name].shape[2:4]))
    (before,), (after,) = (
        inputs_of(policy, {**seen, "video": {**video, camera.name: frames}})
        for frames in (video[camera.name], changed)
    )
    difference = [
        np.abs(by_token(one, config) - by_token(other, config)).mean(axis=(2, 3))
        for one, other in zip(
            view_pictures(before.pixel_values, before, config),
            view_pictures(after.pixel_values, after, config),
            strict=True,
        )
    ]
    assert max(found.max() for found in difference[:-1]) == 0  # other views
    found = difference[-1]
    assert np.unravel_index(found.argmax(), found.shape) == (1, 2)
    assert found[1, 2] > 0.8 * found.sum()  # the rest is what resizing spreads


def test_behind_is_cut_off_at_the_edges() -> None:
    beside = ViewLayout("front", 0, 4, 4, (-0.5, 0.0, 1.5, 1.0))
    assert behind(Place(beside, slice(0, 4), slice(0, 1)), 8, 8) == (slice(0, 8), slice(0, 0))
    assert behind(Place(beside, slice(0, 4), slice(0, 4)), 8, 8) == (slice(0, 8), slice(0, 8))


def test_views_of_several_times_have_places() -> None:
    frames = {name: np.zeros((1, 2, 4, 4, 3), np.uint8) for name in ("a", "b")}
    assert list(view_places(frames).items()) == [
        ("a[0]", ("a", 0)),
        ("b[0]", ("b", 0)),
        ("a[1]", ("a", 1)),
        ("b[1]", ("b", 1)),
    ]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_view_is_what_the_policy_acts_on(layout: str) -> None:
    policy, view = loaded(layout), view_of(layout)
    seen = policy.example_observation()
    assert view.observation.noise is not None
    expected = policy.act(seen, noise=view.observation.noise)
    found = policy.normalizer.actions(
        view.observation.sample(parts_of(policy).head),
        np.concatenate([seen["state"][key] for key, _ in policy.requirements.state], axis=-1),
    )
    joined = np.concatenate(list(expected.values()), axis=-1)
    np.testing.assert_array_equal(np.asarray(found), joined)


def test_occlusion_is_the_policy_on_changed_frames() -> None:
    policy, view = loaded("isaac"), view_of("isaac")
    head, seen = parts_of(policy).head, policy.example_observation()

    def chunk(video: dict[str, Any]) -> NDArray[np.float32]:
        context = policy.encode({**seen, "video": video}).context
        return np.asarray(view.observation.sample(head, context))

    done: list[int] = []
    found = measure(
        head,
        view.layout,
        view.occluder,
        lambda count: np.zeros((count, 1, 1), np.float32),
        cell=4,
        on_done=done.append,
    )
    assert done == [2]
    # The processor keeps 38 of 40 rows from 1 on and 45 of 48 columns from 2 on, and a cell is all of them.
    frames = grey(seen["video"]["front"], slice(1, 39), slice(2, 47))
    change = np.abs(chunk({**seen["video"], "front": frames}) - chunk(seen["video"])).mean()
    assert found.change["front"] == pytest.approx(np.full((4, 4), change))
    assert found.change["front"][0, 0] != found.change["wrist"][0, 0]


def test_a_map_covers_the_part_of_the_picture_that_tokens_see() -> None:
    axes = Figure().add_subplot()
    picture, heat = np.zeros((4, 8, 3), np.uint8), np.ones((2, 2), np.float32)
    show(axes, (10.0, 12.0, 1.0, 0.0), picture, heat, 1.0, HEAT, (0.25, 0.5, 0.75, 1.5))
    drawn = axes.get_images()[-1]
    assert tuple(drawn.get_extent()) == (10.5, 11.5, 1.5, 0.5)
    assert drawn.get_clip_box() is not axes.bbox  # cut off at the picture


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_pictures_of(tmp_path / "table", "1", "2")
    words = ["--checkpoint", str(whole("isaac")), "--frames", str(folder), "--row", "1", "--cell", "4"]
    words += ["--instruction", "open the drawer", "--blocks", "0", "--steps", "0", "--num-threads", "1"]
    assert main(["attention", *words, "--out", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((tmp_path / "out" / "attention.json").read_text())
    assert (found["source"]["observation"], found["source"]["instruction"]) == ("2", "open the drawer")
    assert [camera["name"] for camera in found["layout"]["cameras"]] == list(CAMERAS)
    assert {token["name"] for token in found["layout"]["tokens"]} >= {"open", "the"}
    assert found["occlusion"]["cell"] == 4
    policy = loaded("isaac")
    pictures = {name: np.asarray(Image.open(folder / "2" / f"{name}.png"))[None, None] for name in CAMERAS}
    seen = policy.example_observation() | {"video": pictures, "language": {"task": [["open the drawer"]]}}
    view = from_policy(policy, seen, rng=np.random.default_rng(0), title="", source={})
    trace = view.observation.trace(parts_of(policy).head, record=("attention",), blocks=[0], steps=[0])
    maps = np.asarray(trace.attention[0, 0])[0].mean(axis=0)[trace.rows["future"]]
    summary = next(one for one in found["summaries"] if one["group"] == "future" and one["head"] == "mean")
    for name, positions in view.layout.parts().items():
        assert summary["mass"][name] == pytest.approx(maps[:, positions].sum(axis=1).mean(), abs=1e-6)
    assert (tmp_path / "out" / "sheet.png").is_file()
    assert '"region": [' in (tmp_path / "out" / "page.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--instruction", "push"], "--instruction: only with --frames"),
        (["--state", "x.json", "--precision", "int8"], "--state, --precision: only with --frames"),
        (["--frames", "{frames}", "--features", "x.npz"], "--features: not with --frames"),
        (["--frames", "{frames}", "--task", "push"], "--task: not with --frames"),
        (["--frames", "{frames}", "--grid", "2x2"], "--grid: not with --frames"),
        (["--frames", "{frames}", "--row", "1"], "--row: given 1, {frames} has observations 0 to 0"),
        (["--frames", "{frames}", "--embodiment", "walker"], "got 'walker'"),
        (["--frames", "{missing}"], "missing: no such directory"),
        (
            ["--frames", "{one}"],
            "one: expected one picture for each camera (wrist.png, front.png), got",
        ),
        (["--frames", "{frames}", "--tokenizer", "none"], "none"),
        (["--row", "1"], "--row: only with --features or --frames"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = {"frames": write_pictures(tmp_path / "frames"), "missing": tmp_path / "missing"}
    paths["one"] = write_pictures(tmp_path / "one", names=["front.png"])
    given = [word.format(**paths) for word in words]
    out = tmp_path / "out"
    assert main(["attention", "--checkpoint", str(whole("isaac")), *given, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert message.format(**paths) in error
    assert error.count("\n") == 1
    assert not out.exists()
