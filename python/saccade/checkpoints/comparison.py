"""Compares the actions of two runs, for example of a checkpoint and its resized copy."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from saccade._internal.arrays import Float32Array, integer
from saccade.checkpoints.description import Config, Source, open_published
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.input_files import checked, read_arrays
from saccade.head.intervention import Intervention
from saccade.head.options import LoadOptions

#: The arguments of a call of a head for one observation.
_Inputs: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class Change:
    """The difference of actions over all observations."""

    largest: float
    """The largest absolute difference in any dimension of any action."""
    mean: float
    """The mean absolute difference."""


@dataclass(frozen=True)
class ActionChanges:
    """What :func:`action_changes` measured, in the normalised actions of the head."""

    observations: int
    """Number of observations."""
    in_saccade: Change
    """The difference in saccade, which applies the copy's ``future_key_bias``."""
    in_other_programs: Change
    """The difference in programs that do not read it."""
    of_other_noise: Change
    """The difference of the source's actions when sampling starts from other noise, for scale."""
    actions_rms: float
    """Root mean square of the source's actions."""


def change(before: Float32Array, after: Float32Array) -> Change:
    """The difference of two arrays of actions of the same shape, computed in float64."""
    difference = np.abs(after.astype(np.float64) - before)
    return Change(largest=float(difference.max()), mean=float(difference.mean()))


def action_changes(
    source: Source,
    resized: Source,
    *,
    config: Config = None,
    features: str | os.PathLike[str] | None = None,
    seed: int = 0,
    num_observations: int = 4,
    num_vl_tokens: int = 296,
    num_threads: int | None = None,
) -> ActionChanges:
    """Compares the actions of a checkpoint with those of its copy by :func:`saccade.checkpoints.resize`.

    Both run in float32 on the same observations from the same noise. One head at a time is in memory.

    Args:
        source: The checkpoint.
        resized: The copy.
        config: Config of the source, as in ``resize``.
        features: A file of recorded observations, ``.npz`` or ``.safetensors``, see
            :func:`saccade.head.input_files.read_arrays`. Default: random observations of the first
            embodiment, which are less informative, because no robot produces them.
        seed: Seed of random observations, and of noise that the file does not contain.
        num_observations: Number of random observations.
        num_vl_tokens: Their number of vision-language tokens. 296 is what one camera produces in N1.5.
        num_threads: As for :meth:`saccade.ActionHead.from_pretrained`.

    Raises:
        FileNotFoundError, CheckpointError: As :meth:`saccade.ActionHead.from_pretrained`.
        InputError, ShapeError: An option is out of range, or the recorded observations do not fit the head.

    Example:
        >>> import saccade
        >>> demo = saccade.demo_checkpoint()
        >>> report = saccade.resize(demo, "twice-the-tokens", num_future_tokens=64)
        >>> found = action_changes(demo, "twice-the-tokens", num_vl_tokens=57)
        >>> found.in_saccade.mean < 1e-5 < found.of_other_noise.mean
        True
    """
    rng = np.random.default_rng(integer("seed", seed, least=0))
    arrays = None if features is None else read_arrays(Path(features))
    kept = open_published(source, config).kept_embodiments() or [0]
    ids = kept[:1] if arrays is None else np.unique(arrays["embodiment_id"]).tolist()
    loading: LoadOptions = {"embodiment_ids": ids, "num_threads": num_threads}
    head = ActionHead.from_pretrained(source, config=config, **loading)
    if arrays is None:
        observations = [_random(head, num_vl_tokens, rng) for _ in range(num_observations)]
    else:
        observations = _rows(checked(arrays, head.config, str(features)), head.config, rng)
    before = _actions(head, observations)
    others = [{**one, "noise": _noise(head.config, rng)} for one in observations]
    of_other_noise = change(before, _actions(head, others))
    del head
    head = ActionHead.from_pretrained(resized, **loading)
    after = _actions(head, observations)
    plain = after
    if head.config.future_key_bias is not None:
        # Replacing the tokens by themselves leaves their bias out.
        plain = _actions(head, observations, Intervention(future_tokens=head.future_tokens))
    return ActionChanges(
        observations=len(observations),
        in_saccade=change(before, after),
        in_other_programs=change(before, plain),
        of_other_noise=of_other_noise,
        actions_rms=float(np.sqrt(np.mean(np.square(before, dtype=np.float64)))),
    )


def _random(head: ActionHead, num_vl_tokens: int, rng: np.random.Generator) -> _Inputs:
    """Standard normal features, state and noise, drawn in this order."""
    config = head.config
    return {
        "backbone_features": rng.standard_normal((1, num_vl_tokens, config.context_dim), np.float32),
        "state": rng.standard_normal((1, config.num_states, config.state_dim), np.float32),
        "embodiment_id": head.embodiment_ids[0],
        "noise": _noise(config, rng),
    }


def _rows(recorded: _Inputs, config: HeadConfig, rng: np.random.Generator) -> list[_Inputs]:
    """Each row of a batch, with noise if the batch has none."""
    if recorded["noise"] is None:
        recorded = {**recorded, "noise": np.concatenate([_noise(config, rng) for _ in recorded["state"]])}
    given = {name: array for name, array in recorded.items() if array is not None}
    return [
        {name: array[row : row + 1] for name, array in given.items()} for row in range(len(given["state"]))
    ]


def _noise(config: HeadConfig, rng: np.random.Generator) -> Float32Array:
    return rng.standard_normal((1, config.action_horizon, config.encoder_action_dim), np.float32)


def _actions(
    head: ActionHead, observations: Sequence[_Inputs], intervention: Intervention | None = None
) -> Float32Array:
    return np.concatenate([np.asarray(head(**one, intervention=intervention)) for one in observations])
