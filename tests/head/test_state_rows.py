"""`ActionHead.from_pretrained(num_states=)`: heads of N1, N1.5 and N1.6 make a state row of each state."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import saccade
from saccade import Intervention
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference import lerobot_head
from saccade_lab.reference.random_weights import random_head, random_inputs
from saccade_lab.reference.state_dropout import STATE_DROPOUT
from tests.helpers.engine_cases import TOLERANCE, arrays, same, save
from tests.helpers.int4_cases import HEAD_BLOCKS, with_int4_weights
from tests.helpers.reference_cases import relative_error, small_config, variant_config

KINDS = ("n1", "n1.5", "n1.6")

#: lerobot's class calls torch's float32 sin and cos, see test_lerobot_parity.py.
LEROBOT = 3e-4


def config_of(kind: str) -> dict[str, Any]:
    return small_config() if kind == "n1.5" else variant_config(kind)


def both(
    folder: Path, kind: str, num_states: int, precision: str = "float32"
) -> tuple[saccade.ActionHead, Reference, dict[str, Tensor]]:
    """The head, the reference in float64 and inputs for two observations."""
    save(folder, random_head(config_of(kind), 3), config_of(kind))
    head = saccade.ActionHead.from_pretrained(folder, num_states=num_states, precision=precision)
    reference = Reference.from_pretrained(folder, num_states=num_states, dtype=torch.float64)
    assert head.config == reference.config
    return head, reference, random_inputs(head.config, 4, batch=2, num_vl_tokens=6)


def apart(inputs: dict[str, Any]) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Features, masks, and the rest."""
    rest = dict(inputs)
    features = rest.pop("backbone_features")
    masks: dict[str, Any] = {}
    for name in ("attention_mask", "image_mask"):
        if name in rest:
            masks[name] = rest.pop(name)
    return features, masks, rest


@pytest.mark.parametrize("num_states", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_the_references(isa: str, kind: str, num_states: int, tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, kind, num_states)
    assert (head.isa, head.config.num_states, head.config.state_history) == (isa, num_states, 1)
    assert inputs["state"].shape == (2, num_states, head.config.state_dim)
    with torch.no_grad():
        assert relative_error(head(**arrays(inputs)), reference(**inputs)) <= TOLERANCE
        # With the keys and values of two state rows held.
        refreshed = reference(**inputs, future_refresh=2)
    assert relative_error(head(**arrays(inputs), future_refresh=2), refreshed) <= TOLERANCE


@pytest.mark.parametrize("num_states", [2, 3])
def test_actions_are_those_of_the_released_code(num_states: int, tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, "n1.5", num_states)
    theirs = lerobot_head.build(config_of("n1.5"))
    theirs.load_state_dict(reference.float().state_dict(), strict=True)
    names = ("backbone_features", "state", "embodiment_id", "noise")
    actions = lerobot_head.get_action(theirs, *(inputs[name] for name in names))
    assert relative_error(head(**arrays(inputs)), actions) <= LEROBOT


def test_every_state_acts(tmp_path: Path) -> None:
    head, _, inputs = both(tmp_path, "n1.5", 3)
    given = arrays(inputs)
    plain = head(**given)
    for index in range(3):
        state = given["state"].copy()
        state[:, index] += 1
        assert np.abs(head(**(given | {"state": state})) - plain).max() > 1e-3
    assert not same(head(**(given | {"state": given["state"][:, ::-1]})), plain)


@pytest.mark.parametrize("kind", KINDS)
def test_one_state_is_the_default(kind: str, tmp_path: Path) -> None:
    head, _, inputs = both(tmp_path, kind, 1)
    plain = saccade.ActionHead.from_pretrained(tmp_path)
    assert (plain.config, plain.nbytes) == (head.config, head.nbytes)
    given = arrays(inputs)
    expected = plain(**given)
    assert same(head(**given), expected)
    assert same(head(**(given | {"state": given["state"][:, 0]})), expected)


@pytest.mark.parametrize("precision", ["bfloat16", "int8", "int4"])
@pytest.mark.parametrize("kind", ["n1.5", "n1.6"])
def test_an_observation_has_the_same_bits_in_any_batch(kind: str, precision: str, tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, kind, 2, precision)
    given = arrays(inputs)
    many = head(**given)
    for row in range(2):
        one = {name: array[row : row + 1] for name, array in given.items()}
        assert same(head(**one), many[row : row + 1])
        features, masks, rest = apart(one)
        noise = np.repeat(rest.pop("noise")[:, None], 2, axis=1)
        samples = head.sample(head.encode(features, **masks), **rest, noise=noise, num_samples=2)
        assert same(samples[:, 1], many[row : row + 1])
    if precision == "int4":
        reference.load_state_dict(with_int4_weights(reference.state_dict(), HEAD_BLOCKS))
    with torch.no_grad():
        assert relative_error(many, reference(**inputs)) <= 0.1


@pytest.mark.parametrize("kind", ["n1.5", "n1.6"])
def test_velocity_and_trace(kind: str, tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, kind, 2)
    config = head.config
    features, masks, rest = apart(arrays(inputs))
    context = head.encode(features, **masks)
    trace = head.trace(context, **rest, record=("attention", "hidden"))
    future = config.num_future_tokens
    assert trace.rows == {
        "state": slice(0, 2),
        "future": slice(2, 2 + future),
        "action": slice(2 + future, config.num_rows),
    }
    assert config.num_rows == 2 + future + config.action_horizon
    assert same(trace.actions, head.sample(context, **rest))
    with torch.no_grad():
        vl_embs = reference.encode(inputs["backbone_features"])
        expected = reference.trace(vl_embs, **rest, **masks, record=("attention", "hidden"))
    assert expected.rows == trace.rows
    for mine, theirs in ((trace.attention, expected.attention), (trace.hidden, expected.hidden)):
        assert mine.keys() == theirs.keys()
        for place, array in mine.items():
            assert relative_error(array, theirs[place]) <= TOLERANCE
    actions, timestep = rest.pop("noise"), np.array([0, 700])
    with torch.no_grad():
        velocity = reference.velocity(vl_embs, **rest, **masks, actions=actions, timestep=timestep)
    found = head.velocity(context, **rest, actions=actions, timestep=timestep)
    assert relative_error(found, velocity) <= TOLERANCE


@pytest.mark.parametrize("kind", ["n1.5", "n1.6"])
def test_without_the_second_row_it_is_the_head_of_one_state(kind: str, tmp_path: Path) -> None:
    head, _, inputs = both(tmp_path, kind, 2)
    given = arrays(inputs)
    groups = ("state", "future", "action") if head.config.num_future_tokens else ("state", "action")
    cut = Intervention(cut=[(reader, ("state", [1])) for reader in groups])
    one = saccade.ActionHead.from_pretrained(tmp_path)
    for kept in (0, 1):
        state = given["state"][:, [kept, 1 - kept]]
        expected = one(**(given | {"state": given["state"][:, kept]}))
        assert relative_error(head(**(given | {"state": state}), intervention=cut), expected) <= TOLERANCE
        assert relative_error(head(**(given | {"state": state})), expected) > 100 * TOLERANCE


@pytest.mark.parametrize("kind", ["n1.5", "n1.6"])
def test_changes_of_one_of_the_rows(kind: str, tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, kind, 3)
    rows = np.random.default_rng(0).standard_normal((2, head.config.width))
    changes = (
        Intervention(cut=[("action", ("state", [0, 2]))], heads=[1]),
        Intervention(key_bias={("state", (1,)): -2.0, ("action", (0,)): 1.0}),
        Intervention(
            patch={(0, 0): {("state", (2, 0)): rows}, (1, 1): {"state": rows[:1].repeat(3, axis=0)}}
        ),
    )
    plain = head(**arrays(inputs))
    for change in (*changes, list(changes)):
        with torch.no_grad():
            expected = reference(**inputs, intervention=change)
        found = head(**arrays(inputs), intervention=change)
        assert relative_error(found, expected) <= TOLERANCE
        assert relative_error(found, plain) > 10 * TOLERANCE
    with pytest.raises(saccade.InputError, match="cut: state token 3, expected 0 to 2"):
        head(**arrays(inputs), intervention=Intervention(cut=[("action", ("state", [3]))]))
    late = Intervention(patch={(1, 0): {("state", (1,)): rows[:1]}})
    with pytest.raises(saccade.InputError, match="expected action tokens"):
        head(**arrays(inputs), intervention=late, future_refresh=2)


def test_states_that_are_always_dropped_are_all_zero() -> None:
    config = config_of("n1.5")
    sizes = saccade.HeadConfig.from_dict(config, num_states=2)
    reference = Reference(sizes, has_state_dropout=True)
    probabilities = torch.zeros(sizes.num_embodiments)
    probabilities[1] = 1.0
    weights = {**random_head(config, 5).state_dict(), STATE_DROPOUT: probabilities}
    reference.load_state_dict(weights)
    head = saccade.ActionHead.from_tensors(weights, config=config, num_states=2)
    inputs = random_inputs(sizes, 6, batch=2, num_vl_tokens=6) | {"embodiment_id": torch.tensor([0, 1])}
    with torch.no_grad():
        assert relative_error(head(**arrays(inputs)), reference.double()(**inputs)) <= TOLERANCE
    given = arrays(inputs)
    other = head(**(given | {"state": given["state"] + 1}))
    assert same(other[1], head(**given)[1])
    assert not same(other[0], head(**given)[0])


def test_a_head_of_tensors_and_a_pickled_one(tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, "n1.6", 2)
    head.warmup(6, batch=2, num_samples=2, future_refresh=2)
    expected = head(**arrays(inputs))
    again = pickle.loads(pickle.dumps(head))
    assert again.config == head.config
    assert same(again(**arrays(inputs)), expected)
    tensors = reference.float().state_dict()
    made = saccade.ActionHead.from_tensors(tensors, config=config_of("n1.6"), num_states=2)
    assert same(made(**arrays(inputs)), expected)


def test_other_numbers_of_states_are_refused(tmp_path: Path) -> None:
    head, reference, inputs = both(tmp_path, "n1.5", 2)
    state = inputs["state"]
    for wrong in (state[:, 0], state[:, :1], torch.cat((state, state), dim=1)):
        with pytest.raises(
            saccade.ShapeError, match=r"state: expected the last 2 states, \(batch, num_states"
        ):
            head(**arrays(inputs | {"state": wrong}))
        with pytest.raises(saccade.ShapeError, match="state"):
            reference(**(inputs | {"state": wrong}))
    with pytest.raises(saccade.ShapeError, match=r"state: .* \(batch, num_states, state_dim\)"):
        saccade.ActionHead.from_pretrained(tmp_path)(**arrays(inputs))


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "2", 2**21, 2**63])
def test_what_is_no_number_of_states(wrong: Any, tmp_path: Path) -> None:
    config = config_of("n1.5")
    save(tmp_path, random_head(config, 3), config)
    for load in (saccade.ActionHead.from_pretrained, Reference.from_pretrained):
        with pytest.raises(saccade.InputError, match="num_states: expected"):
            load(tmp_path, num_states=wrong)


def test_n17_takes_the_states_of_its_config_only(tmp_path: Path) -> None:
    config = variant_config("n1.7", state_history=3)
    save(tmp_path, random_head(config, 3), config)
    head = saccade.ActionHead.from_pretrained(tmp_path, num_states=3)
    assert head.config == saccade.ActionHead.from_pretrained(tmp_path).config
    assert (head.config.num_states, head.config.num_state_rows, head.config.state_history) == (3, 1, 3)
    for load in (saccade.ActionHead.from_pretrained, Reference.from_pretrained):
        with pytest.raises(
            saccade.InputError, match=r"num_states: expected 3, .*state_history_length.*got 6"
        ):
            load(tmp_path, num_states=6)
