"""The result of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from saccade.diagnosis.effects import IMAGES, NOISE, OBSERVATION, TEXT, Measured
from saccade.diagnosis.plan import Plan
from saccade.diagnosis.verdicts import Effect, Verdict, effect_of, verdict_of


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a policy listens to, by the rules of ``docs/diagnose.md``. Made by :func:`diagnose`.

    Attributes:
        inputs: The verdict on ``"instruction"``, each ``"camera.<name>"``, ``"state"``, and ``"history"``
            where there is one.
        observation: The effect of another episode's whole observation; None with one episode.
        noise: The effect of another noise.
        edges: The effects of cutting ``"text"`` and ``"images"`` off inside the head.
        plan: Episodes, partners and instructions.
        seconds: How long the episodes took, summed, also of those computed at the same time.
    """

    inputs: Mapping[str, Verdict]
    observation: Effect | None
    noise: Effect
    edges: Mapping[str, Effect]
    plan: Plan
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON values."""
        return {
            "inputs": {name: asdict(one) for name, one in self.inputs.items()},
            "observation": None if self.observation is None else asdict(self.observation),
            "noise": asdict(self.noise),
            "edges": {name: asdict(one) for name, one in self.edges.items()},
            "episodes": list(self.plan.episodes),
            "partners": {str(one): other for one, other in self.plan.partners.items()},
            "instructions": dict(self.plan.instructions),
            "spread": list(self.plan.spread),
            "seed": self.plan.seed,
            "seconds": self.seconds,
        }

    def __repr__(self) -> str:
        found = ", ".join(f"{name}: {one.name} ({one.effect:.2f})" for name, one in self.inputs.items())
        return f"<saccade.Diagnosis {found}>"


def episode_counts(report: Diagnosis) -> set[int]:
    """The numbers of episodes that the intervals of a diagnosis are over."""
    effects = [one for verdict in report.inputs.values() for one in verdict.changes.values()]
    return {len(report.plan.episodes), *(one.episodes for one in effects)}


def summarised(measured: Sequence[Measured], plan: Plan, keys: Sequence[str]) -> Diagnosis:
    """The diagnosis of measured episodes; ``keys`` are those of the action."""

    def effect(name: str, kind: Any = None) -> Effect | None:
        return effect_of(measured, name, f"|{OBSERVATION}|", f"|{NOISE}|", keys, kind)

    observation, noise = effect(f"|{OBSERVATION}|"), effect(f"|{NOISE}|")
    assert noise is not None
    by_input: dict[str, dict[str, Effect]] = {}
    for name in dict.fromkeys(name for one in measured for name in one.names.tolist()):
        changed, change, kind = name.rsplit("|", 2)
        if not changed:
            continue
        changes = by_input.setdefault(changed, {})  # an input that no change is possible of is listed too
        if (found := effect(name, kind)) is not None:
            changes[change] = found
    return Diagnosis(
        inputs={name: verdict_of(changes, observation) for name, changes in by_input.items()},
        observation=observation,
        noise=noise,
        edges={name: one for name in (TEXT, IMAGES) if (one := effect(f"|{name}|")) is not None},
        plan=plan,
        seconds=sum(one.seconds for one in measured),
    )
