"""The result of an evaluation, and its comparison with another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from saccade._internal.bootstrap import Estimate, bootstrap_ratio
from saccade.errors import InputError
from saccade.evaluation.layout import Layout
from saccade.evaluation.measures import (
    Errors,
    averaged,
    baselines,
    episode_errors,
    executed,
    table,
)
from saccade.evaluation.pairing import check_shared
from saccade.evaluation.prediction import Predicted


@dataclass(frozen=True)
class Comparison:
    """Two evaluations of the same observations with the same noise.

    Attributes:
        mse, mae: The first's error minus the other's, with its 95 % interval over episodes.
        mse_by_key: The same of the mean squared error of each key of the action.
        largest, mean: The largest and the mean absolute difference of their actions, by key, in the robot's
            units.
        equal: Whether all actions are equal, bit for bit.
    """

    mse: Estimate
    mae: Estimate
    mse_by_key: Mapping[str, Estimate]
    largest: Mapping[str, float]
    mean: Mapping[str, float]
    equal: bool

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON values."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The errors of a policy on recordings, by the rules of ``docs/evaluate.md``. Made by :func:`evaluate`.

    Attributes:
        errors: The mean errors over episodes, and their intervals.
        by_key: The same for each key of the action.
        by_step: The same for each step of the horizon.
        baselines: The same of ``"hold"``, ``"mean"`` and ``"noise"``, in the robot's units only.
        hold: What ``"hold"`` repeats: ``"state"`` or ``"zero"``, by key.
        table: A row for each episode, step of an observation and key, with the errors of ``actions`` actions.
        stride, horizon, seed: Steps between two observations, actions in a chunk, and the seed.
        noise_shape: That of the head's noise for a chunk, ``(horizon, width)``. With the seed it decides the
            noise.
        predictions: The recorded and predicted actions of each episode.
        layout: Where the keys are in them.
    """

    errors: Errors
    by_key: Mapping[str, Errors]
    by_step: tuple[Errors, ...]
    baselines: Mapping[str, Errors]
    hold: Mapping[str, str]
    table: Sequence[Mapping[str, Any]]
    stride: int
    horizon: int
    seed: int
    noise_shape: tuple[int, int]
    predictions: Sequence[Predicted]
    layout: Layout

    @property
    def mse(self) -> float:
        """Isaac-GR00T's mean squared error, in the robot's units."""
        return self.errors.mse

    @property
    def mae(self) -> float:
        """The mean absolute error, in the robot's units."""
        return self.errors.mae

    @property
    def intervals(self) -> Mapping[str, tuple[float, float]]:
        """The 95 % intervals of the errors over episodes, by name."""
        return self.errors.intervals

    @property
    def seconds(self) -> float:
        """How long the predictions took: the sum over episodes, also of those computed at the same time."""
        return sum(one.seconds for one in self.predictions)

    @property
    def num_chunks(self) -> int:
        """Number of chunks that were predicted and compared."""
        return sum(len(one.steps) for one in self.predictions)

    def compare(self, other: Evaluation) -> Comparison:
        """This evaluation against another one of the same recordings, with the same noise.

        An evaluation does not hold what the policies saw: that two are of the same observations is only known
        from the recorded actions.

        Raises:
            InputError: They have other episodes or recorded actions, or another stride, horizon, seed, shape
                of the noise or keys of the action; the message names the first difference.
        """
        check_shared(other._shared(), self._shared(), "compare", self._shared())
        pairs = list(zip(self.predictions, other.predictions, strict=True))
        for one, two in pairs:
            if not np.array_equal(one.recorded, two.recorded):
                raise InputError(
                    f"compare: episode {one.episode}: expected the recorded actions of this run, got others"
                )
        errors = [[episode_errors(one, self.stride, self.layout) for one in pair] for pair in pairs]
        apart = np.concatenate(
            [
                np.abs(executed(one, self.stride).astype(np.float64) - executed(two, self.stride))
                for one, two in pairs
            ]
        )
        return Comparison(
            mse=_difference([(one.all[0], two.all[0]) for one, two in errors]),
            mae=_difference([(one.all[1], two.all[1]) for one, two in errors]),
            mse_by_key={
                key: _difference([(one.by_key[key][0], two.by_key[key][0]) for one, two in errors])
                for key in self.layout.keys
            },
            largest={key: float(apart[:, where].max()) for key, where in self.layout.keys.items()},
            mean={key: float(apart[:, where].mean()) for key, where in self.layout.keys.items()},
            equal=all(np.array_equal(one.predicted[:, 0], two.predicted[:, 0]) for one, two in pairs),
        )

    def _shared(self) -> dict[str, Any]:
        """What an evaluation must have in common with another one, in the order in which it is compared."""
        return {
            "stride": self.stride,
            "horizon": self.horizon,
            "seed": self.seed,
            "noise_shape": self.noise_shape,
            "action_keys": [[key, where.stop - where.start] for key, where in self.layout.keys.items()],
            "episodes": [one.episode for one in self.predictions],
        }

    def to_json(self) -> dict[str, Any]:
        """Everything but the actions, as JSON values."""
        return {
            **asdict(self.errors),
            "by_key": {key: asdict(one) for key, one in self.by_key.items()},
            "by_step": [asdict(one) for one in self.by_step],
            "baselines": {
                name: {part: value for part, value in asdict(one).items() if "normalized" not in part}
                for name, one in self.baselines.items()
            },
            "hold": dict(self.hold),
            "episodes": [one.episode for one in self.predictions],
            "stride": self.stride,
            "horizon": self.horizon,
            "seed": self.seed,
            "num_chunks": self.num_chunks,
            "seconds": self.seconds,
            "table": [dict(row) for row in self.table],
        }

    def __repr__(self) -> str:
        return (
            f"<saccade.Evaluation mse={self.mse:.6g} mae={self.mae:.6g} episodes={len(self.predictions)} "
            f"stride={self.stride} horizon={self.horizon} seed={self.seed}>"
        )


def _difference(pairs: Sequence[tuple[Any, Any]]) -> Estimate:
    """The mean over episodes of the first number minus the second, with its interval."""
    found = [np.subtract(one, two, dtype=np.float64) for one, two in pairs]
    return bootstrap_ratio(found, np.ones(len(found)), range(len(found)))


def summarised(
    predictions: Sequence[Predicted], layout: Layout, stride: int, seed: int, noise_shape: tuple[int, int]
) -> Evaluation:
    """The evaluation of predicted episodes."""
    found = [episode_errors(one, stride, layout) for one in predictions]
    horizon = predictions[0].horizon
    errors, choice = baselines(predictions, stride, layout)
    return Evaluation(
        errors=averaged([one.all for one in found]),
        by_key={key: averaged([one.by_key[key] for one in found]) for key in layout.keys},
        by_step=tuple(averaged([one.by_step[step] for one in found]) for step in range(horizon)),
        baselines=errors,
        hold=choice,
        table=table(predictions, stride, layout),
        stride=stride,
        horizon=horizon,
        seed=seed,
        noise_shape=noise_shape,
        predictions=predictions,
        layout=layout,
    )
