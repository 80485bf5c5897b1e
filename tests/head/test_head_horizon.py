"""`ActionHead.from_pretrained(action_horizon=)`: the bits of an edited config, in every layout."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch

import saccade
from saccade.checkpoints import describe
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers import layouts
from tests.helpers.engine_cases import TOLERANCE, arrays, same, save
from tests.helpers.reference_cases import relative_error, small_config, variant_config


def chunk(head: saccade.ActionHead) -> Any:
    inputs = arrays(random_inputs(head.config, 2, batch=2, num_vl_tokens=8))
    return head(**{**inputs, "embodiment_id": head.embodiment_ids[0]})


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
@pytest.mark.parametrize("horizon", [1, 7, 60])
def test_the_bits_of_an_edited_config(layout: str, horizon: int, tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "checkpoint", layout)
    head = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[31], action_horizon=horizon)
    assert head.config.action_horizon == horizon
    edited = describe(folder).head_config | {"action_horizon": horizon}
    expected = saccade.ActionHead.from_pretrained(folder, config=edited, embodiment_ids=[31])
    assert head.config == expected.config
    assert head.nbytes == expected.nbytes
    assert chunk(head).shape[1] == horizon
    assert same(chunk(head), chunk(expected))


@pytest.mark.parametrize("kind", ["n1.5", "n1.6", "n1.7"])
def test_another_chunk_as_the_reference_has_it(isa: str, kind: str, tmp_path: Path) -> None:
    config = small_config() if kind == "n1.5" else variant_config(kind)
    save(tmp_path, random_head(config, 3), config)
    own = saccade.HeadConfig.from_dict(config).action_horizon
    for horizon in (own - 2, own + 1):
        head = saccade.ActionHead.from_pretrained(tmp_path, action_horizon=horizon)
        reference = Reference.from_pretrained(tmp_path, action_horizon=horizon, dtype=torch.float64)
        longer = config | {"action_horizon": horizon}
        assert reference.config == Reference.from_pretrained(tmp_path, config=longer).config
        inputs = random_inputs(head.config, 4, batch=2, num_vl_tokens=6)
        with torch.no_grad():
            assert relative_error(head(**arrays(inputs)), reference(**inputs)) <= TOLERANCE


def test_one_that_the_config_has_changes_nothing(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "n17", "n17")
    plain = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[3])
    head = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[3], action_horizon=40)
    assert (head.config, head.nbytes) == (plain.config, plain.nbytes)
    assert same(chunk(head), chunk(plain))


def test_it_survives_pickling(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "lerobot", "lerobot")
    head = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[3], action_horizon=9)
    again = pickle.loads(pickle.dumps(head))
    assert again.config == head.config
    assert same(chunk(again), chunk(head))


def test_more_than_the_position_table_has_is_refused(tmp_path: Path) -> None:
    config = small_config()  # a table of seven rows
    save(tmp_path, random_head(config, 3), config)
    assert saccade.ActionHead.from_pretrained(tmp_path, action_horizon=7).config.action_horizon == 7
    with pytest.raises(saccade.InputError, match=r"action_horizon: expected 1 to 7 .*max_seq_len.*got 8"):
        saccade.ActionHead.from_pretrained(tmp_path, action_horizon=8)
    with pytest.raises(saccade.InputError, match="action_horizon: expected 1 to 7, got 8"):
        Reference.from_pretrained(tmp_path, action_horizon=8)


def test_a_head_without_positions_has_no_such_limit(tmp_path: Path) -> None:
    config = small_config(add_pos_embed=False)
    save(tmp_path, random_head(config, 3), config)
    assert chunk(saccade.ActionHead.from_pretrained(tmp_path, action_horizon=50)).shape[1] == 50
    with pytest.raises(saccade.InputError, match=r"action_horizon: expected 1 to 1048576, got 2097152"):
        saccade.ActionHead.from_pretrained(tmp_path, action_horizon=2**21)


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "8", 2**63])
def test_what_is_no_number_of_actions(wrong: Any, tmp_path: Path) -> None:
    config = small_config()
    save(tmp_path, random_head(config, 3), config)
    with pytest.raises(saccade.InputError, match="action_horizon: expected"):
        saccade.ActionHead.from_pretrained(tmp_path, action_horizon=wrong)
    assert json.loads((tmp_path / "config.json").read_text()) == config
