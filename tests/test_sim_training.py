"""Demonstrations and training on tiny settings: resumable, and the same as if never stopped."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from training_cases import RECORDING, TASKS, TINY, ignore

from saccade import InputError
from saccade.backbone_inputs import BackboneInputs
from saccade.cli import main
from saccade.processor import Processor
from saccade.sim import demos, train
from saccade.sim.dataset import chunks, describe, later_frames, load_samples, prepared
from saccade.sim.learner import Learner, new_learner, pool_tokens
from saccade.sim.policy import DEMO_CHECKPOINT, Policy
from saccade.sim.tasks import DEMONSTRATION_SEEDS
from saccade.sim.training_settings import TrainingSettings

ALIGNED = dataclasses.replace(TINY, alignment_weight=0.2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations of two tasks."""
    out = tmp_path_factory.mktemp("demos")
    for task in TASKS:
        demos.record_task(task, 2, out, RECORDING, lambda: None)
    return out


def processor_of(settings: TrainingSettings) -> Processor:
    """The processor of the policy that a run trains."""
    return train.policy_config(settings, RECORDING, TASKS).processor()


def test_recording_holds_what_it_says(recording: Path) -> None:
    for task in TASKS:
        found = list(demos.episodes(recording, task))
        assert [seed for seed, _ in found] == sorted(seed for seed, _ in found)
        for seed, demonstration in found:
            assert seed in DEMONSTRATION_SEEDS
            frames, steps = len(demonstration.images), len(demonstration.actions)
            assert demonstration.images.shape == (frames, 2, 16, 16, 3)
            assert demonstration.images.dtype == np.uint8
            assert demonstration.proprio.shape == (frames, 4)
            assert demonstration.targets.shape == (frames, 6)
            assert demonstration.disturbed.shape == (steps,)
            assert np.abs(demonstration.actions).max() <= 1.0
            np.testing.assert_array_equal(demonstration.frame_steps, np.arange(0, steps, 6))


def test_recording_goes_on_where_it_stopped(recording: Path, tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    def stop() -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        demos.record_task("reach", 2, tmp_path, RECORDING, stop)
    first = sorted((tmp_path / "reach").glob("*.npz"))
    written = first[0].stat().st_mtime_ns
    assert len(first) == 1
    episodes = []
    demos.record_task("reach", 2, tmp_path, RECORDING, lambda: episodes.append(1))
    assert len(episodes) == 2
    assert first[0].stat().st_mtime_ns == written
    both = zip(demos.episodes(recording, "reach"), demos.episodes(tmp_path, "reach"), strict=True)
    for (seed, whole), (other_seed, resumed) in both:
        assert seed == other_seed
        np.testing.assert_array_equal(whole.images, resumed.images)
        np.testing.assert_array_equal(whole.actions, resumed.actions)
    assert not list(tmp_path.rglob(".*"))


def test_what_was_recorded_earlier_counts_for_the_expert(tmp_path: Path) -> None:
    """Only seeds at which the expert failed are tried again: they alone would look as if it always failed."""
    first = DEMONSTRATION_SEEDS[0]
    for seed in range(first, first + 60, 2):
        (tmp_path / f"{seed}.npz").touch()
    seeds = demos.Seeds("push", 60, tmp_path)
    missing = seeds.next_seeds(lambda: None)
    assert missing[:30] == list(range(first + 1, first + 60, 2))
    assert (seeds.done, len(missing)) == (30, 30)
    for seed in missing[:30]:
        seeds.outcomes[seed] = False
        seeds.check()
    alone = demos.Seeds("push", 60, tmp_path / "empty")
    for seed in alone.next_seeds(lambda: None)[:20]:
        alone.outcomes[seed] = False
    with pytest.raises(InputError, match="the expert failed in 20 of 20 episodes"):
        alone.check()


def test_recording_with_other_settings_is_refused(recording: Path) -> None:
    other = demos.RecordingSettings(image_size=24, cameras=RECORDING.cameras)
    with pytest.raises(InputError, match="other settings"):
        demos.record_task("reach", 3, recording, other, lambda: None)


def test_chunks_stop_counting_after_a_disturbance_and_at_the_end() -> None:
    steps = 8
    disturbed = np.zeros(steps, dtype=np.bool_)
    disturbed[3] = True
    demonstration = demos.Demonstration(
        images=np.zeros((3, 1, 8, 8, 3), np.uint8),
        proprio=np.zeros((3, 4), np.float32),
        targets=np.zeros((3, 6), np.float32),
        frame_steps=np.array([0, 3, 6], np.int32),
        actions=np.arange(1, 4 * steps + 1, dtype=np.float32).reshape(steps, 4),
        disturbed=disturbed,
    )
    actions, mask = chunks(demonstration, 5)
    assert mask[..., 0].astype(int).tolist() == [[1, 1, 1, 1, 0], [1, 0, 0, 0, 0], [1, 1, 0, 0, 0]]
    np.testing.assert_array_equal(actions[0, :4], demonstration.actions[:4])
    np.testing.assert_array_equal(actions * (1 - mask), 0.0)


def test_held_out_samples_come_from_demonstrations_of_their_own(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("saccade.sim.dataset.VALIDATION_EVERY", 2)
    training, held_out = load_samples(recording, TASKS, 4, processor_of(TINY))
    seeds = [demonstration.proprio[0] for _, demonstration in demos.episodes(recording, "reach")]
    assert len(seeds) == 2
    assert set(map(tuple, training.targets)).isdisjoint(map(tuple, held_out.targets))
    assert set(training.tasks) == set(held_out.tasks)


@pytest.mark.parametrize("settings", [TINY, ALIGNED], ids=["plain", "aligned"])
def test_training_resumes_to_the_same_weights(
    recording: Path, tmp_path: Path, settings: TrainingSettings
) -> None:
    def interrupt(progress: train.Progress) -> None:
        if progress.step == 3:
            raise KeyboardInterrupt

    torch.set_num_threads(1)
    train.train(recording, tmp_path / "whole", settings, ignore)
    with pytest.raises(KeyboardInterrupt):
        train.train(recording, tmp_path / "parts", settings, interrupt)
    stopped = load_file(tmp_path / "parts" / "model.safetensors")
    train.train(recording, tmp_path / "parts", settings, ignore)
    whole, parts = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    for name, tensor in whole.items():
        assert tensor.dtype == torch.bfloat16
        assert torch.equal(tensor, parts[name]), name
    assert any(not torch.equal(stopped[name], whole[name]) for name in whole)
    ends = [torch.load(tmp_path / name / "training.pt", weights_only=True) for name in ("whole", "parts")]
    for name, tensor in ends[0]["learner"].items():  # including what is trained besides the policy
        assert torch.equal(tensor, ends[1]["learner"][name]), name


def test_training_leaves_a_policy_both_engines_run(recording: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    train.train(recording, tmp_path, TINY, ignore)
    assert {path.name for path in tmp_path.iterdir()} == {
        "config.json",
        "experiment_cfg",
        "model.safetensors",
        "tokenizer.json",
        "training.pt",
        "settings.json",
        "history.json",
        "loss.png",
    }
    history = json.loads((tmp_path / "history.json").read_text())
    assert history[-1]["step"] == TINY.steps
    settings = json.loads((tmp_path / "settings.json").read_text())
    assert settings.pop("demonstrations")["tasks"] == dict.fromkeys(TASKS, 2)
    assert TrainingSettings(**settings) == TINY
    rust, other = (Policy.load(tmp_path, engine=engine, num_threads=1) for engine in ("rust", "torch"))
    assert rust.config.tasks == tuple(TASKS)
    images = {
        camera.name: np.full((16, 16, 3), 30 * number, np.uint8)
        for number, camera in enumerate(RECORDING.cameras)
    }
    observation = {"images": images, "proprio": np.zeros(4), "instruction": "press the button"}
    noise = rust.noise(np.random.default_rng(0))
    np.testing.assert_allclose(
        rust.act(observation, noise=noise).actions, other.act(observation, noise=noise).actions, atol=1e-4
    )


def test_padding_changes_no_gradient(recording: Path) -> None:
    """Prompts of different lengths in a batch train as they do alone, which is how they are run."""
    run, batches = make_batches(recording, dataclasses.replace(TINY, batch_size=6), with_later=False)
    run.learner.double()
    batch = batches.draw(0)
    assert isinstance(batch.inputs, BackboneInputs)
    lengths = batch.inputs.attention_mask.sum(axis=1)
    assert len(set(lengths)) > 1
    features = run.learner.backbone(batch.inputs).backbone_features
    views = len(RECORDING.cameras)
    for row, length in enumerate(lengths):
        pixels = batch.inputs.pixel_values
        assert isinstance(pixels, np.ndarray)
        alone = BackboneInputs(
            pixels[row * views : (row + 1) * views], batch.inputs.input_ids[row : row + 1, -length:]
        )
        expected = run.learner.backbone(alone).backbone_features[0]
        torch.testing.assert_close(features[row, -length:], expected)


def test_a_run_with_other_settings_is_refused(recording: Path, tmp_path: Path) -> None:
    train.train(recording, tmp_path, TINY, ignore)
    before = {path.name: path.read_bytes() for path in tmp_path.rglob("*.*")}
    other = TrainingSettings(**{**vars(TINY), "seed": 1, "batch_size": 3})
    with pytest.raises(InputError, match=r"other settings \(batch_size, seed\)"):
        train.train(recording, tmp_path, other, ignore)
    assert {path.name: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.parametrize("size", [0, 7])
def test_patches_that_cannot_be_halved_are_refused(size: int) -> None:
    with pytest.raises(InputError, match=f"patch_size: given {size}, expected an even number"):
        TrainingSettings(patch_size=size)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 12}, "width: given 12, expected a multiple of 8"),
        ({"num_heads": 3, "width": 96}, "num_heads: given 3, expected 1 or an even number"),
        ({"vision_width": 100}, "vision_width: given 100, expected a multiple of vision_heads 3"),
    ],
)
def test_sizes_that_cannot_be_loaded_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrainingSettings(**wrong)


@pytest.mark.parametrize(("size", "patch", "view"), [(68, 16, 64), (64, 16, 64), (64, 8, 64), (16, 32, 32)])
def test_the_tower_sees_whole_patches(size: int, patch: int, view: int) -> None:
    """Preprocessing crops to 95 % and resizes to the nearest size that patches divide."""
    settings = dataclasses.replace(TINY, patch_size=patch)
    config = train.policy_config(settings, dataclasses.replace(RECORDING, image_size=size), TASKS)
    assert config.processor().image_size == view
    assert config.processor().tokens_per_view == (view // patch) ** 2


def test_frames_are_prepared_as_the_policy_prepares_them() -> None:
    """At 68 pixels the crop is all that is done; against a slice of the frame."""
    config = train.policy_config(TINY, dataclasses.replace(RECORDING, image_size=68), TASKS)
    images = np.random.default_rng(0).integers(256, size=(2, 3, 68, 68, 3), dtype=np.uint8)
    found = prepared(images, config.processor())
    expected = images[:, :, 2:66, 2:66].transpose(0, 1, 4, 2, 3)
    assert found.dtype == np.uint8
    # Isaac-GR00T truncates after it has divided and multiplied by 255.
    assert np.abs(found.astype(int) - expected.astype(int)).max() <= 1
    processed = config.processor()(list(images[0]), "reach the green ball").pixel_values
    np.testing.assert_array_equal((found[0].astype(np.float32) - 127.5) / 127.5, processed)


def test_learning_rate_warms_up_and_falls_to_zero() -> None:
    settings = TrainingSettings(steps=1000)
    rates = [train.learning_rate(settings, step) for step in range(1000)]
    assert rates[0] < 0.01 * settings.learning_rate
    assert max(rates) <= settings.learning_rate
    assert np.argmax(rates) == train.WARMUP_STEPS - 1
    assert rates[-1] < 1e-4 * settings.learning_rate


def test_training_starts_from_a_policy(recording: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train.train(recording, first, TINY, ignore)
    settings = TrainingSettings(**{**vars(TINY), "steps": 2, "learning_rate": 1e-9, "absent_share": 0.5})
    train.train(recording, second, settings, ignore, start=first)
    tensors = load_file(second / "model.safetensors")
    for name, tensor in load_file(first / "model.safetensors").items():
        torch.testing.assert_close(tensors[name], tensor)
    with pytest.raises(InputError, match=r"other settings \(start_sha256\)"):
        train.train(recording, second, settings, ignore)


def test_a_policy_of_other_sizes_cannot_be_started_from(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="other sizes, tasks or cameras"):
        train.train(recording, tmp_path / "out", TINY, ignore, start=DEMO_CHECKPOINT)
    with pytest.raises(FileNotFoundError):
        train.train(recording, tmp_path / "out", TINY, ignore, start=tmp_path / "nowhere")
    assert not (tmp_path / "out").exists()


def make_batches(
    recording: Path, settings: TrainingSettings, *, with_later: bool = True
) -> tuple[train.Run, train.Batches]:
    """A run before its first step, and what it draws from."""
    config = train.policy_config(settings, RECORDING, TASKS)
    samples, _ = load_samples(recording, TASKS, settings.horizon, config.processor())
    config = train.with_statistics(config, samples)
    run = train.new_run(settings, config, describe(recording, TASKS))
    targets = samples.targets.mean(axis=0), samples.targets.std(axis=0) + np.float32(1e-3)
    batches = train.Batches(
        samples,
        config,
        train.prompts_of(config, config.processor()),
        targets,
        settings.batch_size,
        absent_share=settings.absent_share,
        with_later=with_later,
    )
    return run, batches


def test_later_frames_are_the_next_ones_recorded_a_horizon_on() -> None:
    steps = np.array([0, 3, 6, 9, 12, 15], np.int32)
    demonstration = demos.Demonstration(
        images=np.zeros((len(steps), 1, 8, 8, 3), np.uint8),
        proprio=np.zeros((len(steps), 4), np.float32),
        targets=np.zeros((len(steps), 6), np.float32),
        frame_steps=steps,
        actions=np.zeros((17, 4), np.float32),
        disturbed=np.zeros(17, np.bool_),
    )
    assert later_frames(demonstration, 6).tolist() == [2, 3, 4, 5, 5, 5]  # exactly there, then the last one
    assert later_frames(demonstration, 7).tolist() == [3, 4, 5, 5, 5, 5]  # the first one after
    assert later_frames(demonstration, 40).tolist() == [5, 5, 5, 5, 5, 5]


def test_samples_point_at_their_own_demonstrations_pictures(recording: Path) -> None:
    horizon = 16
    processor = processor_of(TINY)
    samples, _ = load_samples(recording, TASKS, horizon, processor)
    row, first = 0, 0
    for task in TASKS:
        for _, demonstration in demos.episodes(recording, task):
            valid = chunks(demonstration, horizon)[1].sum(axis=(1, 2))
            images = prepared(demonstration.images, processor)
            for frame, step in enumerate(demonstration.frame_steps):
                if valid[frame] < 4:
                    continue  # no sample, but its picture is kept: it may be what another one leads to
                np.testing.assert_array_equal(samples.images[samples.now[row]], images[frame])
                after = [n for n, other in enumerate(demonstration.frame_steps) if other >= step + horizon]
                expected = after[0] if after else len(demonstration.images) - 1
                assert samples.later[row] == first + expected
                np.testing.assert_array_equal(samples.images[samples.later[row]], images[expected])
                row += 1
            first += len(demonstration.images)
    assert row == len(samples)
    assert first == len(samples.images)


def test_who_is_told_to_stand_still_sees_the_same_later(recording: Path) -> None:
    _, batches = make_batches(recording, dataclasses.replace(ALIGNED, absent_share=1.0))
    batch = batches.draw(0)
    assert isinstance(batch.inputs, BackboneInputs)
    assert isinstance(batch.later, BackboneInputs)
    np.testing.assert_array_equal(batch.later.pixel_values, batch.inputs.pixel_values)
    _, batches = make_batches(recording, dataclasses.replace(ALIGNED, batch_size=8))
    batch = batches.draw(0)
    assert isinstance(batch.inputs, BackboneInputs)
    assert isinstance(batch.later, BackboneInputs)
    assert not np.array_equal(batch.later.pixel_values, batch.inputs.pixel_values)


def test_pooling_means_runs_of_neighbours() -> None:
    tokens = torch.randn(2, 7, 5, generator=torch.Generator().manual_seed(0))
    for count in (1, 3, 7):
        runs = [
            tokens[:, i * 7 // count : -(-(i + 1) * 7 // count)].mean(dim=1) for i in range(count)
        ]  # the bounds that torch documents
        torch.testing.assert_close(pool_tokens(tokens, count), torch.stack(runs, dim=1))
    assert pool_tokens(tokens, 9).shape == (2, 9, 5)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_runs_of_one_seed_differ_in_their_tokens_only(weight: float) -> None:
    def initial(count: int, seed: int = 5) -> dict[str, torch.Tensor]:
        settings = dataclasses.replace(
            TINY, num_future_tokens=count, seed=seed, alignment_weight=weight if count else 0.0
        )
        run = train.new_run(settings, train.policy_config(settings, RECORDING, TASKS), {})
        assert all(torch.equal(run.average[name], run.learner.state_dict()[name]) for name in run.average)
        return run.learner.state_dict()

    tokens = "action_head.future_tokens.weight"
    settings = dataclasses.replace(TINY, num_future_tokens=32, seed=5, alignment_weight=weight)
    config = train.policy_config(settings, RECORDING, TASKS)
    torch.manual_seed(5)
    shared = Learner(config.backbone_sizes, config.head_config, settings.aligned_block).state_dict()
    for count in (0, 1, 4, 32, 33, 64):
        found = initial(count)
        assert found[tokens].shape == (count, TINY.width)
        assert torch.equal(found[tokens][:32], shared[tokens][:count])
        for name in found.keys() - {tokens}:
            assert torch.equal(found[name], shared[name]), (count, name)
        assert found.keys() == {name for name in shared if count or not name.startswith("projector.")}
    rows = initial(64)[tokens]
    assert torch.equal(initial(40)[tokens], rows[:40])
    assert len(torch.unique(rows, dim=0)) == 64
    assert 0.015 < float(rows[32:].std()) < 0.025
    assert not torch.equal(initial(64, seed=6)[tokens][32:], rows[32:])


def test_alignment_loss_is_one_minus_the_cosine_of_the_future_rows(recording: Path) -> None:
    run, batches = make_batches(recording, dataclasses.replace(ALIGNED, batch_size=3))
    with torch.no_grad():
        for tensor in run.average.values():  # so that the averaged backbone is not the current one
            tensor.add_(0.05 * torch.randn(tensor.shape, generator=torch.Generator().manual_seed(1)))
    batch = batches.draw(0)
    rows: list[torch.Tensor] = []
    handle = run.learner.action_head.model.transformer_blocks[0].register_forward_hook(
        lambda module, inputs, output: rows.append(output)
    )
    losses = run.learner.losses(batch, torch.Generator().manual_seed(0), run.average)
    handle.remove()
    losses["alignment_loss"].backward()

    other = Learner(run.config.backbone_sizes, run.config.head_config)
    other.load_state_dict(run.average, strict=False)
    with torch.no_grad():
        assert batch.later is not None
        seen = other.backbone(batch.later)
        image_tokens = seen.backbone_features[seen.image_mask].reshape(3, -1, TINY.width)
        projected = run.learner.projector(rows[0][:, 1:4])
        targets = F.adaptive_avg_pool1d(image_tokens.mT, 3).mT
        cosines = (projected * targets).sum(-1) / (projected.norm(dim=-1) * targets.norm(dim=-1))
    assert cosines.shape == (3, 3)
    torch.testing.assert_close(losses["alignment_loss"].detach(), 1 - cosines.mean())

    tokens = run.learner.action_head.future_tokens.weight
    assert tokens.grad is not None
    assert bool((tokens.grad.abs().sum(dim=1) > 0).all())
    decoder = run.learner.action_head.get_submodule("action_decoder")
    # Only the first block comes before the rows, and the targets' side must not move.
    assert all(parameter.grad is None for parameter in decoder.parameters())
    assert all(tensor.grad is None and not tensor.requires_grad for tensor in run.average.values())


def test_alignment_loss_falls_and_is_reported(recording: Path, tmp_path: Path) -> None:
    settings = dataclasses.replace(ALIGNED, steps=40, batch_size=4, learning_rate=5e-3)
    torch.set_num_threads(1)
    run, batches = make_batches(recording, settings)
    first = train.validation_losses(run, batches)["alignment_loss"]
    train.train(recording, tmp_path, settings, ignore)
    last = json.loads((tmp_path / "history.json").read_text())[-1]
    assert last["validation_alignment_loss"] < 0.7 * first
    assert last["alignment_loss"] < first
    state = torch.load(tmp_path / "training.pt", weights_only=True)["learner"]
    assert any(name.startswith("projector.") for name in state)
    stored = load_file(tmp_path / "model.safetensors")
    assert {name.split(".")[0] for name in stored} == {"backbone", "action_head"}


def test_alignment_block_is_the_middle_one_or_as_said() -> None:
    found = [TrainingSettings(num_layers=n, alignment_weight=1).aligned_block for n in (1, 2, 4, 16)]
    assert found == [0, 0, 1, 7]
    assert TrainingSettings(alignment_weight=1, alignment_block=3).aligned_block == 3
    assert TrainingSettings(alignment_block=3).aligned_block is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_future_tokens": 0, "alignment_weight": 0.2}, "expected 0 with num_future_tokens 0"),
        ({"alignment_weight": -0.1}, "given -0.1, expected at least 0"),
        ({"alignment_weight": float("nan")}, "given nan"),
        ({"alignment_weight": 0.2, "alignment_block": 4}, "given 4, expected 0 to 3"),
    ],
)
def test_alignment_that_cannot_be_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrainingSettings(**wrong)


def test_without_alignment_steps_are_those_of_the_two_losses(recording: Path) -> None:
    """Bit for bit, against the steps written out here: nothing of the alignment may take part."""
    torch.set_num_threads(1)
    settings = dataclasses.replace(TINY, absent_share=0.5)
    run, batches = make_batches(recording, settings, with_later=False)
    assert not any(name.startswith("projector") for name in run.learner.state_dict())
    other, _ = make_batches(recording, ALIGNED)  # the same start, with and without
    for name, tensor in run.learner.state_dict().items():
        assert torch.equal(tensor, other.learner.state_dict()[name]), name

    learner = new_learner(settings, run.config)
    optimizer = torch.optim.AdamW(
        [
            {"params": [p for p in learner.parameters() if p.ndim >= 2], "weight_decay": 0.01},
            {"params": [p for p in learner.parameters() if p.ndim < 2], "weight_decay": 0.0},
        ],
        betas=(0.9, 0.95),
    )
    for step in range(3):
        found = train.train_step(run, batches)
        assert found.keys() == {"loss", "target_loss"}
        batch = batches.draw(settings.seed, step)
        assert batch.later is None
        for group in optimizer.param_groups:
            group["lr"] = train.learning_rate(settings, step)
        seed = np.random.default_rng((settings.seed, step, 1)).integers(2**63)
        generator = torch.Generator().manual_seed(int(seed))
        features = learner.backbone(batch.inputs).backbone_features
        noise = torch.randn(batch.actions.shape, generator=generator)
        time = learner.action_head.sample_time(len(noise), generator)
        flow = learner.action_head.loss(
            features,
            batch.state,
            0,
            batch.actions,
            noise=noise,
            time=time,
            action_mask=batch.mask,
            drop_vl=~torch.from_numpy(batch.inputs.attention_mask),
        )
        positions = F.mse_loss(learner.target_head(features[:, -1]), batch.targets)
        optimizer.zero_grad()
        (flow + settings.target_weight * positions).backward()
        torch.nn.utils.clip_grad_norm_(learner.parameters(), 1.0)
        optimizer.step()
        assert found == {"loss": flow.item(), "target_loss": positions.item()}
    for name, tensor in learner.state_dict().items():
        assert torch.equal(tensor, run.learner.state_dict()[name]), name


def test_description_tells_recordings_apart(recording: Path, tmp_path: Path) -> None:
    whole = describe(recording, TASKS)
    assert whole["tasks"] == dict.fromkeys(TASKS, 2)
    shutil.copytree(recording, tmp_path / "copy")
    assert describe(tmp_path / "copy", TASKS) == whole
    next((tmp_path / "copy" / "reach").glob("*.npz")).unlink()
    fewer = describe(tmp_path / "copy", TASKS)
    assert fewer["tasks"] == {"reach": 1, "button-press-topdown": 2}
    assert fewer["sha256"] != whole["sha256"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--alignment-weight", "0.2", "--num-future-tokens", "0"], "there is no row to align"),
        (["--alignment-weight", "-1"], "--alignment-weight: given -1.0, expected at least 0"),
        (["--alignment-weight", "inf"], "--alignment-weight: given inf"),
    ],
)
def test_the_command_refuses_alignment_that_cannot_be(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    out = tmp_path / "out"
    assert main(["train", "--demos", str(recording), "--out", str(out), *options]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()
