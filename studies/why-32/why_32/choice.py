"""What the command line chooses: stages, recipes and arms of the plan."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable, Iterator

from saccade._internal.flags import add_list
from saccade.errors import InputError
from saccade_lab.flags import check_known
from saccade_lab.study.questions.sweeps_results import PLAIN
from why_32.arms import ARMS, PolicyArm
from why_32.measured import MEASURED
from why_32.plan import CORE_STAGE, PILOT, Plan, PlannedPolicy
from why_32.times import TIMES


def add_arguments(parser: argparse.ArgumentParser, plan: Plan) -> None:
    """Adds the flags."""
    stages = ", ".join(all_stages(plan))
    add_list(parser, "--stages", help=f"stages to run, of {stages} (default: all but {PILOT})")
    what = "recipes whose policies are run, in all of these stages; those of the core together or not at all"
    add_list(parser, "--recipes", default=(), help=f"{what} (default: those of the plan)")
    arms = "; ".join(f"{stage}: {', '.join(map(written, some))}" for stage, some in ARMS.items())
    add_list(parser, "--arms", default=(), help=f"arms to run, of {arms} (default: all)")


def choose(args: argparse.Namespace, plan: Plan) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """The names of the stages in the order of the plan, of the recipes and of the arms; of the latter two
    none where all are run.

    Raises:
        InputError: a name is unknown, a recipe or an arm is part of none of the stages, or some but not all
            recipes of the core are chosen, which is not judged before all its policies are trained.
    """
    known = all_stages(plan)
    asked = [stage for stage in known if stage != PILOT] if args.stages is None else args.stages
    check_known("--stages", asked, known)
    stages = tuple(stage for stage in known if stage in asked)
    check_known("--recipes", args.recipes, [recipe.name for recipe in plan.recipes])
    by_name = {written(arm): arm for some in ARMS.values() for arm in some}
    check_known("--arms", args.arms, by_name)
    check_part("--arms", args.arms, [written(arm) for stage in stages for arm in ARMS.get(stage, ())], stages)
    arms = tuple(by_name[name].name for name in args.arms)
    parts = dict.fromkeys(recipe for stage in stages for recipe in recipes_of(stage, plan, arms))
    check_part("--recipes", args.recipes, parts, stages)
    core = [recipe.name for recipe in plan.recipes if recipe.stage == CORE_STAGE]
    missing = [name for name in core if name not in args.recipes]
    if CORE_STAGE in stages and 0 < len(missing) < len(core):
        raise InputError(f"--recipes: {', '.join(missing)} is missing, expected all or none of the core's")
    return stages, tuple(args.recipes), arms


def judged(stage: str, plan: Plan, arms: Collection[str]) -> Iterator[tuple[PlannedPolicy, str]]:
    """The policies and arms of a stage that judges some, trained or not: its own policies unchanged, or all
    under its arms, of which those of these names are taken, or all if there are none. They run arm by arm, so
    that a run which is stopped leaves whole arms.
    """
    if stage not in ARMS:  # those of `MEASURED` have no policies of their own
        yield from ((policy, PLAIN) for policy in plan.policies(stage))
        return
    for arm in ARMS[stage]:
        if arms and arm.name not in arms:
            continue
        for policy in plan.all_policies(pilots=False):
            if arm.applies(policy.training.num_future_tokens):
                yield policy, arm.name


def recipes_of(stage: str, plan: Plan, arms: Collection[str]) -> Iterator[str]:
    """The recipes whose policies a stage trains, judges, measures or times; some of them more than once."""
    if stage == TIMES:
        yield from (policy.recipe.name for policy in plan.all_policies(pilots=False))
    elif stage in MEASURED:
        yield from (policy.recipe.name for policy in MEASURED[stage].policies(plan))
    else:
        yield from (policy.recipe.name for policy, _ in judged(stage, plan, arms))


def check_part(flag: str, given: Iterable[str], parts: Collection[str], stages: Iterable[str]) -> None:
    """Raises `InputError` if one of the names is part of none of the stages."""
    for name in given:
        if name not in parts:
            expected = f"one of {', '.join(parts)}" if parts else "none"
            raise InputError(
                f"{flag}: {name} is in none of the stages {', '.join(stages)}, expected {expected}"
            )


def written(arm: PolicyArm) -> str:
    """The name of an arm on the command line, where a space separates names."""
    return arm.name.replace(" ", "-")


def all_stages(plan: Plan) -> tuple[str, ...]:
    """The stages of a plan, those that train policies and those that do not, in the order they run in."""
    return (*plan.stages, *ARMS, *MEASURED, TIMES)
