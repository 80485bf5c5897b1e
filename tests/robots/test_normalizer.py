"""A robot's units to the head's and back: mappings, arrays of every kind, there and back in every mode."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

import saccade
from saccade import Normalizer
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from tests.helpers import layout_files
from tests.helpers.normalizer_cases import as_array, data_config, draw, metadata, row
from tests.helpers.published import sidecars

# --- mappings ---


def test_an_id_may_be_given_for_a_robot_without_one() -> None:
    """The demo's robot is none of the released code's: the id selects the head's embodiment."""
    assert Normalizer.from_pretrained(DEMO_CHECKPOINT, 0).embodiment == "metaworld_sawyer"
    assert saccade.Policy.from_pretrained(DEMO_CHECKPOINT, embodiment=0, num_threads=1).embodiment_id == 0
    with pytest.raises(saccade.InputError, match=r"embodiment_id|embodiment"):
        saccade.Policy.from_pretrained(DEMO_CHECKPOINT, embodiment=3)
    with pytest.raises(saccade.InputError, match="expected one of those in"):
        Normalizer.from_pretrained(DEMO_CHECKPOINT, "gr1")


def test_mappings_may_be_lerobots_or_plain() -> None:
    plain = Normalizer.from_pretrained({"state": row(3, 0), "action": row(2, 1)}, 7)
    theirs = Normalizer.from_pretrained({"observation.state": row(3, 0), "action": row(2, 1)}, "gr1")
    assert (plain.embodiment, plain.embodiment_id) == (None, 7)
    assert (theirs.embodiment, theirs.embodiment_id) == ("gr1", 24)
    assert np.array_equal(as_array(plain.state(draw(2, 3))), as_array(theirs.state(draw(2, 3))))


sizes = st.integers(1, 9)


@settings(max_examples=40, deadline=None)
@given(
    groups=st.lists(
        st.tuples(sizes, st.sampled_from(["min_max", "q99", "mean_std"])), min_size=1, max_size=4
    ),
    seed=st.integers(0, 2**20),
    padding=st.integers(0, 5),
)
def test_there_and_back(groups: list[tuple[int, str]], seed: int, padding: int) -> None:
    """Within the statistics' range nothing is lost but the constants, which come back as the constant."""
    rng = np.random.default_rng(seed)
    names = [f"key{number}" for number in range(len(groups))]
    statistics = {
        name: row(size, seed + number, constant=int(rng.integers(2 * size)))
        for number, (name, (size, _)) in enumerate(zip(names, groups, strict=True))
    }
    entry = {"state": statistics, "action": statistics}
    modes = {f"{kind}.{name}": mode for kind in entry for name, (_, mode) in zip(names, groups, strict=True)}
    total = sum(size for size, _ in groups)
    about = {
        kind: {name: {"shape": [size]} for name, (size, _) in zip(names, groups, strict=True)}
        for kind in entry
    }
    normalizer = Normalizer.from_pretrained(
        {"robot": {"statistics": entry, "modalities": {**about, "video": {"front": {}}}}},
        data_config=data_config(
            {key: mode for key, mode in modes.items() if key.startswith("state.")},
            {key: mode for key, mode in modes.items() if key.startswith("action.")},
            state_keys=[f"state.{name}" for name in names],
            action_keys=[f"action.{name}" for name in names],
        ),
        state_dim=total + padding,
        action_dim=total + padding,
    )
    low, high = (
        np.concatenate([np.array(statistics[name][bound]) for name in names]) for bound in ("q01", "q99")
    )
    robot = (low + rng.random((2, 3, total)) * (high - low)).astype(np.float32)
    for there, back in (
        (normalizer.state, normalizer.denormalize_state),
        (normalizer.normalize_actions, normalizer.actions),
    ):
        normalised = as_array(there(robot))
        assert normalised.shape == (2, 3, total + padding)
        assert not normalised[..., total:].any()
        moving = low != high
        assert np.allclose(as_array(back(normalised))[..., moving], robot[..., moving], atol=1e-5)
        for name, (_, mode) in zip(names, groups, strict=True):
            where = normalizer.state_slices[name]
            still = ~moving[where]
            if mode == "min_max":
                bound = np.array(statistics[name]["min"], np.float32)[still]
                assert np.array_equal(
                    as_array(back(normalised))[..., where][..., still],
                    np.broadcast_to(bound, (2, 3, still.sum())),
                )


# --- arguments ---


def test_arrays_of_every_kind() -> None:
    normalizer = Normalizer.from_pretrained({"state": row(3, 0), "action": row(2, 1)})
    state = draw(4, 3)
    expected = as_array(normalizer.state(state))
    assert np.array_equal(as_array(normalizer.state(state.astype(np.float64))), expected)
    assert np.array_equal(as_array(normalizer.state(np.asfortranarray(state))), expected)
    assert np.array_equal(as_array(normalizer.state(state[2])), expected[2])
    assert as_array(normalizer.state(state[:0])).shape == (0, 3)
    found = normalizer.state(torch.from_numpy(state))
    assert isinstance(found, torch.Tensor)
    assert np.array_equal(found.numpy(), expected)
    integers = np.array([[1, -2, 3]])
    assert np.array_equal(as_array(normalizer.state(integers)), as_array(normalizer.state(1.0 * integers)))
    with pytest.raises(saccade.DtypeError, match=r"state: .* holds exactly, got int64 16777217: .*astype"):
        normalizer.state(np.array([[1, 2, 2**24 + 1]]))
    with pytest.raises(saccade.DtypeError, match="state"):
        normalizer.state(np.ones((1, 3), bool))
    before = state.copy()
    expected[:] = 0
    assert np.array_equal(state, before)


def test_a_state_of_the_wrong_width_names_the_robot_and_its_parts() -> None:
    normalizer = Normalizer.from_pretrained(metadata())
    with pytest.raises(
        saccade.ShapeError,
        match=r"state: the Normalizer of 'new_embodiment' expected \(\.\.\., 5\) in the robot's units "
        r"\(arm 3, gripper 2\), got \(1, 64\)",
    ):
        normalizer.state(np.zeros((1, 64)))
    for values in (np.float32(1.0), np.zeros((2, 4))):
        with pytest.raises(saccade.ShapeError, match="state"):
            normalizer.state(values)
    with pytest.raises(saccade.ShapeError, match=r"actions: the Normalizer expected \(\.\.\., at least 4\)"):
        normalizer.actions(np.zeros((1, 16, 3)))
    with pytest.raises(saccade.InputError, match=r"state: expected finite numbers, .* in arm"):
        normalizer.state(np.array([[0.0, np.nan, 0, 0, 0]]))


def test_a_wide_state_is_cut_off_as_the_code_bases_do() -> None:
    wide, narrow = (
        Normalizer.from_pretrained(metadata(), state_dim=9),
        Normalizer.from_pretrained(metadata(), state_dim=4),
    )
    assert np.array_equal(as_array(narrow.state(draw(2, 5))), as_array(wide.state(draw(2, 5)))[:, :4])


def test_statistics_may_have_any_dtype(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")
    expected = as_array(Normalizer.from_pretrained(tmp_path).state(draw(1, 7)))
    statistics = layout_files.flat_statistics("observation.state", 7, 0) | layout_files.flat_statistics(
        "action", 6, 100
    )
    doubles = {name: values.double().numpy() for name, values in statistics.items()}
    for path in tmp_path.glob("policy_*.safetensors"):
        save_file({**doubles, "action.count": np.array([5])}, path)
    assert np.array_equal(as_array(Normalizer.from_pretrained(tmp_path).state(draw(1, 7))), expected)


def test_it_says_what_it_is() -> None:
    text = repr(Normalizer.from_pretrained(metadata()))
    assert "new_embodiment" in text
    assert "arm 3 min_max, gripper 2 min_max) to 5" in text
