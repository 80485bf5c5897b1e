"""Trains a small LIBERO policy on a recording, as ``saccade_lab.training.train`` does for Meta-World."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from saccade_lab.libero.checkpoint import LiberoConfig, recorded_statistics
from saccade_lab.libero.recording import describe, load_samples, read_recordings
from saccade_lab.libero.sizes import libero_config
from saccade_lab.sim.allocator import keep_freed_memory
from saccade_lab.training.settings import TrainingSettings
from saccade_lab.training.train import Progress, check_device, fit, new_run


def train(
    demonstrations: Path,
    out: Path,
    settings: TrainingSettings,
    on_step: Callable[[Progress], None],
    *,
    device: str = "cpu",
) -> LiberoConfig:
    """Trains a policy from random weights, or continues the run in ``out``.

    Args:
        demonstrations: Directory that ``saccade demos --env`` wrote.
        out: Directory of the run.
        settings: Settings of the run.
        on_step: Called after each step.
        device: As in ``saccade_lab.training.train.train``.

    Returns:
        The config of the policy.

    Raises:
        FileNotFoundError: There are no demonstrations.
        InputError: Demonstrations, settings or the device do not fit, or ``out`` contains a run with others.
    """
    check_device(settings, device)
    keep_freed_memory()
    recordings = read_recordings(demonstrations)
    config = libero_config(settings, [task.instruction for task in recordings], recordings[0].image_size)
    training, validation = load_samples(
        demonstrations, recordings, settings.horizon, config.processor(), torch.get_num_threads()
    )
    valid = training.mask[..., 0] > 0
    config = replace(config, statistics=recorded_statistics(training.state, training.actions[valid]))
    run = new_run(settings, config, describe(demonstrations, recordings), device)
    fit(run, training, validation, out, on_step)
    return config
