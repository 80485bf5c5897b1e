"""Plans: what is refused, phases and arms, what policies cost."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_plan import PLAN, RECORDING, TASK, TINY, recipe

from benches.work import encode_work, sample_work, total
from saccade.errors import InputError
from saccade_lab.reference.layers import TABLE_STD
from saccade_lab.sim import graphics
from saccade_lab.sim.policy import num_vl_tokens
from saccade_lab.timing import Call
from saccade_lab.training import train
from saccade_lab.training.learner import new_learner
from saccade_lab.training.settings import TrainingSettings
from why_32 import arms, costs
from why_32 import plan as plans
from why_32 import study as studies
from why_32.__main__ import main
from why_32.measured import MEASURED
from why_32.study import Answer


def test_policies_that_are_measured() -> None:
    """Those of all stages but the pilots, as far as they have enough tokens."""
    one = recipe("numbers", "n-1", (0,), num_future_tokens=1)
    plan = replace(PLAN, recipes=(*PLAN.recipes, one))
    several = {f"{name}-seed-{seed}" for name in ("n-4", "n-32", "n-4-aligned") for seed in (0, 1)}
    assert {policy.name for policy in MEASURED["specialise"].policies(plan)} == several
    for stage in ("measures", "patching"):
        assert {policy.name for policy in MEASURED[stage].policies(plan)} == {*several, "n-1-seed-0"}
    everyone = {policy.name for policy in plan.all_policies(pilots=False)}
    assert {policy.name for policy in MEASURED["probes"].policies(plan)} == everyone
    known = Answer(plan, ("measures", "specialise"), trained=dict.fromkeys((*several, "n-1-seed-0"), ""))
    assert known.num_cells == 7 + 6


def test_phases(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core is judged when all of it is trained, the later stages by and by."""
    monkeypatch.setattr(studies, "SEEDS_TOGETHER", 1)
    study = Answer(PLAN, ("core", "alignment", "measures"))
    phases = study.phases
    found = [(phase.stage, phase.kind, phase.seeds) for phase in phases]
    assert found == [
        ("core", "recording", ()),
        ("core", "backbone", ()),
        ("core", "training", (0, 1)),
        ("core", "episodes", (0, 1)),
        ("alignment", "recording", ()),
        ("alignment", "backbone", ()),
        ("alignment", "training", (0,)),
        ("alignment", "episodes", (0,)),
        ("alignment", "training", (1,)),
        ("alignment", "episodes", (1,)),
        ("measures", "measures", ()),
    ]
    monkeypatch.setattr(studies, "SEEDS_TOGETHER", 2)
    three = replace(PLAN, recipes=(recipe("alignment", "n-4-aligned", (0, 1, 2)),))
    assert [phase.seeds for phase in Answer(three, ("alignment",)).phases[2::2]] == [(0, 1), (2,)]
    names = ("backbone", "n-4-aligned-seed-0", "n-4-aligned-seed-1")
    known = replace(study, trained=dict.fromkeys(names, ""))
    keys = [[cell.key for cell in known.cells_of(phase)] for phase in phases[6:10]]
    assert keys == [
        [("training", "n-4-aligned-seed-0")],
        [("episodes", "n-4-aligned-seed-0", "plain", TASK)],
        [("training", "n-4-aligned-seed-1")],
        [("episodes", "n-4-aligned-seed-1", "plain", TASK)],
    ]


def test_recipes_and_arms_that_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """They limit the policies of every stage and the arms of those that have some, and not what is known."""
    names = {policy.name for policy in PLAN.all_policies(pilots=True)}
    some: dict[str, Any] = {"recipes": ("n-0", "n-32"), "arms": ("steps of 2", "1 merged")}
    known = Answer(PLAN, ("alignment", "instrument", "steps", "measures"), trained=dict.fromkeys(names, ""))
    study = replace(known, **some)
    both = [("n-0", 0), ("n-32", 0), ("n-0", 1), ("n-32", 1)]
    assert [policy.name for policy, _ in study.judged("core")] == [f"{name}-seed-{n}" for name, n in both]
    assert [(policy.name, arm) for policy, arm in study.judged("instrument")] == [
        (f"n-32-seed-{seed}", "1 merged") for seed in (0, 1)
    ]
    assert [(policy.name, arm) for policy, arm in study.judged("steps")] == [
        (f"{name}-seed-{seed}", "steps of 2") for name, seed in both
    ]
    assert not list(study.judged("alignment"))
    assert study.num_cells == (2 + 4 + 2) * len(PLAN.tasks)  # the last ones are measured
    assert study.planned("n-4-aligned-seed-0").recipe.name == "n-4-aligned"
    parser = argparse.ArgumentParser()
    Answer.add_arguments(parser)
    monkeypatch.setattr(graphics, "check", lambda: None)
    words = ["--stages", "instrument,steps", "--recipes", "n-0,n-32", "--arms", "steps-of-2", "1-merged"]
    parsed = Answer.from_arguments(parser.parse_args(words))
    assert (parsed.recipes, parsed.arms) == (some["recipes"], some["arms"])
    assert PLAN.only(()) == PLAN
    assert known.chosen == PLAN


def test_the_arms_of_the_stages_that_train_nothing() -> None:
    names = [arm.name for of_stage in arms.ARMS.values() for arm in of_stage]
    assert len(set(names)) == len(names)
    for name in names:
        found = arms.find_arm(name)
        assert found is not None
        rng, tokens = np.random.default_rng(0), np.random.default_rng(1).standard_normal((8, 4))
        change = found.arm.intervention(tokens.astype(np.float32), rng)
        assert (change is None) == (found.num_steps is not None)
        assert found.applies(8)
        assert found.applies(0) == (found.num_steps is not None)
    assert arms.find_arm("plain") is None
    assert [arms.mass_of(4).applies(count) for count in (0, 4, 32)] == [False, False, True]
    assert [arms.merged_to(4).applies(count) for count in (0, 4, 32)] == [False, False, True]


def test_costs_by_hand() -> None:
    settings = replace(TINY, only="", num_future_tokens=5, vl_num_layers=1)
    config = train.policy_config(settings, RECORDING.settings, [TASK])
    sizes, head = config.backbone_sizes, config.head_config
    vision, text = sizes.vision, sizes.text
    patches, merged = vision.num_positions, vision.num_positions // 4
    tower = patches * 3 * vision.patch_size**2 * vision.width + vision.num_layers * (
        patches * vision.width * (4 * vision.width + 2 * vision.mlp_width) + 2 * patches**2 * vision.width
    )
    connector = merged * 4 * vision.width * text.width
    (context,) = {num_vl_tokens(config.processor(), config.simulation)}
    inner = text.num_heads * text.head_dim
    layer = context * text.width * (2 * inner + 2 * text.num_key_heads * text.head_dim + 3 * text.mlp_width)
    backbone = tower + connector + sizes.num_layers * (layer + 2 * context**2 * inner)
    call = Call.of(head, context)
    of_head = [total(work(head, call)).multiply_adds for work in (encode_work, sample_work)]
    found = costs.cost(settings, RECORDING)
    assert found.chunk == backbone + sum(of_head)
    # Backward costs twice as much as forward, except where no gradient is needed: at the pixels.
    assert 2.5 * backbone < found.sample < 3 * (backbone + sum(of_head))
    aligned = costs.cost(replace(settings, alignment_weight=0.1), RECORDING)
    assert aligned.chunk == found.chunk
    assert aligned.sample > found.sample + backbone

    # Alone, the head costs what is left: the features are given.
    head_alone = costs.cost(replace(settings, only="head"), RECORDING)
    assert head_alone.chunk == found.chunk
    assert 2 * backbone < found.sample - head_alone.sample < 3.5 * backbone
    backbone_alone = costs.cost(replace(settings, only="backbone"), RECORDING)
    assert backbone_alone.chunk == backbone
    assert 2.5 * backbone < backbone_alone.sample < 3.5 * backbone


def test_costs_that_are_matched() -> None:
    settings = replace(TINY, num_future_tokens=64, width=16, num_heads=2)
    wanted = costs.cost(settings, RECORDING)

    def without(**changes: Any) -> costs.Cost:
        return costs.cost(replace(settings, num_future_tokens=0, **changes), RECORDING)

    width = costs.matched_width(settings, RECORDING)
    assert width > 16
    errors = [
        abs(without(width=one, language_width=16).chunk - wanted.chunk)
        for one in (width - 4, width, width + 4)
    ]
    assert errors[1] == min(errors)
    steps = costs.matched_steps(settings, RECORDING)
    assert abs(steps * without().sample - settings.steps * wanted.sample) <= without().sample / 2


def test_plans_that_cannot_be(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        InputError, match="recipes: two have the same name in n-4-pilot, n-4-pilot-blind, n-0"
    ):
        replace(PLAN, recipes=(*PLAN.recipes, PLAN.recipes[0]))
    with pytest.raises(InputError, match="backbones: n-4-pilot has backbone, which is not one of them"):
        replace(PLAN, backbones=())
    with pytest.raises(InputError, match="n-0: given only '', expected 'head'"):
        replace(PLAN, recipes=(recipe("core", "n-0", only=""),))
    with pytest.raises(InputError, match="pilot_seeds: given range"):
        replace(PLAN, pilot_seeds=range(1, 4))
    with pytest.raises(InputError, match="recordings: tiny is not one of them"):
        replace(PLAN, recordings=())
    with pytest.raises(InputError, match="recordings: tiny does not have all of reach"):
        replace(PLAN, tasks=("reach",))
    with pytest.raises(InputError, match="expected evaluation seeds"):
        replace(PLAN, seeds=range(2_000_000, 2_000_025))
    monkeypatch.setattr(graphics, "check", lambda: None)
    assert main(["run", "--stages", "cor", "--out", str(tmp_path / "out")]) == 2
    assert (
        "--stages: unknown name 'cor', expected one of pilot, core, scaled, alignment"
        in capsys.readouterr().err
    )
    for chosen, said in (
        (["--recipes", "n-5"], "--recipes: unknown name 'n-5', expected one of n-0-pilot, n-32-pilot,"),
        (["--arms", "plain"], "--arms: unknown name 'plain', expected one of future-unread, future-blind,"),
        (
            ["--arms", "1-merged"],
            "--arms: 1-merged is in none of the stages steps, expected one of steps-of-1, steps-of-2,",
        ),
        (
            ["--recipes", "n-0-pilot"],
            "--recipes: n-0-pilot is in none of the stages steps, expected one of n-0,",
        ),
        (
            ["--stages", "instrument", "--recipes", "n-0"],
            "--recipes: n-0 is in none of the stages instrument, expected one of n-4, n-32,",
        ),
        (
            ["--stages", "instrument", "--arms", "mass-of-4", "--recipes", "n-4"],
            "--recipes: n-4 is in none of the stages instrument, expected one of n-32,",
        ),
        (
            ["--stages", "alignment", "--recipes", "n-4"],
            "--recipes: n-4 is in none of the stages alignment, expected one of n-4-aligned, n-32-aligned\n",
        ),
        (
            ["--stages", "core", "--arms", "steps-of-2"],
            "--arms: steps-of-2 is in none of the stages core, expected none\n",
        ),
        (
            ["--stages", "core", "--recipes", "n-0"],
            "--recipes: n-4, n-32 is missing, expected all or none of the core's\n",
        ),
    ):
        words = ["--stages", "steps", *chosen, "--out", str(tmp_path / "out")]
        assert main(["run", *words]) == 2
        assert said in capsys.readouterr().err


def test_scaled_first_weights_are_the_same_numbers() -> None:
    """Only category-specific weights are scaled; settings of before have no such entry."""
    scaled = replace(TINY, category_std=0.1)
    config = train.policy_config(TINY, RECORDING.settings, [TASK])
    plain, larger = (new_learner(one, config).state_dict() for one in (TINY, scaled))
    changed = {name for name, tensor in plain.items() if not tensor.equal(larger[name])}
    assert changed == {name for name in plain if name.endswith(".W")}
    assert len(changed) == 7  # two layers of the state's encoder, three of the actions', two of the decoder
    for name in changed:
        assert float((larger[name] - 5 * plain[name]).abs().max()) < 1e-6
    assert plans.BASE.category_std == TABLE_STD
    assert "category_std" not in TINY.to_dict()
    assert scaled.to_dict() == {**TINY.to_dict(), "category_std": 0.1}
    assert TrainingSettings(**scaled.to_dict()) == scaled
    for wrong in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError, match="category_std: given"):
            replace(TINY, category_std=wrong)
