"""Inputs of heads: read from the released files, batches and draws, and files that do not fit."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.cli import main
from saccade.errors import InputError, ShapeError
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.table import read_table
from tests.helpers.released import Released, load_released

HEADS = ("n15_tiny", "n15_single_view", "n17_tiny")


def loaded(given: Released) -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(given.path, config=given.config, num_threads=1)


@pytest.mark.parametrize("name", HEADS)
def test_a_released_file_gives_the_released_actions(name: str) -> None:
    given = load_released(name)
    head = loaded(given)
    found = HeadInputs.from_file(given.path, head.config)
    assert len(found) == len(given.backbone_features)
    assert found.num_vl_tokens == given.backbone_features.shape[1]
    difference = np.abs(found.sample(head) - given.actions_f64)
    assert (difference <= given.tolerance).all()
    by_row = np.concatenate([one.sample(head) for one in found.rows()])
    np.testing.assert_array_equal(by_row, found.sample(head))


def test_masks_of_n17_are_kept_row_by_row() -> None:
    given = load_released("n17_tiny")
    found = HeadInputs.from_file(given.path, loaded(given).config)
    assert found.attention_mask is not None
    assert not found.attention_mask.all()
    assert found.image_mask is not None
    row = found.row(1)
    np.testing.assert_array_equal(row.attention_mask, given.options["attention_mask"][1:2])
    np.testing.assert_array_equal(row.image_mask, given.options["image_mask"][1:2])


def test_a_head_with_masks_is_studied_on_a_file(tmp_path: Path) -> None:
    """GR00T N1.7 needs the masks of its observations."""
    given = load_released("n17_tiny")
    (tmp_path / "config.json").write_text(json.dumps(given.config))
    arguments = ["--checkpoint", str(given.path), "--config", str(tmp_path / "config.json")]
    arguments += ["--features", str(given.path), "--out", str(tmp_path / "out")]
    assert main(["study", "cuts", *arguments, "--arms", "all-blind"]) == 0
    table = read_table(tmp_path / "out" / "cuts.csv").set_index(["arm", "seed"])
    head = loaded(given)
    blind = saccade.Intervention(cut=[(row, "vl") for row in ("state", "action")])
    for row, one in enumerate(HeadInputs.from_file(given.path, head.config).rows()):
        change = np.abs(one.sample(head, intervention=blind) - one.sample(head))
        assert table.loc[("all-blind", row), "chunk_change"] == pytest.approx(change.mean(), rel=1e-6)


def test_draws_of_noise() -> None:
    given = load_released("n15_tiny")
    head = loaded(given)
    whole = dataclasses.replace(HeadInputs.from_file(given.path, head.config), noise=None)
    assert whole.draws == 0
    drawn = whole.with_noise(np.random.default_rng(3), head.config, draws=3)
    assert drawn.draws == 3
    assert drawn.with_noise(np.random.default_rng(4), head.config) is drawn
    chunks = drawn.sample(head)
    assert chunks.shape == (2, 3, head.config.action_horizon, head.config.action_dim)
    for draw in range(3):
        np.testing.assert_array_equal(drawn.with_draw(draw).sample(head), chunks[:, draw])
    np.testing.assert_array_equal(
        np.asarray(drawn.with_draw(1).trace(head).actions), drawn.with_draw(1).sample(head)
    )


def test_random_observations_are_drawn_in_a_fixed_order() -> None:
    config = saccade.HeadConfig.from_dict(load_released("n15_tiny").config)
    found = HeadInputs.random(config, 7, np.random.default_rng(2), embodiment_id=1)
    rng = np.random.default_rng(2)
    np.testing.assert_array_equal(
        found.backbone_features, rng.standard_normal((1, 7, config.context_dim), dtype=np.float32)
    )
    np.testing.assert_array_equal(
        found.state, rng.standard_normal((1, config.num_states, config.state_dim), dtype=np.float32)
    )
    assert found.embodiment_id.tolist() == [1]
    repeated = found.repeated(3)
    assert len(repeated) == 3
    assert repeated.drop_vl is None
    np.testing.assert_array_equal(repeated.noise[2], found.noise[0])  # type: ignore[index]


def arrays(**changes: Any) -> dict[str, Any]:
    given = load_released("n15_tiny")
    names = ("backbone_features", "state", "embodiment_id", "noise")
    return {**{name: getattr(given, name) for name in names}, **changes}


def test_clusters_are_episodes_or_rows() -> None:
    config = saccade.HeadConfig.from_dict(load_released("n15_tiny").config)
    assert HeadInputs.from_arrays(arrays(), config, "file").clusters.tolist() == [0, 1]
    found = HeadInputs.from_arrays(arrays(episode=np.array([9, 9])), config, "file")
    assert found.clusters.tolist() == [0, 0]
    assert found.row(1).clusters.tolist() == [0]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"drop_vl": np.ones((2, 11), bool)}, InputError, "drop_vl: row 0 drops every position"),
        ({"drop_vl": np.ones((2, 3), bool)}, ShapeError, r"drop_vl: shape \(2, 3\), expected \(2, 11\)"),
        ({"attention_mask": np.zeros((2, 11), bool)}, InputError, "attention_mask: false entries"),
        ({"attention_mask": np.full((2, 11), 2)}, InputError, "attention_mask: expected booleans"),
        ({"episode": np.array([0.5, 1])}, InputError, "episode: float64"),
        ({"state": np.full((2, 1, 7), np.nan, np.float32)}, (InputError, ShapeError), "state"),
    ],
)
def test_what_no_head_takes_is_refused(changes: dict[str, Any], error: Any, message: str) -> None:
    config = saccade.HeadConfig.from_dict(load_released("n15_tiny").config)
    with pytest.raises(error, match=f"^file: .*{message}"):
        HeadInputs.from_arrays(arrays(**changes), config, "file")
