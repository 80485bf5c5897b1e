"""`saccade act`: pictures and words in, a chunk and its times out."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from saccade import Policy, cli
from saccade.cli import profiling
from tests.helpers.lfs_pointer import POINTER
from tests.helpers.whole_checkpoints import EMBODIMENT, HEIGHT, WIDTH, whole

PARTS = ["load", "frames", "processor", "backbone", "encode", "sample"]


@pytest.fixture
def pictures(tmp_path: Path) -> dict[str, Path]:
    """A picture of each camera, of several kinds."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, HEIGHT, WIDTH, 3), np.uint8)
    paths = {"front": tmp_path / "front.png", "wrist": tmp_path / "wrist=1.png"}
    Image.fromarray(frames[0]).save(paths["front"])
    Image.fromarray(frames[1]).convert("RGBA").save(paths["wrist"])
    return paths


def act(*words: object, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert cli.main(["act", *map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_it_prints_what_the_policy_answers(
    pictures: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = {"arm": [0.1, -0.2, 0.3, 0.4, 0.5], "hand": [0.0, 1.0]}
    (tmp_path / "state.json").write_text(json.dumps(state))
    words: tuple[object, ...] = (
        whole("isaac"),
        "--image",
        f"front={pictures['front']}",
        "--image",
        f"wrist={pictures['wrist']}",
    )
    words += ("--instruction", "open the drawer", "--state", tmp_path / "state.json", "--seed", 5)
    found = act(*words, capsys=capsys)
    policy = Policy.from_pretrained(whole("isaac"))
    observation = {
        "video": {name: np.asarray(Image.open(path).convert("RGB"))[None] for name, path in pictures.items()},
        "state": {key: np.array([values], np.float32) for key, values in state.items()},
        "language": {"task": ["open the drawer"]},
    }
    expected = policy.act(observation, seed=5)
    assert {key: np.float32(part).tolist() for key, part in found["actions"].items()} == {
        key: part.tolist() for key, part in expected.items()
    }
    assert list(found["milliseconds"]) == PARTS
    assert (found["embodiment"], found["embodiment_id"]) == (EMBODIMENT, 31)
    assert found["num_vl_tokens"] == policy.encode(observation).num_vl_tokens
    (tmp_path / "list.json").write_text(json.dumps([*state["arm"], *state["hand"]]))
    again = act(*words[:-3], tmp_path / "list.json", "--seed", 5, capsys=capsys)
    assert again["actions"] == found["actions"]
    other = act(
        *words, "--precision", "int8", "--head-precision", "bfloat16", "--num-steps", 2, capsys=capsys
    )
    assert other["precision"] == {"backbone": "int8", "head": "bfloat16"}
    assert other["actions"] != found["actions"]


def test_it_prints_tables_and_says_what_it_assumed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["act", str(whole("n17")), "--embodiment", "10"]) == 0
    out, err = capsys.readouterr()
    assert "Actions of new_embodiment, in its units" in out
    assert all(part in out for part in PARTS)
    assert "random images" in err
    assert "a state in the middle of the robot's range" in err
    assert '"pick up the red block"' in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--image", "front={front}"], "expected cameras wrist, front, got front"),
        (["--image", "{front}"], "expected cameras wrist, front, got wrist"),
        (["--image", "{front}", "{front}"], "--image: expected CAMERA=FILE"),
        (["--image", "a={front}", "a={front}"], "--image: expected CAMERA=FILE"),
        (["--image", "front=missing.png"], "missing.png: no such file"),
        (["--image", "front={text}"], "cannot be read as a picture"),
        (["--image", "front={deep}"], "expected a picture with 8 bits a colour, got mode I;16"),
        (
            ["--image", "front={small}", "wrist={front}"],
            f"expected frames of {HEIGHT} x {WIDTH} pixels, got 3 x 2",
        ),
        (["--state", "missing.json"], "missing.json: no such file"),
        (["--state", "{text}"], "cannot be read as JSON"),
        (["--state", "{pointer}"], "pointer: cannot be read as JSON: it is a Git LFS pointer"),
        (["--state", "{words}"], "expected lists of numbers"),
        (["--state", "{short}"], r"state: expected 7 numbers (arm (5), hand (2)), got 1"),
        (["--state", "{part}"], "state.hand: expected hand too, got arm"),
        (["--embodiment", "walker"], "got 'walker'"),
        (["--tokenizer", "missing"], "missing"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str],
    message: str,
    pictures: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = ("text", "deep.png", "small.png", "words", "short", "part", "pointer")
    files = {name: tmp_path / name for name in names}
    files["text"].write_text("no picture")
    files["pointer"].write_text(POINTER)
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(files["deep.png"])
    Image.fromarray(np.zeros((3, 2, 3), np.uint8)).save(files["small.png"])
    files["words"].write_text('{"arm": "high"}')
    files["short"].write_text("[1.0]")
    files["part"].write_text('{"arm": [0, 0, 0, 0, 0]}')
    given = {name.partition(".")[0]: path for name, path in files.items()} | pictures
    status = cli.main(["act", str(whole("isaac")), *(word.format(**given) for word in words)])
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.count("\n") == 1


def test_a_profile_says_where_the_time_goes(capsys: pytest.CaptureFixture[str]) -> None:
    found = act(whole("n17"), "--embodiment", "10", "--profile", capsys=capsys)
    profile = found["profile"]
    assert list(profile["milliseconds"]) == list(profiling.PARTS)
    assert all(spent >= 0 for spent in profile["milliseconds"].values())
    arithmetic = sum(profile["milliseconds"][part] for part in profiling.ARITHMETIC)
    assert arithmetic == pytest.approx(sum(profile["kernels"].values()))
    assert 0 < profile["not_arithmetic"] < 1
    assert {"patches", "connector", "attention", "to_q", "norm"} <= set(profile["kernels"])
    assert cli.main(["act", str(whole("n17")), "--embodiment", "10", "--profile"]) == 0
    out = capsys.readouterr().out
    assert "is not arithmetic" in out
    assert all(part in out for part in profiling.PARTS)


def test_a_profiled_call_is_a_call_of_act() -> None:
    policy = Policy.from_pretrained(whole("isaac"))
    observation = policy.example_observation()
    seconds = []
    for _ in range(5):
        started = time.perf_counter()
        policy.act(observation, seed=3)
        seconds.append(time.perf_counter() - started)
    found = profiling.profile(policy, observation, 3, None)
    # Machines that run other programs are uneven.
    assert 0.2 * min(seconds) < 1e-3 * found.total < 5 * max(seconds)
