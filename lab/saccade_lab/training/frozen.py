"""Features of a backbone that is not trained: computed once for a recording, and shared by the runs on it."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from saccade._internal.files import write_atomically
from saccade_lab.reference.backbone import Backbone, BackboneFeatures, PreparedInputs
from saccade_lab.training.dataset import Samples
from saccade_lab.training.frames import padded
from saccade_lab.training.inputs import prepared_inputs

FRAMES_AT_ONCE = 64


class FrozenFeatures:
    """Features of every frame of a recording, float16, in a file that is mapped into memory.

    A frame has one of the wordings of its task here, in turn, so that it has one row of features.

    Args:
        samples: The samples, whose frames are computed.
        prompts: The token ids of every wording of every task in ``TASKS``.
        backbone: The backbone.
        path: The file. It is written if it is not there; its name has to identify backbone and recording.
    """

    def __init__(
        self,
        samples: Samples,
        prompts: Sequence[Sequence[npt.NDArray[np.int64]]],
        backbone: Backbone,
        path: Path,
    ) -> None:
        self._images = samples.images
        self._backbone = backbone
        tasks = np.zeros(len(samples.images), np.int64)
        tasks[samples.now] = tasks[samples.later] = samples.tasks
        self._prompts = [
            prompts[task][frame % len(prompts[task])] for frame, task in enumerate(tasks.tolist())
        ]
        self._length = max(map(len, self._prompts))
        if not path.exists():
            self._write(path)
        self._features = np.load(path, mmap_mode="r")  # (frames, T, width)

    @torch.no_grad()
    def _write(self, path: Path) -> None:
        shape = (len(self._images), self._length, self._backbone.sizes.features_width)
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as temporary:
            array = np.lib.format.open_memmap(temporary, "w+", np.float16, shape)
            for first in range(0, len(array), FRAMES_AT_ONCE):
                frames = np.arange(first, min(first + FRAMES_AT_ONCE, len(array)))
                array[frames] = self._backbone(self._inputs(frames)).backbone_features.cpu().numpy()
            array.flush()

    def _inputs(self, frames: npt.NDArray[np.int64]) -> PreparedInputs:
        prompts = [self._prompts[frame] for frame in frames]
        images = torch.from_numpy(self._images[frames]).to(self._backbone.device)
        return prepared_inputs(self._backbone, images, prompts, self._length)

    def __call__(self, frames: npt.NDArray[np.int64]) -> BackboneFeatures:
        """The features of some frames, as the backbone itself returns them."""
        ids, mask = padded([self._prompts[frame] for frame in frames])
        features = self._features[frames, -ids.shape[1] :].astype(np.float32)
        image_mask = ids == self._backbone.sizes.image_token
        places = np.flatnonzero(image_mask)
        return BackboneFeatures(*map(torch.from_numpy, (features, mask, image_mask, places)))
