"""Files that name cameras may contain anything: the answer is cameras or a CheckpointError."""

from __future__ import annotations

import json
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
