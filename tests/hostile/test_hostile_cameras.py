"""Files that name cameras may contain anything: the answer is cameras or a CheckpointError."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from saccade import CheckpointError
from saccade.observations import Requirements, read_requirements
from saccade.observations.checkpoint import FILES
from saccade.robots import Robot

KEYS = st.sampled_from(
    ["steps", "config", "language_key", "video_modality_keys", "input_features", "type", "VISUAL", "shape",
     "observation.images.front", "processor_kwargs", "modality_configs", "robot", "video", "language",
     "modality_keys", "delta_indices", "modalities", "resolution", "front"]
)  # fmt: skip
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 700) | st.floats(allow_nan=False) | KEYS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=25,
)


def requirements_of_n17(folder: Path, modality: str, config: dict[str, Any]) -> Requirements:
    configs = {"video": {"modality_keys": ["front"]}, modality: config}
    values = {"processor_kwargs": {"modality_configs": {"robot": configs}}}
    (folder / "processor_config.json").write_text(json.dumps(values))
    return read_requirements(folder, Robot("robot", None, (), (), 1, 1))


@pytest.mark.parametrize("modality", ["video", "state", "action"])
def test_steps_that_are_no_integers_are_named(modality: str, tmp_path: Path) -> None:
    given = requirements_of_n17(tmp_path, modality, {"delta_indices": [-3, 0]})
    assert getattr(given, f"{modality}_indices") == (-3, 0)
    assert getattr(requirements_of_n17(tmp_path, modality, {}), f"{modality}_indices") is None
    wrong: list[Any] = [None, "-3 0", 2, {}, [0, "1"], [0.0], [True], [[0]]]
    for steps in wrong:
        message = (
            rf"processor_config.json: robot: {modality}: delta_indices: expected a list of integers, got "
        )
        with pytest.raises(CheckpointError, match=message + re.escape(repr(steps))):
            requirements_of_n17(tmp_path, modality, {"delta_indices": steps})


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.dictionaries(KEYS, VALUES, max_size=4), config=st.dictionaries(KEYS, VALUES, max_size=3))
def test_any_json_is_cameras_or_an_error(
    name: str, values: dict[str, Any], config: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(values))
    (tmp_path / "config.json").write_text(json.dumps(config))
    for embodiment in ("robot", None):
        try:
            found = read_requirements(tmp_path, Robot(embodiment, None, (), (), 1, 1))
        except CheckpointError:
            continue
        assert isinstance(found, Requirements)
        for camera in found.cameras or ():
            assert isinstance(camera.name, str)
            assert camera.height is None or camera.height > 0
        assert all(isinstance(key, str) for key in found.language_keys)
        str(found)
