"""A hash of what the models of a policy are given of observations, to tell preprocessing apart."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from saccade.observations import ParsedObservation
from saccade.policy.policy import Policy
from saccade.policy.preparing import prepare_inputs
from saccade.policy.reading import Observation, read_observations
from saccade.processor import Processor


def inputs_sha256(policy: Policy, observations: Iterable[Observation | ParsedObservation]) -> str:
    """SHA-256 of pixels, tokens and normalised states, for a policy with saccade's own processor."""
    assert isinstance(policy.processor, Processor)
    found = hashlib.sha256()
    for given in observations:
        parsed = read_observations(given, policy.requirements)
        arrays: list[Any] = [policy.normalizer.state(parsed.state)]
        for inputs in prepare_inputs(parsed, policy.processor):
            pixels = inputs.pixel_values
            arrays += [*(pixels if isinstance(pixels, tuple) else (pixels,))]
            arrays += [inputs.input_ids, inputs.attention_mask, inputs.image_grid_thw]
        for array in arrays:
            values = np.ascontiguousarray(() if array is None else array)
            found.update(f"{values.dtype} {values.shape}\n".encode())
            found.update(values.tobytes())
    return found.hexdigest()
