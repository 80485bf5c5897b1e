"""The plugin on checkpoints that lerobot wrote: which actions are executed, renamed keys, frames of any size.

`make test-compat` runs this after plugin.py.
"""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.processor import RenameObservationsProcessorStep

import saccade
from lerobot_policy_saccade import SaccadeConfig
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy
from lerobot_policy_saccade.processor_saccade import make_saccade_pre_post_processors
from tests.helpers import whole_checkpoints

N15, N17 = "lerobot", "lerobot-n17"
PACK = 2  # of the steps

Edit = Callable[[dict[str, Any], list[dict[str, Any]]], None]


@pytest.fixture
def edited(tmp_path: Path) -> Callable[[str, Edit], Path]:
    """Copies a checkpoint, and changes its `config.json` and the steps of its preprocessor."""

    def edit(layout: str, change: Edit) -> Path:
        folder = tmp_path / layout
        shutil.copytree(whole_checkpoints.whole(layout), folder)
        paths = [folder / name for name in ("config.json", "policy_preprocessor.json")]
        config, pipeline = (json.loads(path.read_text()) for path in paths)
        change(config, pipeline["steps"])
        for path, values in zip(paths, (config, pipeline), strict=True):
            path.write_text(json.dumps(values))
        return folder

    return edit


def loaded(folder: Path, **options: Any) -> SaccadePolicy:
    return SaccadePolicy(SaccadeConfig(checkpoint=str(folder), num_threads=1, seed=7, **options))


def batch_of(names: tuple[str, ...] = ("front", "wrist"), state: str = "observation.state") -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    size = (1, 3, whole_checkpoints.HEIGHT, whole_checkpoints.WIDTH)
    frames = {
        f"observation.images.{name}": torch.randint(256, size, dtype=torch.uint8, generator=generator)
        for name in names
    }
    return {**frames, state: torch.linspace(-0.3, 0.3, 7)[None], "task": ["push"]}


def horizons(steps: int, chunk: int, valid: int | None = None) -> Edit:
    def change(config: dict[str, Any], pipeline: list[dict[str, Any]]) -> None:
        config.update(n_action_steps=steps, chunk_size=chunk)
        if valid is not None:
            pipeline[PACK]["config"]["valid_action_horizon"] = valid

    return change


@pytest.mark.parametrize(
    ("layout", "change", "options", "predicted", "executed"),
    [
        (N15, horizons(50, 50), {}, 16, 16),
        (N15, horizons(8, 16), {}, 16, 8),  # lerobot executes the last 8
        (N15, horizons(8, 16), {"n_action_steps": 3}, 16, 3),
        (N15, horizons(8, 8), {}, 8, 8),  # actions beyond chunk_size were not trained
        (N17, horizons(16, 16), {}, 16, 16),
        (N17, horizons(8, 16), {}, 8, 8),
        (N17, horizons(50, 50), {}, 40, 40),
        (N17, horizons(40, 40, valid=16), {}, 16, 16),  # lerobot executes all 40
    ],
)
def test_executed_actions(
    edited: Callable[[str, Edit], Path],
    layout: str,
    change: Edit,
    options: dict[str, Any],
    predicted: int,
    executed: int,
) -> None:
    policy = loaded(edited(layout, change), **options)
    batch = batch_of()
    chunks = [policy.policy.act(batch, seed=seed) for seed in (7, 8)]
    assert torch.equal(policy.predict_action_chunk(batch), chunks[0][:, :predicted])
    policy.reset()
    actions = [policy.select_action(batch) for _ in range(executed + 1)]
    expected = [*chunks[0][:, :executed].unbind(1), chunks[1][:, 0]]
    assert torch.equal(torch.stack(actions), torch.stack(expected))


def test_more_actions_than_were_trained(edited: Callable[[str, Edit], Path]) -> None:
    folder = edited(N17, horizons(40, 40, valid=16))
    with pytest.warns(UserWarning, match="n_action_steps: 40 asked for, but only the first 16"):
        policy = loaded(folder, n_action_steps=40)
    assert policy.predict_action_chunk(batch_of()).shape[1] == 16
    with pytest.raises(
        ValueError, match="n_action_steps: expected at most 40, the length of a chunk, got 41"
    ):
        loaded(folder, n_action_steps=41)


@pytest.mark.parametrize("steps", [0, "8", True])
def test_a_damaged_number_of_actions(edited: Callable[[str, Edit], Path], steps: Any) -> None:
    with pytest.raises(saccade.CheckpointError, match="n_action_steps"):
        loaded(edited(N15, lambda config, _: config.update(n_action_steps=steps)))


RENAMED = {
    "observation.images.hand": "observation.images.wrist",
    "observation.images.top": "observation.images.front",
    "observation.joints": "observation.state",
}


def test_keys_are_renamed_once(edited: Callable[[str, Edit], Path]) -> None:
    """By the checkpoint, by lerobot's program, or by both."""
    expected = loaded(whole_checkpoints.whole(N17)).predict_action_chunk(batch_of())
    folder = edited(N17, lambda _, steps: steps[0]["config"].update(rename_map=RENAMED))
    policy = loaded(folder)
    batch = batch_of(("top", "hand"), "observation.joints")
    assert torch.equal(policy.predict_action_chunk(batch), expected)
    before, _ = make_saccade_pre_post_processors(policy.config)
    before.steps[0] = RenameObservationsProcessorStep(rename_map=RENAMED)
    policy.reset()
    assert torch.equal(policy.predict_action_chunk(before(batch)), expected)
    other = loaded(folder, rename_map={"observation.images.first": "observation.images.top"})
    batch["observation.images.first"] = batch.pop("observation.images.top")
    assert torch.equal(other.predict_action_chunk(batch), expected)


def test_names_that_are_exchanged_are_refused(edited: Callable[[str, Edit], Path]) -> None:
    names = [f"observation.images.{name}" for name in ("front", "wrist")]
    swap = dict(zip(names, reversed(names), strict=True))
    folder = edited(N17, lambda _, steps: steps[0]["config"].update(rename_map=swap))
    with pytest.raises(ValueError, match=f"rename_map: .*{names[0]} to {names[1]} to {names[0]}"):
        loaded(folder)


def test_frames_of_any_size_and_whole_numbers() -> None:
    policy = loaded(whole_checkpoints.whole(N17))
    batch = batch_of()
    for name in ("front", "wrist"):
        frames = batch[f"observation.images.{name}"]
        batch[f"observation.images.{name}"] = frames.repeat_interleave(2, dim=-1)
    batch["observation.state"] = torch.arange(7)[None]
    chunk = policy.predict_action_chunk(batch)
    policy.reset()
    batch["observation.state"] = batch["observation.state"].float()
    assert torch.equal(policy.predict_action_chunk(batch), chunk)


def test_the_server_resizes_to_the_features_of_the_checkpoint(tmp_path: Path) -> None:
    policy = loaded(whole_checkpoints.whole(N17))
    size = (3, whole_checkpoints.HEIGHT, whole_checkpoints.WIDTH)
    found = {key: feature.shape for key, feature in policy.config.image_features.items()}
    assert found == dict.fromkeys(("observation.images.wrist", "observation.images.front"), size)
    policy.save_pretrained(tmp_path)
    # It is no option.
    assert json.loads((tmp_path / "config.json").read_text())["input_features"] == {}
    assert SaccadePolicy.from_pretrained(tmp_path).config.image_features == policy.config.image_features


def test_the_ramp_of_the_checkpoint(edited: Callable[[str, Edit], Path]) -> None:
    policy = loaded(edited(N17, lambda config, _: config.update(rtc_ramp_rate=2.5)))
    batch = batch_of()
    left_over = policy.predict_action_chunk(batch)[:, 3:9]
    policy.reset()
    chunk = policy.predict_action_chunk(batch, prev_chunk_left_over=left_over, inference_delay=1)
    rule = saccade.Chunking(overlap=6, frozen=1, ramp_rate=2.5, horizon=6)
    expected = policy.policy.act(batch, seed=7, previous_chunk=left_over, chunking=rule)
    assert torch.equal(chunk, expected)


def test_a_damaged_ramp(edited: Callable[[str, Edit], Path]) -> None:
    with pytest.raises(ValueError, match="ramp_rate: expected a finite number above 0, got 0"):
        loaded(edited(N17, lambda config, _: config.update(rtc_ramp_rate=0)))


def test_a_batch_of_other_processors_is_refused() -> None:
    policy = loaded(whole_checkpoints.whole(N17))
    with pytest.raises(ValueError, match="batch: expected observations as they are, got embodiment_id"):
        policy.select_action({**batch_of(), "embodiment_id": torch.tensor([10])})
