"""Training on made-up recordings of LIBERO: what is written is what the engine reads and computes."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import saccade
from saccade.errors import InputError
from saccade.robots import LANGUAGE_KEY
from saccade_lab.libero import demos, training
from saccade_lab.libero.checkpoint import CAMERAS, EMBODIMENT, policy_actions
from saccade_lab.libero.layout import ACTION_GROUPS, STATE_GROUPS
from saccade_lab.libero.policy import LiberoPolicy
from saccade_lab.libero.recording import describe, is_recording, load_samples, read_recordings
from saccade_lab.libero.sizes import libero_config
from saccade_lab.reference import ActionHead, Backbone
from saccade_lab.sim import demos as sim_demos
from saccade_lab.training.batches import Batches, prompts_of
from saccade_lab.training.inputs import prepared_inputs
from saccade_lab.training.settings import LIBERO_SETTINGS, released_std
from saccade_lab.training.train import Progress, new_run
from tests.helpers.libero_cases import SAID, SIZE, TINY, demonstration, tiny, with_statistics, write_recording

VERSIONS = ["n1.5", "n1.7"]


@pytest.fixture(scope="module", autouse=True)
def short_saves() -> Iterator[None]:
    """The held-out loss and its plot take most of the time of so short runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("saccade_lab.training.train.VALIDATION_FRAMES", 3)
        patch.setattr("saccade_lab.training.train.plot_history", lambda history, path: None)
        yield


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("libero-demos"))


@pytest.fixture(scope="module", params=VERSIONS)
def trained(
    request: pytest.FixtureRequest, recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    out = tmp_path_factory.mktemp(f"policy-{request.param}") / "run"
    progress: list[Progress] = []
    training.train(recording, out, tiny(request.param), progress.append)
    assert [one.step for one in progress] == [1, 2, 3, 4]
    assert np.isfinite(progress[-1].loss)
    return out


def test_the_engine_runs_what_was_trained_as_the_reference_does(trained: Path) -> None:
    policy = saccade.Policy.from_pretrained(trained)
    version = policy.head.config.version
    assert policy.head.config.mask_mode == ("alternate" if version == "n1.7" else "none")
    one = demonstration(3)
    frames, said = one.images[0], SAID[1]
    assert policy.processor is not None
    inputs = policy.processor(dict(zip(CAMERAS, frames, strict=True)), said)
    backbone = Backbone.from_pretrained(trained)
    head = ActionHead.from_pretrained(trained)
    state = policy.normalizer.state(one.proprio[:1])
    noise = np.random.default_rng(0).standard_normal((1, 16, 7)).astype(np.float32)
    with torch.no_grad():
        seen = backbone(inputs)
        masks = {"attention_mask": seen.attention_mask, "image_mask": seen.image_mask}
        if version == "n1.5":
            masks = {}
        chunk = head.sample(head.encode(seen.backbone_features), state, 0, noise=noise, **masks)
    expected = policy.normalizer.actions(chunk.numpy())[0]
    parts = np.split(one.proprio[:1, None], np.cumsum(list(STATE_GROUPS.values()))[:-1], axis=-1)
    observation = {
        "video": {name: frame[None, None] for name, frame in zip(CAMERAS, frames, strict=True)},
        "state": dict(zip(STATE_GROUPS, parts, strict=True)),
        "language": {LANGUAGE_KEY: [[said]]},
    }
    answer = policy.act(observation, noise=noise)
    found = np.concatenate([answer[name][0] for name in ACTION_GROUPS], axis=-1)
    assert found.shape == (16, 7)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_training_sees_what_the_policy_sees(trained: Path, recording: Path) -> None:
    policy = saccade.Policy.from_pretrained(trained)
    assert policy.processor is not None
    files = libero_config(tiny(policy.head.config.version), SAID, SIZE)
    tasks = read_recordings(recording)
    samples, held_out = load_samples(recording, tasks, 16, files.processor())
    assert held_out is samples  # too few episodes to hold one out
    prompts = prompts_of(files, files.processor())
    backbone = Backbone(files.backbone_sizes)
    shown = np.concatenate([demonstration(seed).images for seed in (0, 1, 10, 11)])
    for row, number in ((0, 0), (len(samples) - 1, 1)):
        assert samples.tasks[row] == number
        now = samples.now[row]
        images = torch.from_numpy(samples.images[now : now + 1])
        found = prepared_inputs(backbone, images, [prompts[number][0]])
        seen = policy.processor(list(shown[now]), SAID[number])
        expected = backbone.prepare(seen)
        np.testing.assert_allclose(found.pixels[0], expected.pixels[0], atol=1e-6)
        assert found.grids == expected.grids
        for name in ("input_ids", "attention_mask", "image_places", "positions"):
            assert torch.equal(getattr(found, name), getattr(expected, name)), name


def test_a_data_set_of_the_demonstrations_fits_the_policy(trained: Path, tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "demos", frame_stride=1)
    demos.export(recording, read_recordings(recording), 1, tmp_path / "data")
    policy = saccade.Policy.from_pretrained(trained)
    data = saccade.datasets.open(tmp_path / "data").for_policy(policy)
    assert (len(data), data.fps, data.tasks) == (2, 20, SAID)
    one = demonstration(10, frame_stride=1)
    np.testing.assert_array_equal(data.frame(1, 5, "wrist_image").pixels, one.images[5, 1])
    state = np.concatenate([data.state(1, 5)[name] for name in STATE_GROUPS], axis=-1)
    np.testing.assert_array_equal(np.ravel(state), one.proprio[5])
    actions = np.concatenate([data.actions(1, 5)[name] for name in ACTION_GROUPS], axis=-1)
    np.testing.assert_array_equal(actions[:, :6], one.actions[5:21, :6])
    np.testing.assert_array_equal(actions[:, 6], one.actions[5:21, 6] < 0)  # 1 is open
    answer = policy.act(data.observation(1, 5), seed=0)
    assert {name: part.shape[1:] for name, part in answer.items()} == {
        name: (16, width) for name, width in ACTION_GROUPS.items()
    }


def test_the_normalizer_is_that_of_the_files(trained: Path) -> None:
    normalizer = saccade.Normalizer.from_pretrained(trained)
    assert {group.key: group.size for group in normalizer.state_groups} == STATE_GROUPS
    assert {group.key: group.size for group in normalizer.action_groups} == ACTION_GROUPS
    # The gripper of an action is 1 where the expert opens it, and so the policy's is between 0 and 1.
    bounds = np.stack([np.full((1, 16, 7), side, np.float32) for side in (-1, 1)])
    grippers = [normalizer.actions(one)[0, 0, -1] for one in bounds]
    np.testing.assert_allclose(grippers, [0, 1], atol=1e-6)


def test_every_protocol_of_its_release_runs_it(trained: Path) -> None:
    whole = saccade.Policy.from_pretrained(trained)
    one = demonstration(3)
    seen = {
        "images": dict(zip(CAMERAS, one.images[0], strict=True)),
        "state": one.proprio[0],
        "instruction": SAID[0],
    }
    version = whole.head.config.version
    of_lerobot = ("lerobot",) if version == "n1.7" else ()
    for protocol in ("auto", *of_lerobot, f"isaac-{version.replace('.', '')}"):
        policy = LiberoPolicy(whole, trained, protocol)
        actions = policy.act(seen, seed=0).actions
        assert actions.shape == (16, 7)
        assert set(np.unique(actions[:, -1])) <= {-1, 1}
        # What was learned from the expert's actions is executed as the expert's actions.
        np.testing.assert_array_equal(policy.gripper.applied(policy_actions(one.actions)), one.actions)


def test_the_checkpoint_is_small_and_names_the_robot(trained: Path) -> None:
    tensors = load_file(trained / "model.safetensors")
    assert {name.split(".")[0] for name in tensors} == {"backbone", "action_head"}
    policy = saccade.Policy.from_pretrained(trained)
    assert policy.embodiment_id == 0
    assert EMBODIMENT in repr(policy)


def test_the_defaults_have_at_most_six_million_parameters() -> None:
    assert LIBERO_SETTINGS.category_std == released_std(LIBERO_SETTINGS.width) > 0.06
    for version in VERSIONS:
        settings = dataclasses.replace(LIBERO_SETTINGS, version=version)
        with torch.device("meta"):
            config = libero_config(settings, SAID, 256)
            backbone, head = Backbone(config.backbone_sizes), ActionHead(config.head_config)
        count = sum(one.numel() for module in (backbone, head) for one in module.parameters())
        assert 2e6 < count < 6e6


@pytest.mark.parametrize("version", VERSIONS)
def test_training_in_bfloat16_is_near_that_in_float32(version: str, recording: Path, tmp_path: Path) -> None:
    losses = {}
    for dtype in ("float32", "bfloat16"):
        progress: list[Progress] = []
        settings = dataclasses.replace(tiny(version), dtype=dtype)
        training.train(recording, tmp_path / dtype, settings, progress.append)
        losses[dtype] = [one.loss for one in progress]
    assert losses["bfloat16"] != losses["float32"]
    np.testing.assert_allclose(losses["bfloat16"], losses["float32"], rtol=0.03)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_padded_prompt_changes_nothing(version: str, recording: Path) -> None:
    """In a batch, prompts are padded to the longest; each sample's loss is as it is alone."""
    config = libero_config(tiny(version), SAID, SIZE)
    tasks = read_recordings(recording)
    samples, _ = load_samples(recording, tasks, 16, config.processor())
    run = new_run(tiny(version), with_statistics(config), {})
    learner, head = run.learner.double(), run.learner.action_head
    prompts = prompts_of(config, config.processor())
    assert len(prompts[0][0]) != len(prompts[1][0])
    rng = np.random.default_rng(0)
    noise, actions = rng.standard_normal((2, 2, 16, 7))
    rows = [0, len(samples) - 1]

    def loss(chosen: list[int]) -> float:
        numbers = [rows.index(row) for row in chosen]
        images = torch.from_numpy(samples.images[samples.now[chosen]])
        said = [prompts[number][0] for number in numbers]
        seen = learner.backbone(prepared_inputs(learner.backbone, images, said))
        return float(
            head.loss(
                seen.backbone_features,
                rng_state[numbers],
                0,
                actions[numbers],
                noise=noise[numbers],
                time=np.array([0.3, 0.6])[numbers],
                drop_vl=~seen.attention_mask,
                **learner.masks(seen),
            )
        )

    rng_state = rng.standard_normal((2, 8))
    with torch.no_grad():
        alone = [loss([row]) for row in rows]
        assert loss(rows) == pytest.approx(np.mean(alone), rel=1e-9)


def test_actions_after_a_disturbance_and_words_of_each_task(recording: Path) -> None:
    config = with_statistics(libero_config(TINY, SAID, SIZE))
    samples, _ = load_samples(recording, read_recordings(recording), 16, config.processor())
    one = demonstration(0)
    assert set(np.unique(samples.actions[..., -1][samples.mask[..., 0] > 0])) == {0, 1}
    np.testing.assert_array_equal(samples.mask[0, :, 0], np.arange(16) <= 9)  # step 9 was disturbed
    np.testing.assert_array_equal(samples.actions[0, :10, :6], one.actions[:10, :6])
    np.testing.assert_array_equal(samples.actions[0, :10, 6], 1)  # open
    np.testing.assert_array_equal(samples.actions[0, 10:], 0)
    prompts = prompts_of(config, config.processor())
    targets = np.zeros(6, np.float32), np.ones(6, np.float32)
    batches = Batches(samples, config, Backbone(config.backbone_sizes), prompts, targets, 8)
    batch = batches.draw(0, 0)
    assert batch.state.shape == (8, 8)
    assert batch.actions.shape == (8, 16, 7)
    assert batch.mask.shape == (8, 16, 1)


def test_an_interrupted_run_continues_to_the_same_weights(recording: Path, tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if progress.step == 2:
            raise KeyboardInterrupt

    training.train(recording, tmp_path / "whole", TINY, lambda progress: None)
    with pytest.raises(KeyboardInterrupt):
        training.train(recording, tmp_path / "parts", TINY, stop)
    training.train(recording, tmp_path / "parts", TINY, lambda progress: None)
    one, other = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "parts"))
    assert all(torch.equal(one[name], other[name]) for name in one)
    with pytest.raises(InputError, match=r"other settings \(seed\)"):
        training.train(
            recording, tmp_path / "parts", dataclasses.replace(TINY, seed=1), lambda progress: None
        )


def test_recordings_that_do_not_fit_are_refused(recording: Path, tmp_path: Path) -> None:
    assert is_recording(recording)
    assert not is_recording(tmp_path)
    with pytest.raises(FileNotFoundError, match="no demonstrations found"):
        read_recordings(tmp_path)
    assert [task.instruction for task in read_recordings(recording)] == list(SAID)
    assert describe(recording, read_recordings(recording))["tasks"] == {
        "libero_object-0": 2,
        "libero_object-1": 2,
    }
    other = write_recording(tmp_path / "other", episodes=0)
    tasks = read_recordings(other)
    processor = libero_config(TINY, SAID, SIZE).processor()
    with pytest.raises(InputError, match="no demonstrations of libero_object-0"):
        load_samples(other, tasks, 16, processor)
    path = other / "libero_object-1" / "recording.json"
    values = json.loads(path.read_text())
    for changed in ({"frame_stride": 9}, {"expert": values["expert"] + 1}):
        path.write_text(json.dumps({**values, **changed}))
        with pytest.raises(InputError, match="different settings"):
            read_recordings(other)

    def record() -> None:
        sim_demos.record_with(never, {tasks[1].name: tasks[1]}, {tasks[1].name: 1}, other, never)

    with pytest.raises(InputError, match=r"other settings \(expert changed\)"):  # nor are others added to it
        record()
    path.write_text(json.dumps({"cameras": [], "image_size": 68, "frame_stride": 3}))
    with pytest.raises(InputError, match="expected a recording of LIBERO"):
        read_recordings(other)
    path.write_text(json.dumps(values)[:-9])
    for read in (lambda: is_recording(other), lambda: read_recordings(other), record):
        with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: cannot be read as JSON: .*\Z"):
            read()


def never(given: Any) -> Any:
    raise AssertionError(f"recorded {given}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": "n1.6"}, "version: given 'n1.6', expected one of n1.5, n1.7"),
        ({"patch_size": 16}, "patch_size: given 16, expected 32"),
        ({"view_size": 100}, "view_size: given 100, expected a multiple of 32"),
        ({"view_size": 0}, "view_size: given 0"),
        ({"absent_share": 0.1}, "absent_share: given 0.1, expected 0"),
        ({"language_dropout": 0.1}, "language_dropout: given 0.1, expected 0 with n1.7"),
    ],
)
def test_settings_that_no_libero_policy_has_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        libero_config(dataclasses.replace(TINY, **change), SAID, SIZE)  # type: ignore[arg-type]
