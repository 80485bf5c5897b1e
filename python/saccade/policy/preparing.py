"""Step 3 of :meth:`saccade.Policy.act`: frames and instructions as the inputs of the backbone."""

from __future__ import annotations

from collections.abc import Iterable

from saccade.backbone.inputs import BackboneInputs
from saccade.observations import ParsedObservation
from saccade.processor import Processor


def prepare_inputs(parsed: Iterable[ParsedObservation], processor: Processor) -> list[BackboneInputs]:
    """Resized frames and token ids of each row of each observation, a batch of one each."""
    found = []
    for observation in parsed:
        for frames, instruction in zip(observation.frames, observation.instructions, strict=True):
            # Without their names, by which lerobot's processor would sort them: they are in order.
            inputs = processor(list(frames.values()), instruction, plain_text=observation.is_plain)
            inputs.view_names = tuple(frames)
            found.append(inputs)
    return found
