"""Training the policy on demonstrations: flow matching on action chunks, in torch, on the CPU.

A run lives in a directory: `training.pt` (all that is needed to go on), `config.json` and `model.safetensors`
(the policy so far), `settings.json` (how and on what it is trained), `history.json` and `loss.png`. They are
written about once a minute, each under a temporary name that is then renamed, so a run can be stopped at any
time and goes on where it was. Every step draws its samples and noise from the seed and its own number, so a
resumed run gives what an uninterrupted one gives.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

import io
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from safetensors.torch import save as serialize
from torch import Tensor

from saccade._files import sha256_of, write_atomically, write_json
from saccade.config import HeadConfig
from saccade.errors import InputError
from saccade.sim import demos
from saccade.sim.backbone import BackboneConfig
from saccade.sim.dataset import Samples, describe, load_samples, statistics
from saccade.sim.instructions import Tokenizer, build_vocabulary, words
from saccade.sim.learner import Learner
from saccade.sim.settings import CONFIG_FILE, TENSOR_FILE, PolicyConfig, Statistics, head_config
from saccade.sim.tasks import ACTION_DIM, PROPRIO_DIM, TASKS, find_task

STATE_FILE = "training.pt"
CHECKPOINT_SECONDS = 60.0
VALIDATION_FRAMES = 256
WARMUP_STEPS = 200
MAX_GRADIENT_NORM = 1.0
WEIGHT_DECAY = 0.01
BETAS = (0.9, 0.95)


@dataclass(frozen=True)
class TrainingSettings:
    """What a run depends on besides the demonstrations.

    Attributes:
        steps: Optimiser steps; the learning rate falls to zero over them.
        batch_size: Frames per step. More small steps beat fewer large ones at equal time.
        learning_rate: Of AdamW, after the warm-up.
        ema_decay: Of the averaged weights, which are the ones that are kept.
        target_weight: Weight of the loss that finds object and goal.
        alignment_weight: Weight of the loss that pulls the hidden rows of the future tokens towards what the
            averaged backbone says of the observation one horizon later; as in FLARE, which used 0.2.
        alignment_block: Block of the head after which those rows are taken. Default the middle one: as many
            blocks for the rows to read the pictures as for the actions to read the rows.
        absent_share: Share of frames that are told a task whose object is not there, and shown to stand
            still. Without them the pictures alone tell most tasks apart, and their words go unread.
        start_sha256: Of the tensors that it starts from; empty for random ones. `train` sets it.
        seed: Of initial weights, order and noise.
        width, num_layers, num_heads: Of the head; the backbone has its width and heads.
        backbone_layers: Transformer blocks of the backbone.
        vl_num_layers: Of the head's VL self-attention.
        num_future_tokens: N.
        horizon: Actions per chunk.
        execute_steps: Of them carried out before the next look.
        num_steps: Euler steps at run time.
        patch_size: Pixels along each side of an image token's patch.
    """

    steps: int = 8000
    batch_size: int = 16
    learning_rate: float = 6e-4
    ema_decay: float = 0.999
    target_weight: float = 1.0
    alignment_weight: float = 0.0
    alignment_block: int | None = None
    absent_share: float = 0.0
    start_sha256: str = ""
    seed: int = 0
    width: int = 128
    num_layers: int = 4
    num_heads: int = 4
    backbone_layers: int = 2
    vl_num_layers: int = 1
    num_future_tokens: int = 32
    horizon: int = 16
    execute_steps: int = 8
    num_steps: int = 4
    patch_size: int = 16

    def __post_init__(self) -> None:
        if not 0 <= self.alignment_weight < math.inf:
            raise InputError(f"alignment_weight: given {self.alignment_weight}, expected at least 0")
        if self.alignment_weight and self.num_future_tokens == 0:
            raise InputError(
                f"alignment_weight: given {self.alignment_weight}, expected 0 with num_future_tokens 0: "
                "there is no row to align"
            )
        if self.alignment_block is not None and not 0 <= self.alignment_block < self.num_layers:
            raise InputError(
                f"alignment_block: given {self.alignment_block}, expected 0 to {self.num_layers - 1}"
            )

    @property
    def aligned_block(self) -> int | None:
        """The block whose future rows are aligned; None if none are."""
        if self.alignment_weight == 0:
            return None
        return (self.num_layers - 1) // 2 if self.alignment_block is None else self.alignment_block


@dataclass
class Progress:
    """Where a run is, for a progress bar."""

    step: int
    steps: int
    loss: float
    target_loss: float
    validation_loss: float | None


@dataclass
class Run:
    """A training run in memory."""

    settings: TrainingSettings
    config: PolicyConfig
    learner: Learner
    optimizer: torch.optim.Optimizer
    average: dict[str, Tensor]
    demonstrations: dict[str, Any]
    step: int = 0
    history: list[dict[str, float]] = field(default_factory=list)


def policy_config(
    settings: TrainingSettings,
    recording: demos.RecordingSettings,
    tasks: list[str],
    found: dict[str, Statistics],
) -> PolicyConfig:
    """The config of the policy that a run trains."""
    instructions = [text for name in tasks for text in find_task(name).instructions]
    vocabulary = build_vocabulary(instructions)
    config = PolicyConfig(
        head=head_config(
            width=settings.width,
            num_layers=settings.num_layers,
            num_heads=settings.num_heads,
            vl_num_layers=settings.vl_num_layers,
            num_future_tokens=settings.num_future_tokens,
            horizon=settings.horizon,
            num_steps=settings.num_steps,
            state_dim=PROPRIO_DIM,
            action_dim=ACTION_DIM,
        ),
        backbone=BackboneConfig(
            width=settings.width,
            num_layers=settings.backbone_layers,
            num_heads=settings.num_heads,
            image_size=recording.image_size,
            patch_size=settings.patch_size,
            num_cameras=len(recording.cameras),
            text_length=max(len(words(text)) for text in instructions),
            vocabulary_size=len(vocabulary),
        ),
        cameras=recording.cameras,
        vocabulary=vocabulary,
        execute_steps=settings.execute_steps,
        tasks=tuple(tasks),
        state=found["state"],
        action=found["action"],
    )
    config.check()
    return config


def new_run(settings: TrainingSettings, config: PolicyConfig, demonstrations: dict[str, Any]) -> Run:
    """A run before its first step; `demonstrations` says what it trains on, see `dataset.describe`."""
    torch.manual_seed(settings.seed)
    learner = Learner(config.backbone, HeadConfig.from_dict(config.head), settings.aligned_block)
    matrices = [parameter for parameter in learner.parameters() if parameter.ndim >= 2]
    others = [parameter for parameter in learner.parameters() if parameter.ndim < 2]
    optimizer = torch.optim.AdamW(
        [{"params": matrices, "weight_decay": WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}],
        lr=settings.learning_rate,
        betas=BETAS,
        foreach=True,
    )
    average = {name: tensor.detach().clone() for name, tensor in learner.policy_tensors().items()}
    return Run(settings, config, learner, optimizer, average, demonstrations)


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """Linear warm-up, then half a cosine down to zero."""
    warmup = min(1.0, (step + 1) / WARMUP_STEPS)
    return settings.learning_rate * warmup * 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))


class Batches:
    """Draws normalised batches.

    Args:
        samples: what to draw from.
        config: for statistics and vocabulary.
        target_statistics: of the positions.
        batch_size: frames per batch.
        absent_share: see `TrainingSettings`.
        with_later: whether batches have the images seen when the chunk has been carried out.
    """

    def __init__(
        self,
        samples: Samples,
        config: PolicyConfig,
        target_statistics: Statistics,
        batch_size: int,
        absent_share: float = 0.0,
        with_later: bool = False,
    ) -> None:
        self._samples = samples
        self._with_later = with_later
        self._batch_size = batch_size
        self._absent_share = absent_share
        self._state = config.state.normalize(samples.state)
        self._actions = config.action.normalize(samples.actions) * samples.mask
        self._targets = target_statistics.normalize(samples.targets)
        tokenizer = Tokenizer(config.vocabulary, config.backbone.text_length)
        self._wordings = [
            np.stack([tokenizer(text) for text in task.instructions]) for task in TASKS.values()
        ]  # per task (wordings, text_length)
        known = [list(TASKS).index(name) for name in config.tasks]
        self._impossible = [
            [other for other in known if list(TASKS.values())[other].objects != task.objects]
            for task in TASKS.values()
        ]  # per task, the tasks that cannot be done in its scene
        self._still = config.action.normalize(np.zeros(samples.actions.shape[1:], np.float32))

    def draw(self, *key: int) -> dict[str, Tensor]:
        """The batch that belongs to `key`, with a wording drawn anew for each frame."""
        rng = np.random.default_rng(key)
        rows = rng.integers(len(self._samples), size=self._batch_size)
        tasks, later = self._samples.tasks[rows], self._samples.later[rows]
        actions, mask = self._actions[rows], self._samples.mask[rows]
        for row in np.flatnonzero(rng.random(len(rows)) < self._absent_share):
            if self._impossible[tasks[row]]:
                tasks[row] = rng.choice(self._impossible[tasks[row]])
                actions[row], mask[row] = self._still, 1.0
                later[row] = self._samples.now[rows[row]]
        said = [self._wordings[task] for task in tasks]
        arrays = {
            "images": self._samples.images[self._samples.now[rows]],
            "words": np.stack([wordings[rng.integers(len(wordings))] for wordings in said]),
            "state": self._state[rows],
            "actions": actions,
            "mask": mask,
            "targets": self._targets[rows],
        }
        if self._with_later:
            arrays["later_images"] = self._samples.images[later]
        return {name: torch.from_numpy(array) for name, array in arrays.items()}


def train_step(run: Run, batches: Batches) -> dict[str, float]:
    """One optimiser step; returns the losses by name."""
    settings = run.settings
    for group in run.optimizer.param_groups:
        group["lr"] = learning_rate(settings, run.step)
    generator = torch.Generator().manual_seed(
        int(np.random.default_rng((settings.seed, run.step, 1)).integers(2**63))
    )
    losses = run.learner.losses(batches.draw(settings.seed, run.step), generator, run.average)
    total = losses["loss"] + settings.target_weight * losses["target_loss"]
    if "alignment_loss" in losses:
        total = total + settings.alignment_weight * losses["alignment_loss"]
    run.optimizer.zero_grad(set_to_none=True)
    total.backward()
    torch.nn.utils.clip_grad_norm_(run.learner.parameters(), MAX_GRADIENT_NORM)
    run.optimizer.step()
    # A short memory at first, so that the average is not held back by the initial weights.
    decay = min(settings.ema_decay, (1 + run.step) / (10 + run.step))
    with torch.no_grad():
        current = run.learner.policy_tensors()
        torch._foreach_lerp_(list(run.average.values()), list(current.values()), 1.0 - decay)
    run.step += 1
    return {name: loss.item() for name, loss in losses.items()}


@torch.no_grad()
def validation_losses(run: Run, batches: Batches) -> dict[str, float]:
    """The losses of the averaged weights on the same held-out frames and noise each time."""
    current = {name: tensor.clone() for name, tensor in run.learner.policy_tensors().items()}
    run.learner.load_state_dict(run.average, strict=False)
    losses = run.learner.losses(batches.draw(0), torch.Generator().manual_seed(0), run.average)
    run.learner.load_state_dict(current, strict=False)
    return {name: loss.item() for name, loss in losses.items()}


def export(run: Run, out: Path) -> None:
    """Writes the averaged weights as a policy.

    They are stored as bfloat16, which the head reads without loss: half the size, and the rounding is far
    below what training with noise leaves undecided.
    """
    tensors = {name: tensor.to(torch.bfloat16).contiguous() for name, tensor in run.average.items()}
    with write_atomically(out / TENSOR_FILE) as temporary:
        temporary.write_bytes(serialize(tensors, metadata={"format": "pt"}))
    write_json(out / CONFIG_FILE, run.config.to_dict())


def save(run: Run, out: Path) -> None:
    """Writes all files of the run."""
    out.mkdir(parents=True, exist_ok=True)
    state = {
        "settings": asdict(run.settings),
        "config": run.config.to_dict(),
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
    write_json(out / "settings.json", {**asdict(run.settings), "demonstrations": run.demonstrations})
    write_json(out / "history.json", run.history)
    plot_history(run.history, out / "loss.png")


def resume(run: Run, path: Path) -> None:
    """Takes up a run where it was saved.

    Raises:
        InputError: it was started with other settings or other demonstrations.
    """
    state = torch.load(path, weights_only=True)
    if state["settings"] != asdict(run.settings):
        changed = [
            name for name, value in asdict(run.settings).items() if state["settings"].get(name) != value
        ]
        raise InputError(f"{path}: the run was started with other settings ({', '.join(changed)})")
    if state["config"] != run.config.to_dict():
        raise InputError(f"{path}: the run was started with other demonstrations")
    run.step, run.history = state["step"], state["history"]
    run.learner.load_state_dict(state["learner"])
    run.optimizer.load_state_dict(state["optimizer"])
    run.average = state["average"]


def start_from(run: Run, policy: Path) -> None:
    """Takes the weights of a policy as the initial ones.

    Raises:
        FileNotFoundError: no policy there.
        InputError: it has other sizes, tasks or statistics.
    """
    if PolicyConfig.from_file(policy / CONFIG_FILE) != run.config:
        raise InputError(f"{policy}: was trained with other sizes or other demonstrations")
    tensors = load_file(policy / TENSOR_FILE)
    run.learner.load_state_dict({name: tensor.float() for name, tensor in tensors.items()}, strict=False)
    run.average = {name: tensor.detach().clone() for name, tensor in run.learner.policy_tensors().items()}


def train(
    demonstrations: Path,
    out: Path,
    settings: TrainingSettings,
    on_step: Callable[[Progress], None],
    *,
    start: Path | None = None,
) -> PolicyConfig:
    """Trains a policy, going on from what lies in `out`.

    Args:
        demonstrations: directory written by `saccade demos`.
        out: directory of the run.
        settings: of the run.
        on_step: called after each step.
        start: a policy to start from; default random weights.

    Returns:
        The config of the policy.

    Raises:
        FileNotFoundError: no demonstrations there, or no policy to start from.
        InputError: demonstrations of several kinds, or a run with other settings in `out`.
    """
    tasks = demos.recorded_tasks(demonstrations)
    recording = demos.read_settings(demonstrations, tasks)
    training, validation = load_samples(demonstrations, tasks, settings.horizon)
    found = statistics(training)
    config = policy_config(settings, recording, tasks, found)
    if start is not None:
        settings = replace(settings, start_sha256=sha256_of(start / TENSOR_FILE))
    run = new_run(settings, config, describe(demonstrations, tasks))
    if start is not None:
        start_from(run, start)
    if (out / STATE_FILE).exists():
        resume(run, out / STATE_FILE)
    with_later = settings.aligned_block is not None
    batches = Batches(
        training, config, found["targets"], settings.batch_size, settings.absent_share, with_later
    )
    held_out = Batches(validation, config, found["targets"], VALIDATION_FRAMES, with_later=with_later)
    try:
        loop(run, batches, held_out, out, on_step)
    finally:
        if run.step:
            save(run, out)
    return config


def loop(
    run: Run, batches: Batches, held_out: Batches, out: Path, on_step: Callable[[Progress], None]
) -> None:
    """Trains to the last step, saving about once a minute."""
    saved, steps = time.monotonic(), list[dict[str, float]]()
    latest: float | None = None
    while run.step < run.settings.steps:
        steps.append(train_step(run, batches))
        means = {name: sum(losses[name] for losses in steps) / len(steps) for name in steps[0]}
        if time.monotonic() - saved > CHECKPOINT_SECONDS or run.step == run.settings.steps:
            held_out_losses = validation_losses(run, held_out)
            validation = {f"validation_{name}": loss for name, loss in held_out_losses.items()}
            run.history.append({"step": run.step, **means, **validation})
            save(run, out)
            latest = held_out_losses["loss"]
            saved, steps = time.monotonic(), []
        on_step(Progress(run.step, run.settings.steps, means["loss"], means["target_loss"], latest))


def plot_history(history: list[dict[str, Any]], path: Path) -> None:
    """Draws the losses over the steps, on a logarithmic scale."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    names = {
        "loss": "velocity, training",
        "validation_loss": "velocity, held out",
        "target_loss": "positions, training",
        "validation_target_loss": "positions, held out",
        "alignment_loss": "1 - cosine of the future rows, training",
        "validation_alignment_loss": "1 - cosine of the future rows, held out",
    }
    for key, label in names.items():
        if all(key in entry for entry in history):
            axes.plot([entry["step"] for entry in history], [entry[key] for entry in history], label=label)
    axes.set(xlabel="step", ylabel="mean squared error", yscale="log")
    axes.legend()
    with write_atomically(path) as temporary:
        figure.savefig(temporary, dpi=120)
    pyplot.close(figure)
