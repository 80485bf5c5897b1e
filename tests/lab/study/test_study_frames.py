"""Studies on a whole checkpoint's own pictures: no simulator, no file of features."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from saccade import BackboneInputs, Policy
from saccade.cli import main
from saccade.observations.pictures import read_frames
from saccade_lab.inside import context_of, features_of, head_inputs, inputs_of, parts_of
from saccade_lab.reference import ActionHead, Backbone
from saccade_lab.study import derivatives as head_derivatives
from saccade_lab.study import input_derivatives as derivatives
from saccade_lab.study.cell import Cell
from saccade_lab.study.pictures import PictureSource, encode
from saccade_lab.study.questions.gradients import Gradients
from saccade_lab.study.questions.patching import Patching
from saccade_lab.study.questions.patching_section import FROM_FILE
from saccade_lab.study.table import read_provenance, read_table
from tests.checkpoints.test_hub import NAME, cached
from tests.helpers.frames_cases import write_pictures, write_pictures_of
from tests.helpers.whole_checkpoints import EMBODIMENT, whole

torch.set_num_threads(1)

TOLD = "open the drawer"


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pictures of two episodes."""
    return write_pictures_of(tmp_path_factory.mktemp("frames") / "table", "pour/1", "pour/2", "wipe/1")


@functools.cache
def loaded(layout: str) -> Policy:
    return Policy.from_pretrained(whole(layout), embodiment=EMBODIMENT, num_threads=1)


def study(name: str, frames: Path, out: Path, *more: str, layout: str = "isaac") -> int:
    words = ["--checkpoint", str(whole(layout)), "--frames", str(frames), "--instruction", TOLD]
    return main(["study", name, *words, "--embodiment", EMBODIMENT, "--out", str(out), *more])


def table_of(out: Path, name: str) -> pd.DataFrame:
    return read_table(out / f"{name}.csv")


@pytest.mark.parametrize("layout", ["isaac", "n17"])
def test_cuts_are_those_of_the_same_features_in_a_file(
    layout: str,
    frames: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A file does not say how many action dimensions the robot has.
    monkeypatch.setattr(PictureSource, "action_width", property(lambda source: source.config.action_dim))
    arms = ["--arms", "future-unread,future-blind,action-blind", "--seed", "5"]
    assert study("cuts", frames, tmp_path / "frames", *arms, layout=layout) == 0
    printed = capsys.readouterr().out
    assert "Success: not measured, pictures have no closed loop." in printed
    assert "It is not known which episode" not in printed
    policy = loaded(layout)
    rows = []
    for picture in read_frames(frames, policy, instruction=TOLD):
        (features,) = policy.encode(picture.observation).features
        rows.append(head_inputs(policy, picture.observation, features))
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(row, name) for row in rows])
        for name in ("backbone_features", "state", "embodiment_id", "image_mask")
        if getattr(rows[0], name) is not None
    }
    # Numbers of the seed of the noise are those of rows, so both sources draw the same.
    np.savez(tmp_path / "file.npz", **arrays, episode=np.array([0, 0, 1]))
    words = ["--checkpoint", str(whole(layout)), "--features", str(tmp_path / "file.npz")]
    assert main(["study", "cuts", *words, "--out", str(tmp_path / "file"), *arms]) == 0
    found, expected = table_of(tmp_path / "frames", "cuts"), table_of(tmp_path / "file", "cuts")
    names = ["seed", "arm", "episode", "chunk_change", "chunk_change_max", "noise_change"]
    pd.testing.assert_frame_equal(found[names], expected[names])
    assert found["observation"].unique().tolist() == ["pour/1", "pour/2", "wipe/1"]
    settings = read_provenance(tmp_path / "frames" / "cuts.json").settings["frames"]
    assert (settings["name"], settings["episodes"], settings["instruction"]) == ("table", 2, TOLD)


def test_only_the_dimensions_of_the_robot_count(frames: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = PictureSource(str(whole("isaac")), str(frames), TOLD, embodiment=EMBODIMENT, num_threads=1)
    head, width = source.head(), loaded("isaac").normalizer.head_action_width
    assert 0 < width < head.config.action_dim
    receiver, donor = source.observed("frames", 0), source.all.row(2)
    chunks = receiver.sample(head)
    np.testing.assert_array_equal(source.actions(receiver, None), chunks[..., :width])

    rows = Patching(source, (0,), (0,)).measure(Cell((FROM_FILE, "frames", 0)))
    before = receiver.with_draw(0).sample(head)[0, :, :width].astype(np.float64)
    after = replace(donor, noise=receiver.with_draw(0).noise).sample(head)[0, :, :width]
    assert rows[0]["squared_way"] == pytest.approx(float(np.square(after - before).sum()), rel=1e-5)

    seen: list[torch.Tensor] = []
    sensitivity = head_derivatives.action_sensitivity

    def watched(*given: Any) -> Any:
        seen.append(given[4])
        return sensitivity(*given)

    monkeypatch.setattr(head_derivatives, "action_sensitivity", watched)
    Gradients(source, projections=1).measure(Cell(("actions", "frames", 0)))
    (projection,) = seen
    assert projection[..., :width].abs().min() > 0
    assert not projection[..., width:].any()


def test_progress_is_by_moment(frames: Path) -> None:
    told: list[tuple[int, int]] = []
    encode.cache_clear()
    given: dict[str, Any] = {"checkpoint": str(whole("isaac")), "embodiment": EMBODIMENT, "num_threads": 1}
    watched = PictureSource(
        frames=str(frames), on_observation=lambda done, total: told.append((done, total)), **given
    )
    assert len(watched.all) == 3
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert (
        PictureSource(frames=str(frames), **given).all is watched.all
    )  # the same source, and nothing is repeated
    assert len(told) == 3


def test_a_published_id(frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    cached(tmp_path, whole("isaac"))
    words = ["--checkpoint", NAME, "--frames", str(frames / "wipe"), "--out", str(tmp_path / "out")]
    assert main(["study", "gradients", *words, "--projections", "1"]) == 0
    assert main(["study", "cuts", *words, "--arms", "future-unread"]) == 0
    words[-1] = str(tmp_path / "maps")
    assert main(["attention", *words, "--blocks", "0", "--steps", "0", "--cell", "4"]) == 0


def test_the_hash_covers_what_the_policy_sees(frames: Path, tmp_path: Path) -> None:
    def digest(folder: Path, instruction: str = TOLD) -> str:
        source = PictureSource(str(whole("isaac")), str(folder), instruction, num_threads=1)
        return str(source.describe()["frames"]["sha256"])

    same = write_pictures_of(tmp_path / "again", "pour/1", "pour/2", "wipe/1")
    other = write_pictures_of(tmp_path / "other", "pour/1", "pour/2", "wipe/2")
    assert digest(same) == digest(frames)
    assert len({digest(frames), digest(frames, "push"), digest(other)}) == 3


def test_prompts_of_other_lengths_are_padded_exactly(tmp_path: Path) -> None:
    """Frames of other sizes have other numbers of tokens in N1.7; each picture is as it is alone."""
    wide = write_pictures_of(tmp_path / "both", "1", "2")
    for name in ("wrist", "front"):
        (wide / "2" / f"{name}.png").unlink()
    write_wide(wide / "2")
    source = PictureSource(str(whole("n17")), str(wide), TOLD, embodiment=EMBODIMENT, num_threads=1)
    assert source.all.drop_vl is not None
    for row, name in enumerate(("1", "2")):
        alone = PictureSource(str(whole("n17")), str(wide / name), TOLD, embodiment=EMBODIMENT, num_threads=1)
        noise = source.observed("frames", row)
        expected = source.actions(noise, None)
        observation = alone.all
        object.__setattr__(observation, "noise", noise.noise)
        np.testing.assert_array_equal(alone.actions(observation, None), expected)


def write_wide(folder: Path) -> None:
    from PIL import Image

    for name in ("wrist", "front"):
        pixels = np.random.default_rng(0).integers(0, 256, (40, 96, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{name}.png")


def test_patching_from_another_instruction(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = "pick up the red block and put it away"
    words = ["--blocks", "0,3", "--other-instruction", other]
    assert study("patching", frames, tmp_path / "out", *words) == 0
    printed = capsys.readouterr().out
    assert "instruction, future rows in all blocks: the chunk moves" in printed
    assert "Control, all rows in all blocks: a share of 1.0000, as expected." in printed
    source = PictureSource(str(whole("isaac")), str(frames), TOLD, other_instruction=other, num_threads=1)
    assert source.others is not None
    assert source.others.num_vl_tokens > source.all.num_vl_tokens
    policy = loaded("isaac")
    seen = read_frames(frames, policy, instruction=other)[1].observation
    (features,) = policy.encode(seen).features
    np.testing.assert_array_equal(source.others.row(1).backbone_features, features.backbone_features)
    settings = read_provenance(tmp_path / "out" / "patching.json").settings["frames"]
    assert settings["other"]["instruction"] == other


def test_patching_from_another_directory_and_from_another_episode(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pictures(tmp_path / "other", seed=9)
    words = ["--blocks", "3", "--steps", "0"]
    assert study("patching", frames, tmp_path / "a", *words, "--other-frames", str(tmp_path / "other")) == 0
    assert set(table_of(tmp_path / "a", "patching")["kind"]) == {"frames"}
    assert study("patching", frames, tmp_path / "b", *words) == 0
    donors = table_of(tmp_path / "b", "patching").drop_duplicates("seed").set_index("seed")["donor_seed"]
    assert donors.to_dict() == {0: 2, 1: 2, 2: 0}
    one = write_pictures(tmp_path / "one")
    assert study("patching", one, tmp_path / "c", *words) == 0
    assert "there is no donor for it" in capsys.readouterr().out


def test_tokens_at_run_time(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert study("n-runtime", frames, tmp_path / "out", "--num-future-tokens", "4") == 0
    assert "every token twice, equal mass: the chunk changed by at most" in capsys.readouterr().out
    assert main(["study", "report", str(tmp_path / "out")]) == 0
    assert "pictures in table (SHA-256" in (tmp_path / "out" / "report.md").read_text().replace("\n", " ")


@pytest.mark.parametrize("layout", ["isaac", "lerobot", "n16", "n17"])
def test_derivatives_are_those_of_one_graph(layout: str, frames: Path) -> None:
    """Against torch's derivative of the actions by pixels, through backbone and head at once."""
    source = PictureSource(str(whole(layout)), str(frames), TOLD, embodiment=EMBODIMENT, num_threads=1)
    encoded = encode(source)
    inputs, layout_of_row = encoded.inputs[0], encoded.layouts[0]
    head, backbone = (
        ActionHead.from_pretrained(source.checkpoint),
        Backbone.from_pretrained(source.checkpoint),
    )
    row = source.all.row(0).with_noise(np.random.default_rng(0), source.config)
    noise = row.noise
    assert noise is not None
    direction = torch.randn(1, *noise.shape[1:], generator=torch.Generator().manual_seed(0))
    direction = direction[..., : source.config.action_dim]
    masks: dict[str, Any] = {} if row.image_mask is None else {"image_mask": torch.from_numpy(row.image_mask)}
    id_of_robot = int(row.embodiment_id[0])

    def scalar(features: torch.Tensor) -> torch.Tensor:
        actions = head.sample(head.encode(features), row.state, id_of_robot, noise=noise, **masks)
        return (actions * direction).sum()

    taps = derivatives.Taps(backbone)
    with taps.applied():
        features = backbone(inputs).backbone_features
    whole_graph = torch.autograd.grad(scalar(features), taps.pixels)

    leaf = head.encode(torch.from_numpy(row.backbone_features)).detach().requires_grad_()
    actions = head.sample(leaf, row.state, id_of_robot, noise=noise, **masks)
    (by_vl,) = torch.autograd.grad((actions * direction).sum(), leaf)
    by_features = derivatives.feature_derivatives(head, torch.from_numpy(row.backbone_features), by_vl)
    found = derivatives.input_derivatives(backbone, inputs, by_features)
    for pixels, expected in zip(found.pixels, whole_graph, strict=True):
        joined = derivatives.times_joined(expected, backbone).abs().numpy()
        np.testing.assert_allclose(pixels, joined, rtol=2e-3, atol=1e-4 * joined.max())
    by_view = derivatives.by_image_token(found, inputs, encoded.backbone_config, layout_of_row)
    rows = derivatives.part_rows(found, layout_of_row, by_view)
    for kind in ("tokens", "pixels"):
        shares = [one["share"] for one in rows if one["input"] == kind and "row" not in one]
        assert sum(shares) == pytest.approx(1)
    total = sum(float(np.square(pixels).sum()) for pixels in found.pixels)
    copies = 2 if encoded.backbone_config.version == "n1.7" else 1  # N1.7 is given each pixel twice
    squares = [one["norm"] ** 2 for one in rows if "row" in one]
    assert sum(squares) == pytest.approx(total / copies, rel=1e-4)


def test_a_derivative_is_what_a_small_change_does_in_rust() -> None:
    policy = loaded("isaac")
    parts = parts_of(policy)
    seen = policy.example_observation()
    (inputs,) = inputs_of(policy, seen)
    (features,) = features_of(policy, [inputs])
    given = head_inputs(policy, seen, features).with_noise(np.random.default_rng(0), parts.head.config)
    assert given.noise is not None

    def chunk(changed: BackboneInputs) -> np.ndarray:
        return np.asarray(
            given.sample(parts.head, context_of(policy, features_of(policy, [changed])).context)
        )

    direction = np.random.default_rng(1).standard_normal(chunk(inputs).shape).astype(np.float32)
    head, backbone = ActionHead.from_pretrained(whole("isaac")), Backbone.from_pretrained(whole("isaac"))
    leaf = head.encode(torch.from_numpy(np.array(given.backbone_features))).detach().requires_grad_()
    actions = head.sample(leaf, given.state, int(given.embodiment_id[0]), noise=given.noise)
    (by_vl,) = torch.autograd.grad((actions * torch.from_numpy(direction)).sum(), leaf)
    by_features = derivatives.feature_derivatives(head, torch.from_numpy(given.backbone_features), by_vl)
    (pixels,) = derivatives.input_derivatives(backbone, inputs, by_features).pixels
    place = np.unravel_index(pixels.argmax(), pixels.shape)
    values = np.array(inputs.pixel_values)
    step = np.zeros_like(values)
    step[place] = 0.05
    ends = [
        float((chunk(BackboneInputs(values + sign * step, inputs.input_ids)) * direction).sum())
        for sign in (1, -1)
    ]
    assert abs(ends[0] - ends[1]) / 0.1 == pytest.approx(float(pixels[place]), rel=0.02)


def test_the_command_of_gradients(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert study("gradients", frames, tmp_path / "out", "--projections", "1") == 0
    assert "By pixels: shares of the squared derivative of the chunk: wrist" in capsys.readouterr().out
    table = table_of(tmp_path / "out", "gradients")
    tokens = table[(table["input"] == "pixels") & table["row"].notna()]
    assert tokens.groupby(["seed", "part"]).size().unique().tolist() == [16]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "{frames}", "--features", "x.npz"], "--features: not with --frames"),
        (["--frames", "{frames}", "--tasks", "push"], "--tasks: not with --frames"),
        (["--frames", "{frames}", "--episodes", "3"], "--episodes: not with --frames"),
        (["--frames", "{frames}", "--kinds", "words"], "--kinds: not with --frames"),
        (["--other-instruction", "push"], "--other-instruction: only with --frames"),
        (["--features", "x.npz", "--instruction", "push"], "--instruction: only with --frames"),
        (["--frames", "{frames}", "--embodiment", "walker"], "got 'walker'"),
        (["--frames", "{frames}", "--other-frames", "none"], "none: no such directory"),
        (["--frames", "{empty}"], "empty: expected pictures named after the cameras"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], message: str, frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    given = [word.format(frames=frames, empty=tmp_path / "empty") for word in words]
    out = tmp_path / "out"
    assert main(["study", "patching", "--checkpoint", str(whole("isaac")), *given, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not out.exists()
