"""`saccade inspect --precision-check`: its numbers compared with plain computations on whole checkpoints."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import saccade
from saccade import InputError, cli
from saccade.checkpoints import quantize
from saccade.checkpoints.precisions import (
    DEVIATIONS,
    NUM_SAMPLES,
    PRECISIONS,
    Difference,
    PrecisionError,
    check_precisions,
    difference,
    range_of,
    recommended,
)
from saccade.observations.pictures import read_frames
from saccade.robots import Group
from tests.helpers.whole_checkpoints import CAMERAS, EMBODIMENT, HEIGHT, WIDTH, whole


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pictures."""
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(0)
    for picture in ("1", "2"):
        (folder / picture).mkdir()
        for name in CAMERAS:
            image = Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
            image.save(folder / picture / f"{name}.png")
    return folder


@pytest.mark.parametrize("layout", ["isaac", "lerobot-n17"])
def test_the_numbers_are_those_of_the_policy(layout: str, frames: Path) -> None:
    source = whole(layout)
    found = check_precisions(source, frames, instruction="open it", embodiment=EMBODIMENT, seed=3)
    assert [one.name for one in found.precisions] == list(PRECISIONS)
    assert (found.observations, found.samples, found.source) == (2, NUM_SAMPLES, str(source))
    exact, *others = found.precisions
    assert exact.features == exact.actions.worst == 0.0
    assert found.other_noise.worst > others[0].actions.worst > 0.0
    for one in (exact, others[-1]):
        policy = saccade.Policy.from_pretrained(source, embodiment=EMBODIMENT, precision=one.precision)
        assert policy.backbone is not None
        assert one.nbytes == policy.backbone.nbytes + policy.head.nbytes
        assert one.milliseconds > 0
    reference = saccade.Policy.from_pretrained(source, embodiment=EMBODIMENT)
    pictures = read_frames(frames, reference, instruction="open it")
    errors, largest = [], dict.fromkeys(one.actions.largest, 0.0)
    for index, picture in enumerate(pictures):
        apart = {}
        for key, loaded in (("theirs", reference), ("ours", policy)):
            context = loaded.encode(picture.observation)
            chunks = [loaded.sample(context, picture.observation, seed=3 + index, num_samples=NUM_SAMPLES)]
            apart[key] = (np.asarray(context.features[0].backbone_features[0]), chunks[0])
        theirs, ours = apart["theirs"], apart["ours"]
        errors += [np.linalg.norm(b - a) / np.linalg.norm(a) for a, b in zip(theirs[0], ours[0], strict=True)]
        for name in largest:
            largest[name] = max(largest[name], float(np.abs(ours[1][name] - theirs[1][name]).max()))
    assert others[-1].features == pytest.approx(np.mean(errors), rel=1e-4)
    assert others[-1].actions.largest == pytest.approx(largest)


def test_a_rounded_checkpoint_is_compared_with_what_it_was_made_from(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = whole("isaac"), tmp_path / "int4"
    quantize(source, out, to="int4")
    options: dict[str, Any] = {"instruction": "open it", "embodiment": EMBODIMENT, "num_threads": 1}
    original = check_precisions(source, frames, **options)
    alone = check_precisions(out, frames, **options)
    found = check_precisions(out, frames, reference=source, **options)
    assert (original.is_quantized, alone.is_quantized, found.is_quantized) == (False, True, True)
    assert (alone.reference, found.reference) == (None, str(source))
    # The integers are those that the original has in int4; in float32 they are what they represent.
    expected, int4 = original.precisions[-1], found.precisions[-1]
    assert (int4.features, int4.actions) == (expected.features, expected.actions)
    assert found.precisions[0].features > 0.0
    assert found.other_noise == original.other_noise
    assert alone.precisions[0].features == 0.0
    assert alone.precisions[-1].features < int4.features
    command = ["inspect", str(out), "--precision-check", str(frames), "--instruction", "open it"]
    command += ["--embodiment", EMBODIMENT, "--num-threads", "1"]
    assert cli.main(command) == 0
    assert "--reference CHECKPOINT compares with what it was made from" in capsys.readouterr().out
    assert cli.main([*command, "--reference", str(source)]) == 0
    printed = capsys.readouterr().out
    assert "--reference CHECKPOINT" not in printed
    assert "Difference from float32 of" in printed


def test_a_reference_of_another_robot_is_refused(frames: Path, tmp_path: Path) -> None:
    source = whole("isaac")
    other = Path(shutil.copytree(source, tmp_path / "other"))
    path = other / "experiment_cfg" / "metadata.json"
    metadata = json.loads(path.read_text())
    statistics = metadata[EMBODIMENT]["statistics"]["action"]["arm"]
    statistics["max"] = statistics["min"]
    path.write_text(json.dumps(metadata))
    options: dict[str, Any] = {"instruction": "open it", "embodiment": EMBODIMENT}
    with pytest.raises(InputError, match=r"in its weights alone, got other statistics of the action arm"):
        check_precisions(source, frames, reference=other, **options)
    metadata = json.loads((source / "experiment_cfg" / "metadata.json").read_text())
    statistics = metadata[EMBODIMENT]["statistics"]["state"]["arm"]
    statistics["max"] = [1 + number for number in statistics["max"]]
    path.write_text(json.dumps(metadata))
    with pytest.raises(InputError, match="got other images, tokens or states, as the models are given them"):
        check_precisions(source, frames, reference=other, **options)
    with pytest.raises(InputError, match=r"got other .* of the head"):
        check_precisions(source, frames, reference=whole("n16"), **options)


def test_one_policy_at_a_time_is_in_memory(frames: Path, held_at_loads: list[int]) -> None:
    source = whole("isaac")
    check_precisions(source, frames, reference=source, instruction="open it", embodiment=EMBODIMENT)
    assert held_at_loads == [0] * (2 + len(PRECISIONS))  # source and reference are compared first


def test_ranges_are_those_of_the_statistics() -> None:
    first, second = np.array([-1.0, 2.0, 5.0]), np.array([3.0, 2.5, 5.0])
    moving = np.array([True, True, False])
    for mode, expected in (
        ("min_max", [4.0, 0.5, 0.0]),
        ("q99", [4.0, 0.5, 0.0]),
        ("mean_std", [3 * DEVIATIONS, 2.5 * DEVIATIONS, 0.0]),
    ):
        group = Group("arm", 3, mode, first, second, moving)
        np.testing.assert_allclose(range_of(group, 7), expected)
    assert range_of(Group("hand", 2, "binary"), 7).tolist() == [1.0, 1.0]
    assert range_of(Group("hand", 2, "none"), 7).tolist() == [2.0, 2.0]
    steps = np.arange(12.0).reshape(4, 3)
    by_step = Group("arm", 3, "min_max", np.zeros((4, 3)), steps, np.ones((4, 3), bool))
    np.testing.assert_array_equal(range_of(by_step, 2), steps[:2])


def test_differences_are_the_largest_of_all_moments() -> None:
    groups = [Group("arm", 2, "min_max", np.zeros(2), np.array([2.0, 0.0]), np.array([True, False]))]
    exact = [{"arm": np.zeros((1, 3, 2), np.float32)} for _ in range(2)]
    given = [{"arm": picture["arm"].copy()} for picture in exact]
    given[0]["arm"][0, 1, 0] = -0.5
    given[1]["arm"][0, 2, 1] = 7.0  # a number that is constant
    found = difference(exact, given, groups)
    assert found == Difference({"arm": 7.0}, {"arm": 0.25})
    assert found.worst == 0.25


def test_the_smallest_that_is_close_is_recommended() -> None:
    def row(name: str, of_range: float, nbytes: int) -> PrecisionError:
        return PrecisionError(name, {}, 0.0, Difference({"arm": 1.0}, {"arm": of_range}), nbytes, 1.0)

    rows = [row("float32", 0.0, 400), row("bfloat16", 0.009, 200), row("int8", 0.011, 100)]
    assert recommended(rows) == "bfloat16"
    assert recommended([*rows[:2], row("int8", 0.01, 100)]) == "int8"
    assert recommended([rows[0], rows[2]]) == "float32"
    assert recommended([rows[0], row("int8", float("nan"), 100)]) == "float32"
    assert recommended([*rows, row("int4", 0.0, 50)]) == "int4"
    assert recommended([rows[2]]) is None


def test_the_command(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["inspect", str(whole("isaac")), "--precision-check", str(frames)]
    options = ["--instruction", "open it", "--embodiment", EMBODIMENT, "--num-threads", "1"]
    assert cli.main([*command, *options]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "2 observations, 4 chunks of each" in printed
    assert "recommended: " in printed
    assert all(name in printed for name in (*PRECISIONS, "other noise"))
    assert cli.main([*command, *options, "--json"]) == 0
    values: Any = json.loads(capsys.readouterr().out)
    assert values["recommended"] in PRECISIONS
    assert values["tolerance"] == 0.01
    assert [row["precision"] for row in values["precisions"]] == [dict(p) for p in PRECISIONS.values()]
    assert values["precisions"][0]["features"] == 0.0


def test_what_cannot_be_checked_is_refused(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = str(whole("isaac"))
    for arguments, message in (
        (["--instruction", "open it"], "--instruction: only with --precision-check"),
        (["--seed", "1", "--num-threads", "1"], "--seed, --num-threads: only with --precision-check"),
        (["--precision-check", str(frames), "--config", source], "--config: not with"),
        (["--precision-check", str(tmp_path / "none"), "--embodiment", EMBODIMENT], "no such directory"),
    ):
        assert cli.main(["inspect", source, *arguments]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(InputError, match="seed"):
        check_precisions(source, frames, seed=-1)
