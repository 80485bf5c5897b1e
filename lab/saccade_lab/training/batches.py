"""Draws batches of samples, with a wording of its task for each frame."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
import torch

from saccade._internal.arrays import Float32Array
from saccade.backbone.inputs import BackboneInputs
from saccade.processor import Processor
from saccade_lab.reference.backbone import BackboneFeatures
from saccade_lab.training.dataset import Samples, normalized_actions
from saccade_lab.training.frames import backbone_inputs, shifted
from saccade_lab.training.frozen import FrozenFeatures
from saccade_lab.training.learner import Batch
from saccade_lab.training.policy_files import PolicyFiles

#: A batch of 128 frames takes a thread 0.1 to 0.2 s, and a step on an H100 0.1 s.
DRAWING_THREADS = 4


class Batches:
    """Draws batches.

    Args:
        samples: The samples to draw from.
        config: Config of the policy.
        prompts: What ``prompts_of`` returns.
        targets: Mean and standard deviation of the positions, ``(6,)`` each.
        batch_size: Frames per batch.
        absent_share, language_dropout, shift: See ``TrainingSettings``.
        frozen: The features of the samples' frames, if the backbone is not trained.
        with_later: Whether batches contain the observations after the chunk was executed.
    """

    def __init__(
        self,
        samples: Samples,
        config: PolicyFiles,
        prompts: list[list[npt.NDArray[np.int64]]],
        targets: tuple[Float32Array, Float32Array],
        batch_size: int,
        *,
        absent_share: float = 0.0,
        language_dropout: float = 0.0,
        shift: int = 0,
        frozen: FrozenFeatures | None = None,
        with_later: bool = False,
    ) -> None:
        self._samples = samples
        self._frozen = frozen
        self._with_later = with_later
        self._batch_size = batch_size
        self._absent_share, self._language_dropout, self._shift = absent_share, language_dropout, shift
        self._version = config.backbone_sizes.version
        normalizer = config.normalizer
        self._state = np.asarray(normalizer.state(samples.state))
        self._actions = normalized_actions(normalizer, samples.actions) * samples.mask
        self._targets = (samples.targets - targets[0]) / targets[1]
        self._prompts = prompts
        self._impossible = config.impossible
        self._still = normalized_actions(normalizer, np.zeros(samples.actions.shape[1:], np.float32))

    def draw(self, *key: int) -> Batch:
        """The batch of ``key``, with a wording drawn for each frame."""
        rng = np.random.default_rng(key)
        rows = rng.integers(len(self._samples), size=self._batch_size)
        tasks, later = self._samples.tasks[rows], self._samples.later[rows]
        actions, mask = self._actions[rows], self._samples.mask[rows]
        is_absent = np.zeros(len(rows), dtype=bool)
        for row in np.flatnonzero(rng.random(len(rows)) < self._absent_share):
            if self._impossible[tasks[row]]:
                is_absent[row] = True
                tasks[row] = rng.choice(self._impossible[tasks[row]])
                actions[row], mask[row] = self._still, 1.0
                later[row] = self._samples.now[rows[row]]
        said = [self._prompts[task] for task in tasks]
        prompts = [prompts[rng.integers(len(prompts))] for prompts in said]
        if self._language_dropout:
            for row in np.flatnonzero((rng.random(len(rows)) < self._language_dropout) & ~is_absent):
                prompts[row] = self._prompts[-1][0]
        return Batch(
            inputs=self._inputs(self._samples.now[rows], prompts, rng),
            state=torch.from_numpy(self._state[rows]),
            actions=torch.from_numpy(actions),
            mask=torch.from_numpy(mask),
            targets=torch.from_numpy(self._targets[rows]),
            later=self._inputs(later, prompts, rng) if self._with_later else None,
        )

    def _inputs(
        self,
        frames: npt.NDArray[np.int64],
        prompts: list[npt.NDArray[np.int64]],
        rng: np.random.Generator,
    ) -> BackboneInputs | BackboneFeatures:
        if self._frozen is not None:
            return self._frozen(frames)
        images = self._samples.images[frames]
        if self._shift:
            images = shifted(images, self._shift, rng)
        return backbone_inputs(images, prompts, self._version)


def drawn(batches: Batches, seed: int, steps: range, device: torch.device) -> Generator[Batch]:
    """The batches of training steps, which are the same for every device.

    On a CPU each is drawn when it is asked for. For another device threads draw the next ones meanwhile: as
    many as there are threads wait, of 230 MB each with 128 frames of two views of LIBERO.

    Args:
        batches: Draws them.
        seed: Seed of the run.
        steps: Numbers of the steps.
        device: Where they are used.
    """
    if device.type == "cpu":
        yield from (batches.draw(seed, step) for step in steps)
        return

    def draw(step: int) -> Batch:
        batch = batches.draw(seed, step)
        if device.type == "cuda":
            pin_pixels(batch)
        return batch

    threads = ThreadPoolExecutor(DRAWING_THREADS)
    try:
        draws = (threads.submit(draw, step) for step in steps)
        ahead = deque(itertools.islice(draws, DRAWING_THREADS))
        while ahead:
            batch = ahead.popleft().result()
            ahead.extend(itertools.islice(draws, 1))
            yield batch
    finally:
        threads.shutdown(cancel_futures=True)


def pin_pixels(batch: Batch) -> None:
    """Moves the pixels of a batch into page-locked memory, from which a GPU reads several times faster."""
    for inputs in (batch.inputs, batch.later):
        if isinstance(inputs, BackboneInputs) and not isinstance(inputs.pixel_values, tuple):
            inputs.pixel_values = torch.from_numpy(inputs.pixel_values).pin_memory().numpy()


def prompts_of(config: PolicyFiles, processor: Processor) -> list[list[npt.NDArray[np.int64]]]:
    """The token ids ``(T,)`` of every wording of every task of a config; last, of the released default.

    N1.7 has no default, so nothing comes last.
    """
    frames = [np.zeros((config.frame_size, config.frame_size, 3), np.uint8)] * config.num_cameras
    said: list[Sequence[str | None]] = [*config.instructions]
    if processor.version == "n1.5":
        said.append((None,))
    return [[processor(frames, text).input_ids[0] for text in texts] for texts in said]
