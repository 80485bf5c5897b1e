"""Draws batches of samples, with a wording of its task for each frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from saccade._internal.arrays import Float32Array
from saccade.processor import Processor
from saccade_lab.reference import Backbone
from saccade_lab.reference.backbone import BackboneFeatures, PreparedInputs
from saccade_lab.training.dataset import Samples, normalized_actions
from saccade_lab.training.frozen import FrozenFeatures
from saccade_lab.training.graphs import map_tensors
from saccade_lab.training.inputs import prepared_inputs, shifted
from saccade_lab.training.learner import Batch
from saccade_lab.training.policy_files import PolicyFiles


class Batches:
    """Draws batches on the device of a backbone, where all frames are kept.

    Args:
        samples: The samples to draw from. The frames of 400 demonstrations of LIBERO take 2.5 GB.
        config: Config of the policy.
        backbone: Its backbone.
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
        backbone: Backbone,
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
        self._backbone = backbone
        self._images = torch.from_numpy(samples.images)
        if frozen is None:
            self._images = self._images.to(backbone.device)
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
        batch = Batch(
            inputs=self._inputs(self._samples.now[rows], prompts, rng),
            state=torch.from_numpy(self._state[rows]),
            actions=torch.from_numpy(actions),
            mask=torch.from_numpy(mask),
            targets=torch.from_numpy(self._targets[rows]),
            later=self._inputs(later, prompts, rng) if self._with_later else None,
        )
        return map_tensors(batch, lambda one: one.to(self._backbone.device))

    def _inputs(
        self,
        frames: npt.NDArray[np.int64],
        prompts: list[npt.NDArray[np.int64]],
        rng: np.random.Generator,
    ) -> PreparedInputs | BackboneFeatures:
        if self._frozen is not None:
            return self._frozen(frames)
        device = self._backbone.device
        images = self._images[torch.from_numpy(frames).to(device)]
        if self._shift:
            views = images.flatten(0, 1)
            moves = rng.integers(-self._shift, self._shift, endpoint=True, size=(len(views), 2))
            images = shifted(views, torch.from_numpy(moves).to(device), self._shift).view_as(images)
        return prepared_inputs(self._backbone, images, prompts)


def prompts_of(config: PolicyFiles, processor: Processor) -> list[list[npt.NDArray[np.int64]]]:
    """The token ids ``(T,)`` of every wording of every task of a config; last, of the released default.

    N1.7 has no default, so nothing comes last.
    """
    frames = [np.zeros((config.frame_size, config.frame_size, 3), np.uint8)] * config.num_cameras
    said: list[Sequence[str | None]] = [*config.instructions]
    if processor.version == "n1.5":
        said.append((None,))
    return [[processor(frames, text).input_ids[0] for text in texts] for texts in said]
