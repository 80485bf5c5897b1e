"""Interventions and other arguments of a trace that the torch reference refuses."""

from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade import Intervention
from tests.helpers.intervention_loops import NUM_VL_TOKENS, head_and_inputs


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"cut": [("action", "vl")], "blocks": [1, 3]},
            r"cut: action reads vl in cross-attention blocks only, which are \[0, 2\]; .*got \[1, 3\]",
        ),
        (
            {"cut": [("future", "action")], "blocks": [0, 2]},
            r"cut: future reads action in self-attention blocks only, which are \[1, 3\]",
        ),
        (
            {"cut": [("action", "vl"), ("action", "future")], "blocks": 0},
            "cut: action reads future in self-attention blocks only",
        ),
        ({"key_bias": {"vl": 3.0}, "blocks": [1]}, "key_bias: vl is read in cross-attention blocks only"),
        ({"key_bias": {"state": 3.0}, "blocks": 2}, "key_bias: state is read in self-attention blocks only"),
        ({"cut": [("action", ("vl", ()))]}, "cut: expected at least one vl token, got an empty list"),
    ],
)
def test_what_can_act_nowhere_is_refused(change: dict[str, Any], message: str) -> None:
    head, inputs = head_and_inputs()
    one = Intervention(**change)
    for intervention in (one, [Intervention(), one]):
        with pytest.raises(saccade.InputError, match=message):
            head.sample(**inputs, intervention=intervention)
        with pytest.raises(saccade.InputError, match=message):
            head.trace(**inputs, intervention=intervention)


@pytest.mark.parametrize("name", ["blocks", "steps", "heads"])
@pytest.mark.parametrize("empty", [(), [], range(0), set(), np.empty(0, np.int64)])
def test_empty_limits_are_refused(name: str, empty: Any) -> None:
    with pytest.raises(saccade.InputError, match=f"{name}: expected at least one"):
        Intervention(cut=[("action", "vl")], **{name: empty})


def test_groups_without_tokens_cannot_be_changed() -> None:
    head, inputs = head_and_inputs(num_future_tokens=0)
    for change in (
        Intervention(cut=[("future", "vl")]),
        Intervention(cut=[("action", "future")]),
        Intervention(key_bias={"future": -1.0}),
        Intervention(patch={(0, 0): {"future": np.empty((0, 12), np.float32)}}),
    ):
        with pytest.raises(saccade.InputError, match="this call has no future tokens"):
            head.sample(**inputs, intervention=change)


@pytest.mark.parametrize(
    ("error", "message", "intervention"),
    [
        (saccade.InputError, "intervention: .*str", "cut"),
        (saccade.InputError, "intervention: ", [Intervention(), None]),
        (saccade.InputError, "blocks: 4, expected 0 to 3", Intervention(blocks=[1, 4])),
        (saccade.InputError, "steps: 3, expected 0 to 2", Intervention(steps=3)),
        (saccade.InputError, "heads: 3, expected 0 to 2", Intervention(heads=range(4))),
        (
            saccade.InputError,
            "cut: future: 4, expected 0 to 3",
            Intervention(cut=[("action", ("future", 4))]),
        ),
        (saccade.InputError, "cut: action: 5, ", Intervention(cut=[(("action", [0, 5]), "vl")])),
        (saccade.InputError, "cut: vl: 6, ", Intervention(cut=[("action", ("vl", 6))])),
        (
            saccade.InputError,
            "key_bias: state: 1, expected 0 to 0",
            Intervention(key_bias={("state", 1): 0.0}),
        ),
        (
            saccade.ShapeError,
            r"key_bias: future: .*\(3,\).*\(4\)",
            Intervention(key_bias={"future": [0.0] * 3}),
        ),
        (saccade.ShapeError, "key_bias: vl: ", Intervention(key_bias={("vl", (1, 2)): [0.0] * 6})),
        (saccade.InputError, "patch: step: 3, ", Intervention(patch={(3, 0): {"state": np.ones((1, 12))}})),
        (saccade.InputError, "patch: block: 4, ", Intervention(patch={(0, 4): {"state": np.ones((1, 12))}})),
        (
            saccade.InputError,
            "future: 4, ",
            Intervention(patch={(0, 0): {("future", 4): np.ones((1, 12))}}),
        ),
        (
            saccade.ShapeError,
            "future: .*expected ",
            Intervention(patch={(0, 0): {"future": np.ones((3, 12))}}),
        ),
        (saccade.ShapeError, "state: .*expected ", Intervention(patch={(0, 0): {"state": np.ones((1, 11))}})),
        (
            saccade.ShapeError,
            "state: .*expected ",
            Intervention(patch={(0, 0): {"state": np.ones((3, 1, 12))}}),
        ),
        (saccade.ShapeError, "future_tokens: ", Intervention(future_tokens=np.ones((4, 11)))),
        (
            saccade.InputError,
            "future_tokens: expected in at most one intervention, got 2",
            [Intervention(future_tokens=np.ones((4, 12)))] * 2,
        ),
        (
            saccade.InputError,
            "cut: future: 2, expected 0 to 1",
            [Intervention(future_tokens=np.ones((2, 12))), Intervention(cut=[("action", ("future", 2))])],
        ),
    ],
)
def test_interventions_that_do_not_fit_are_refused(
    error: type[Exception], message: str, intervention: Any
) -> None:
    head, inputs = head_and_inputs()
    for run in (head.sample, head.trace):
        with pytest.raises(error, match=message):
            run(**inputs, intervention=intervention)


def test_a_head_without_future_tokens_has_none_to_choose() -> None:
    head, inputs = head_and_inputs(num_future_tokens=0)
    with pytest.raises(saccade.InputError, match="cut: future: 0, expected no index"):
        head.sample(**inputs, intervention=Intervention(cut=[("action", ("future", 0))]))


def test_other_arguments_that_do_not_fit_are_refused() -> None:
    head, inputs = head_and_inputs()
    for drop_vl in (np.zeros((2, 5), bool), np.zeros(NUM_VL_TOKENS, bool)):
        with pytest.raises(saccade.ShapeError, match="drop_vl"):
            head.sample(**inputs, drop_vl=drop_vl)
        with pytest.raises(saccade.ShapeError, match="drop_vl"):
            head.encode(inputs["vl_embs"], drop_vl=drop_vl)
    with pytest.raises(saccade.DtypeError, match="drop_vl"):
        head.sample(**inputs, drop_vl=torch.zeros(2, NUM_VL_TOKENS))
    wrong_records: tuple[Any, ...] = ("hidden", ["attention", "rows"], 3)
    for record in wrong_records:
        with pytest.raises(saccade.InputError, match="record"):
            head.trace(**inputs, record=record)
    with pytest.raises(saccade.InputError, match="blocks: 4"):
        head.trace(**inputs, blocks=[4])
    with pytest.raises(saccade.InputError, match="steps: 2"):
        head.trace(**inputs, num_steps=2, steps=[2])
    wrong_stops: tuple[Any, ...] = ("future", [("future",)], [("vl", "future")], [("action", "image")])
    for stop in wrong_stops:
        with pytest.raises(saccade.InputError, match="stop_gradient"):
            head.sample(**inputs, stop_gradient=stop)
    with pytest.raises(saccade.InputError, match="stop_gradient: future: 4"):
        head.sample(**inputs, stop_gradient=[("action", ("future", 4))])
    noise = inputs.pop("noise")
    with pytest.raises(saccade.InputError, match="steps: 1, expected 0 to 0"):
        head.velocity(**inputs, actions=noise, timestep=0, intervention=Intervention(steps=1))
