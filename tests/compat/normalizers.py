"""The Normalizer against lerobot's own processor steps: `make test-compat` runs this in each environment."""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call, attr-defined"

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.policies.groot import processor_groot as released

from saccade import Normalizer
from tests.helpers import layout_files, layouts

IS_N15 = importlib.metadata.version("lerobot").startswith(("0.4", "0.5"))
BATCH, STEPS = 3, 7


def draw(*shape: int, seed: int) -> torch.Tensor:
    return 2 * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def packed(step: Any, state: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """What lerobot makes of a state and a chunk for its head."""
    found = step(
        {"observation": {"observation.state": state}, "action": action.clone(), "complementary_data": {}}
    )
    return found["observation"]["state"][:, 0], found["action"]


def assert_same(ours: Any, theirs: torch.Tensor, rounding: float = 0.0) -> None:
    """Bit for bit, or up to rounding."""
    torch.testing.assert_close(ours, theirs, rtol=5 * rounding, atol=rounding)


def flat(seed: int) -> dict[str, dict[str, torch.Tensor]]:
    """The statistics that `layouts` writes for a lerobot checkpoint."""
    found: dict[str, dict[str, torch.Tensor]] = {"observation.state": {}, "action": {}}
    for key, width, offset in (("observation.state", 7, 0), ("action", 6, 100)):
        for name, values in layout_files.flat_statistics(key, width, seed + offset).items():
            found[key][name.rpartition(".")[2]] = values
    return found


@pytest.mark.skipif(not IS_N15, reason="this lerobot has N1.7 only")
def test_n15(tmp_path: Path) -> None:
    layouts.write(tmp_path, "lerobot", seed=2)
    normalizer = Normalizer.from_pretrained(tmp_path)
    pack = released.GrootPackInputsStep(
        state_horizon=1, action_horizon=STEPS, max_state_dim=12, max_action_dim=8, stats=flat(2)
    )
    unpack = released.GrootActionUnpackUnnormalizeStep(env_action_dim=6, stats=flat(2))
    state, action, chunk = (
        draw(BATCH, 7, seed=0),
        draw(BATCH, STEPS, 6, seed=1),
        draw(BATCH, STEPS, 8, seed=2),
    )
    theirs = packed(pack, state, action)
    assert_same(normalizer.state(state), theirs[0])
    assert_same(normalizer.normalize_actions(action), theirs[1])
    robot = unpack({"action": chunk.reshape(-1, 8)})["action"].reshape(BATCH, STEPS, 6)
    assert_same(normalizer.actions(chunk), robot)


@pytest.mark.skipif(IS_N15, reason="this lerobot has N1.5 only")
def test_n17_flat(tmp_path: Path) -> None:
    layouts.write(tmp_path, "lerobot-n17", seed=2)
    normalizer = Normalizer.from_pretrained(tmp_path)
    pack = released.GrootN17PackInputsStep(max_state_dim=12, max_action_dim=10, stats=flat(2))
    unpack = released.GrootActionUnpackUnnormalizeStep(env_action_dim=6, stats=flat(2))
    state, action, chunk = draw(BATCH, 7, seed=0), draw(BATCH, 40, 6, seed=1), draw(BATCH, 40, 10, seed=2)
    theirs = packed(pack, state, action)
    assert_same(normalizer.state(state), theirs[0])
    assert_same(normalizer.normalize_actions(action), theirs[1])
    assert_same(normalizer.actions(chunk), unpack({"action": chunk})["action"])


@pytest.mark.skipif(IS_N15, reason="this lerobot has N1.5 only")
@pytest.mark.parametrize("use_percentiles", [False, True])
@pytest.mark.parametrize("relative", ["no", "one row", "a row a step"])
def test_n17_groups(relative: str, use_percentiles: bool, tmp_path: Path) -> None:
    """A raw checkpoint of Isaac-GR00T's, as lerobot reads it; actions absolute, or relative to the state."""
    layouts.write(tmp_path, "n17", seed=4)
    config = json.loads((tmp_path / "processor_config.json").read_text())
    statistics = json.loads((tmp_path / "statistics.json").read_text())
    kwargs = config["processor_kwargs"]
    kwargs |= {"use_percentiles": use_percentiles, "use_relative_action": relative != "no"}
    modality = kwargs["modality_configs"]["new_embodiment"]
    numbers = statistics["new_embodiment"]
    if relative != "no":
        absolute = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
        modality["action"]["action_configs"] = [{**absolute, "rep": "RELATIVE", "state_key": "arm"}, absolute]
        rows = [layout_files.group_statistics({"arm": 5}, seed)["arm"] for seed in range(16)]
        own = {name: [row[name] for row in rows] for name in rows[0]}
        numbers["relative_action"] = {"arm": own if relative == "a row a step" else rows[0]}
    layout_files.write_json(tmp_path / "processor_config.json", config)
    layout_files.write_json(tmp_path / "statistics.json", statistics)
    normalizer = Normalizer.from_pretrained(tmp_path, "new_embodiment")

    about = {"raw_stats": numbers, "modality_config": modality, "use_percentiles": use_percentiles}
    stats = {
        key: released.flatten_n1_7_modality_stats(
            embodiment_stats=numbers,
            embodiment_config=modality,
            modality=kind,
            use_percentiles=use_percentiles,
            use_relative_action=relative != "no",
        )
        for key, kind in (("observation.state", "state"), ("action", "action"))
    }
    pack = released.GrootN17PackInputsStep(
        action_horizon=40, valid_action_horizon=16, max_state_dim=12, max_action_dim=10, stats=stats, **about
    )
    decode = released.GrootN17ActionDecodeStep(
        env_action_dim=6, use_relative_action=relative != "no", pack_step=pack, **about
    )
    state, action, chunk = draw(BATCH, 7, seed=0), draw(BATCH, 16, 6, seed=1), draw(BATCH, 40, 10, seed=2)
    theirs = packed(pack, state, action)
    # lerobot computes in float32, Isaac-GR00T and saccade with the statistics' float64.
    assert_same(normalizer.state(state), theirs[0], rounding=2e-6)
    assert_same(normalizer.normalize_actions(action, state), theirs[1][:, :16], rounding=2e-6)
    robot = decode({"action": chunk})["action"]
    assert tuple(robot.shape) == (BATCH, 16, 6)
    assert_same(normalizer.actions(chunk, state), robot, rounding=2e-6)
