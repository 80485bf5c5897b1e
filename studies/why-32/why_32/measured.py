"""The stages that judge no policy, but measure those that are trained."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from saccade_lab.study.cell import Rows
from why_32 import measures, patching, probes, specialise
from why_32.plan import Plan, PlannedPolicy


@dataclass(frozen=True)
class MeasuredStage:
    """What is measured of every policy.

    Attributes:
        measure: Function from the policy's directory, the tasks and the seeds of the episodes to rows.
        fewest_tokens: N of the policies that are measured is at least this.
    """

    measure: Callable[[str, Sequence[str], range], Rows]
    fewest_tokens: int = 1

    def policies(self, plan: Plan) -> Iterator[PlannedPolicy]:
        """The policies of a plan that are measured, trained or not."""
        for policy in plan.all_policies(pilots=False):
            if policy.training.num_future_tokens >= self.fewest_tokens:
                yield policy


FIRST_EPISODES = 10  # of each task, on which they are measured
#: By name of the stage.
MEASURED = {
    measures.MEASURES: MeasuredStage(measures.measure),
    specialise.SPECIALISE: MeasuredStage(specialise.measure, specialise.FEWEST),
    patching.PATCHING: MeasuredStage(patching.measure),
    probes.PROBES: MeasuredStage(probes.measure, fewest_tokens=0),
}
