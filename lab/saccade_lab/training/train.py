"""Training the policy on demonstrations: flow matching on action chunks, in torch.

A run is a directory with ``training.pt`` (all that is needed to continue), the policy so far
(``config.json``, ``model.safetensors``, ``tokenizer.json``, ``experiment_cfg/metadata.json``),
``settings.json`` (settings and demonstrations), ``history.json`` and ``loss.png``. They are written about
once a minute, each under a temporary name that is then renamed, so that a run can be interrupted at any time
and continued. Every step draws its samples and noise from the seed and the number of the step, so that a
continued run gives the same weights as an uninterrupted one.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

import functools
import io
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from safetensors.torch import save as serialize
from torch import Tensor

from saccade._internal.files import sha256_of, write_atomically, write_json
from saccade._internal.small_files import read_json
from saccade.errors import InputError
from saccade_lab.files import changed
from saccade_lab.sim import demos
from saccade_lab.sim.allocator import keep_freed_memory
from saccade_lab.sim.settings import (
    CONFIG_FILE,
    EMBODIMENT,
    METADATA_FILE,
    TENSOR_FILE,
    PolicyConfig,
    SimulationConfig,
    statistics_of,
    vocabulary,
)
from saccade_lab.sim.tasks import ACTION_DIM, PROPRIO_DIM, find_task
from saccade_lab.training.batches import Batches, prompts_of
from saccade_lab.training.dataset import Samples, describe, load_samples
from saccade_lab.training.frozen import FrozenFeatures
from saccade_lab.training.graphs import CudaGraphs
from saccade_lab.training.history import plot_history
from saccade_lab.training.learner import Batch, Learner, new_learner
from saccade_lab.training.policy_files import PolicyFiles
from saccade_lab.training.settings import STATE_FILE as STATE_FILE
from saccade_lab.training.settings import TrainingSettings, features_name
from saccade_lab.training.sizes import small_configs

CHECKPOINT_SECONDS = 60.0
VALIDATION_FRAMES = 256
WARMUP_STEPS = 200
MAX_GRADIENT_NORM = 1.0
WEIGHT_DECAY = 0.01
BETAS = (0.9, 0.95)
TRAINING, VALIDATION = "training", "validation"  # names of the two parts of the samples
SMALLEST_DEVIATION = 1e-3  # metres; added where a position never changes


@dataclass
class Progress:
    """The state of a run, for a progress bar."""

    step: int
    steps: int
    loss: float
    validation_loss: float | None


@dataclass
class Run:
    """A training run in memory.

    Attributes:
        tensors: Those of the policy, in the memory of the learner's, so that they change with every step.
        average: Their averages, which are what is saved.
        graphs: On a GPU, what repeats ``gradients``.
    """

    settings: TrainingSettings
    config: PolicyFiles
    learner: Learner
    optimizer: torch.optim.Optimizer
    tensors: dict[str, Tensor]
    average: dict[str, Tensor]
    demonstrations: dict[str, Any]
    step: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    graphs: CudaGraphs | None = None


def policy_config(
    settings: TrainingSettings, recording: demos.RecordingSettings, tasks: list[str]
) -> PolicyConfig:
    """The config of the policy that a run trains, without statistics."""
    words = vocabulary([text for name in tasks for text in find_task(name).instructions])
    head, backbone = small_configs(
        settings,
        state_dim=PROPRIO_DIM,
        action_dim=ACTION_DIM,
        image_size=recording.image_size,
        patch_size=settings.patch_size,
        words=words,
    )
    return PolicyConfig(
        head=head,
        backbone=backbone,
        simulation=SimulationConfig(
            tasks=tuple(tasks),
            cameras=recording.cameras,
            image_size=recording.image_size,
            execute_steps=settings.execute_steps,
        ),
        words=words,
    )


def with_statistics(config: PolicyConfig, samples: Samples) -> PolicyConfig:
    """The config with the statistics of states and of valid actions."""
    valid = samples.mask[..., 0] > 0
    recorded = {"state": samples.state, "action": samples.actions[valid]}
    return replace(config, statistics={kind: statistics_of(values) for kind, values in recorded.items()})


def check_device(settings: TrainingSettings, device: str) -> None:
    """Refuses bfloat16 on another device than a CPU, where it was never tried.

    Raises:
        InputError: That is what is asked for.
    """
    if settings.dtype != "float32" and torch.device(device).type != "cpu":
        raise InputError(f"dtype: given {settings.dtype!r} with device {device!r}, expected 'float32'")


def new_run(
    settings: TrainingSettings, config: PolicyFiles, demonstrations: dict[str, Any], device: str = "cpu"
) -> Run:
    """A run before its first step; for ``demonstrations`` see ``dataset.describe``."""
    learner = new_learner(settings, config).to(device)
    matrices = [parameter for parameter in learner.parameters() if parameter.ndim >= 2]
    others = [parameter for parameter in learner.parameters() if parameter.ndim < 2]
    optimizer = torch.optim.AdamW(
        [{"params": matrices, "weight_decay": WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}],
        lr=settings.learning_rate,
        betas=BETAS,
        foreach=True,
    )
    tensors = learner.policy_tensors()
    average = {name: tensor.clone() for name, tensor in tensors.items()}
    run = Run(settings, config, learner, optimizer, tensors, average, demonstrations)
    if learner.backbone.device.type == "cuda":
        run.graphs = CudaGraphs(functools.partial(gradients, run))
    return run


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """Linear warm-up, then a half cosine to zero."""
    warmup = min(1.0, (step + 1) / WARMUP_STEPS)
    return settings.learning_rate * warmup * 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))


def gradients(run: Run, given: tuple[Batch, Tensor, Tensor]) -> dict[str, Tensor]:
    """The losses by name, of a batch with its noise and times; writes the gradients of their sum."""
    settings = run.settings
    with torch.autocast("cpu", torch.bfloat16, enabled=settings.dtype == "bfloat16"):
        losses = run.learner.losses(*given, run.average)
    weights = {"target_loss": settings.target_weight, "alignment_loss": settings.alignment_weight}
    total = losses["loss"]
    for name, weight in weights.items():
        if name in losses:
            total = total + weight * losses[name]
    # Set to zero, not to None: all CUDA graphs write into the same gradients, which the first call makes.
    run.optimizer.zero_grad(set_to_none=False)
    total.backward()
    return {name: loss.detach() for name, loss in losses.items()}


def train_step(run: Run, batch: Batch) -> dict[str, float]:
    """One optimiser step; returns the losses by name."""
    settings = run.settings
    for group in run.optimizer.param_groups:
        group["lr"] = learning_rate(settings, run.step)
    generator = torch.Generator().manual_seed(
        int(np.random.default_rng((settings.seed, run.step, 1)).integers(2**63))
    )
    given = (batch, *run.learner.draw_noise(batch, generator))
    losses = gradients(run, given) if run.graphs is None else run.graphs(given)
    torch.nn.utils.clip_grad_norm_(run.learner.parameters(), MAX_GRADIENT_NORM)
    run.optimizer.step()
    # A short memory at first, so that the initial weights do not dominate the average.
    decay = min(settings.ema_decay, (1 + run.step) / (10 + run.step))
    with torch.no_grad():
        averages = [run.average[name] for name in run.tensors]
        torch._foreach_lerp_(averages, list(run.tensors.values()), 1.0 - decay)
    run.step += 1
    return {name: loss.item() for name, loss in losses.items()}


@torch.no_grad()
def validation_losses(run: Run, batches: Batches) -> dict[str, float]:
    """The losses of the averaged weights, each time on the same held-out frames and noise."""
    current = {name: tensor.clone() for name, tensor in run.tensors.items()}
    run.learner.load_state_dict(run.average, strict=False)
    batch = batches.draw(0)
    noise, time = run.learner.draw_noise(batch, torch.Generator().manual_seed(0))
    losses = run.learner.losses(batch, noise, time, run.average)
    run.learner.load_state_dict(current, strict=False)
    return {name: loss.item() for name, loss in losses.items()}


def export(run: Run, out: Path) -> None:
    """Writes the averaged weights as a policy.

    They are stored as bfloat16, which halves the size. The rounding is far below the noise of training.
    """
    tensors = {name: tensor.cpu().to(torch.bfloat16).contiguous() for name, tensor in run.average.items()}
    with write_atomically(out / TENSOR_FILE) as temporary:
        temporary.write_bytes(serialize(tensors, metadata={"format": "pt"}))
    run.config.write(out)


def described(config: PolicyFiles) -> Any:
    """Config and statistics as they are read from JSON."""
    return json.loads(json.dumps([config.to_dict(), config.metadata()]))


def save(run: Run, out: Path) -> None:
    """Writes all files of the run."""
    out.mkdir(parents=True, exist_ok=True)
    state = {
        "settings": run.settings.to_dict(),
        "config": described(run.config),
        "step": run.step,
        "history": run.history,
        "learner": run.learner.state_dict(),
        "optimizer": run.optimizer.state_dict(),
        "average": run.average,
    }
    serialized = io.BytesIO()  # writing to a full disk itself, torch raises a RuntimeError
    torch.save(state, serialized)
    with write_atomically(out / STATE_FILE) as temporary:
        temporary.write_bytes(serialized.getbuffer())
    export(run, out)
    write_json(out / "settings.json", {**run.settings.to_dict(), "demonstrations": run.demonstrations})
    write_json(out / "history.json", run.history)
    plot_history(run.history, out / "loss.png")


def resume(run: Run, path: Path) -> None:
    """Continues a run from a saved state.

    Raises:
        InputError: It was started with other settings or other demonstrations.
    """
    device = run.learner.backbone.device
    state = torch.load(path, weights_only=True, map_location=device)
    settings = run.settings.to_dict()
    if state["settings"] != settings:
        other = ", ".join(changed(state["settings"], settings))
        raise InputError(f"{path}: the run was started with other settings ({other})")
    if state["config"] != described(run.config):
        raise InputError(f"{path}: the run was started with other demonstrations")
    run.step, run.history = state["step"], state["history"]
    run.learner.load_state_dict(state["learner"])
    run.optimizer.load_state_dict(state["optimizer"])
    for name, tensor in state["average"].items():
        run.average[name].copy_(tensor)


def config_of_start(config: PolicyConfig, policy: Path, only: str = "") -> PolicyConfig:
    """The config with the statistics of the policy to start from: its weights know no others.

    Raises:
        FileNotFoundError: There is no policy.
        CheckpointError: A file of the policy is damaged.
        InputError: The policy has other sizes, tasks or cameras. The head may have other sizes where it alone
            is trained.
    """
    found, statistics = (read_json(policy / name) for name in (CONFIG_FILE, METADATA_FILE))
    expected = described(config)[0]
    if only == "head":
        found, expected = (
            {key: one.get(key) for key in ("backbone_cfg", "simulation_cfg")} for one in (found, expected)
        )
    if found != expected:
        raise InputError(f"{policy}: was trained with other sizes, tasks or cameras")
    return replace(config, statistics=statistics[EMBODIMENT]["statistics"])


def start_from(run: Run, policy: Path) -> None:
    """Starts from the weights of a policy; from those of its backbone where only the head is trained."""
    prefix = "backbone." if run.settings.only == "head" else ""
    tensors = {
        name: tensor.float()
        for name, tensor in load_file(policy / TENSOR_FILE).items()
        if name.startswith(prefix)
    }
    run.learner.load_state_dict(tensors, strict=False)
    for name, tensor in run.tensors.items():
        run.average[name].copy_(tensor)


def features_of(samples: str, settings: TrainingSettings, recorded: dict[str, Any], out: Path) -> Path:
    """The file with the features of the training or validation frames; see ``FrozenFeatures``."""
    shown = f"{samples}-blind" if settings.blind else samples
    return out.parent / features_name(settings.start_sha256, recorded["sha256"], shown)


def train(
    demonstrations: Path,
    out: Path,
    settings: TrainingSettings,
    on_step: Callable[[Progress], None],
    *,
    start: Path | None = None,
    device: str = "cpu",
) -> PolicyConfig:
    """Trains a policy, or continues the run in ``out``. With glibc, the process then keeps freed memory.

    Args:
        demonstrations: Directory written by ``saccade demos``.
        out: Directory of the run.
        settings: Settings of the run.
        on_step: Called after each step.
        start: A policy to start from; None for random weights. Where only the head is trained, the features
            of its backbone are kept in files next to ``out``, for other runs.
        device: Torch's name of the device to train on. A seed draws the same samples and noise on each; sums
            are rounded in other ways.

    Returns:
        The config of the policy.

    Raises:
        FileNotFoundError: There are no demonstrations, or no policy to start from.
        InputError: Demonstrations with different settings, ``out`` contains a run with other settings, or the
            device does not have the dtype.
    """
    check_device(settings, device)
    if settings.only == "head" and start is None:
        raise InputError("start: given none, expected a policy, since only the head is trained")
    keep_freed_memory()
    tasks = demos.recorded_tasks(demonstrations)
    recording = demos.read_settings(demonstrations, tasks)
    config = policy_config(settings, recording, tasks)
    processor = config.processor()
    recorded = describe(demonstrations, tasks)
    if start is not None:
        settings = replace(settings, start_sha256=sha256_of(start / TENSOR_FILE))
    features = {name: features_of(name, settings, recorded, out) for name in (TRAINING, VALIDATION)}
    computed = settings.only == "head" and all(path.exists() for path in features.values())
    training, validation = load_samples(
        demonstrations,
        tasks,
        settings.horizon,
        None if computed else processor,
        num_threads=torch.get_num_threads(),
    )
    if settings.blind:
        training, validation = (
            replace(samples, images=np.zeros_like(samples.images)) for samples in (training, validation)
        )
    config = (
        with_statistics(config, training) if start is None else config_of_start(config, start, settings.only)
    )
    run = new_run(settings, config, recorded, device)
    if start is not None:
        start_from(run, start)
    fit(run, training, validation, out, on_step, features if settings.only == "head" else None)
    return config


def fit(
    run: Run,
    training: Samples,
    validation: Samples,
    out: Path,
    on_step: Callable[[Progress], None],
    features: Mapping[str, Path] | None = None,
) -> None:
    """Trains a new run, or continues the one in ``out``, and writes all files of the run.

    Args:
        run: The run before its first step.
        training, validation: The samples.
        out: Directory of the run.
        on_step: Called after each step.
        features: Where only the head is trained, the files of the features of both; see ``features_of``.

    Raises:
        InputError: ``out`` contains a run with other settings or other demonstrations.
    """
    if (out / STATE_FILE).exists():
        resume(run, out / STATE_FILE)
    settings, config = run.settings, run.config
    targets = (training.targets.mean(axis=0), training.targets.std(axis=0) + SMALLEST_DEVIATION)
    prompts = prompts_of(config, config.processor())

    def batches_of(samples: Samples, name: str, size: int, **changes: Any) -> Batches:
        frozen = None
        if features is not None:
            frozen = FrozenFeatures(samples, prompts, run.learner.backbone, features[name])
        return Batches(
            samples,
            config,
            run.learner.backbone,
            prompts,
            targets,
            size,
            **changes,
            frozen=frozen,
            with_later=settings.aligned_block is not None,
        )

    changes = {name: getattr(settings, name) for name in ("absent_share", "language_dropout", "shift")}
    batches = batches_of(training, TRAINING, settings.batch_size, **changes)
    held_out = batches_of(validation, VALIDATION, VALIDATION_FRAMES)
    try:
        loop(run, batches, held_out, out, on_step)
    finally:
        if run.step:
            save(run, out)


def loop(
    run: Run, batches: Batches, held_out: Batches, out: Path, on_step: Callable[[Progress], None]
) -> None:
    """Trains to the last step and saves about once a minute."""
    saved, steps = time.monotonic(), list[dict[str, float]]()
    latest: float | None = None
    settings = run.settings
    for step in range(run.step, settings.steps):
        steps.append(train_step(run, batches.draw(settings.seed, step)))
        means = {name: sum(losses[name] for losses in steps) / len(steps) for name in steps[0]}
        if time.monotonic() - saved > CHECKPOINT_SECONDS or run.step == settings.steps:
            held_out_losses = validation_losses(run, held_out)
            validation = {f"validation_{name}": loss for name, loss in held_out_losses.items()}
            run.history.append({"step": run.step, **means, **validation})
            save(run, out)
            latest = held_out_losses["loss"]
            saved, steps = time.monotonic(), []
        on_step(Progress(run.step, settings.steps, means["loss"], latest))
