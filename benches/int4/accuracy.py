"""Errors of actions against float32: int8, and int4 rounded plainly and for observations."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

import saccade
from benches.backbone.accuracy import checkpoint as wide_checkpoint
from benches.checkpoints import written
from saccade import Policy
from saccade.checkpoints import Calibration, quantize
from saccade.datasets import open as open_recordings
from saccade.evaluation.recordings import SpacedObservations, fitted
from saccade.policy.reading import read_observations
from saccade_lab import random_checkpoint
from saccade_lab.files import checkpoint_identity
from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig

#: Observations that weights are rounded for, others that errors are measured on, and chunks of each of these.
CALIBRATED, MEASURED, SAMPLES = 24, 12, 4
#: Episodes that a trained policy is recorded in, an equal number of each of its tasks.
EPISODES = 20

Floats: TypeAlias = npt.NDArray[np.float64]
Note = Callable[[str], None]
Observations = Sequence[Any]


@dataclass(frozen=True)
class Model:
    """A checkpoint, and observations of it.

    Attributes:
        name: For the page.
        checkpoint: Its directory.
        calibrated: Observations that weights are rounded for.
        measured: Others.
    """

    name: str
    checkpoint: Path
    calibrated: Observations
    measured: Observations

    def policy(self, folder: Path | None = None, precision: str = "float32") -> Policy:
        """The policy, or that of a changed copy."""
        return Policy.from_pretrained(folder or self.checkpoint, precision=precision)


@dataclass(frozen=True)
class Trained(Model):
    """A policy of the simulator, with observations of its own episodes.

    Attributes:
        tasks: That it was trained on.
        sha256: Of its files, see `saccade_lab.files.checkpoint_identity`.
        settings: Of its training; None for the bundled policy, whose page tells them.
    """

    tasks: tuple[str, ...]
    sha256: str
    settings: Mapping[str, Any] | None

    def about(self) -> dict[str, Any]:
        """What tells it from others."""
        return {"tasks": list(self.tasks), "sha256": self.sha256, "settings": self.settings}


def random_models(work: Path, *, small: bool) -> list[Model]:
    """Random models with planted outliers, and random observations.

    Args:
        work: Folder that keeps checkpoints.
        small: Leaves out the one of published width.
    """
    folders = {
        f"{version}, small": written(
            work / f"outliers-{version}",
            version=version,
            backbone=random_checkpoint.small_backbone(version),
            head=random_checkpoint.small_head(version),
            outliers=True,
        )
        for version in ("n1.5", "n1.6", "n1.7")
    }
    found: list[Model] = []
    if not small:
        name = "n1.5, backbone of published width, 4 + 4 layers"
        folders[name] = wide_checkpoint(work, outliers=True, layers=(4, 4), small=False)
    for name, folder in folders.items():
        policy = Policy.from_pretrained(folder)
        examples = [policy.example_observation(seed=seed) for seed in range(CALIBRATED + MEASURED)]
        found.append(Model(f"outliers, {name}", folder, examples[:CALIBRATED], examples[CALIBRATED:]))
    return found


def trained(checkpoint: Path, work: Path) -> Trained:
    """A policy that `saccade train` wrote, in episodes of its own, which are recorded first.

    Args:
        checkpoint: Its directory.
        work: Folder that keeps the recordings.
    """
    tasks = SimulationConfig.from_file(checkpoint / CONFIG_FILE).tasks
    bundled = checkpoint == saccade.demo_checkpoint()
    name = "the bundled policy" if bundled else f"a policy for {', '.join(tasks)}"
    sha256 = checkpoint_identity(checkpoint)["sha256"]
    recordings = work / f"recordings-{sha256[:12]}"  # there when all episodes are
    if not recordings.is_dir():
        arguments = ["rollout", "--checkpoint", str(checkpoint), "--tasks", ",".join(tasks)]
        arguments += ["--episodes", str(EPISODES // len(tasks)), "--record", str(recordings)]
        arguments += ["--out", str(work / f"rollout-{sha256[:12]}")]
        subprocess.run([sys.executable, "-m", "saccade", *arguments], check=True)
    policy = Policy.from_pretrained(checkpoint)
    data = fitted(policy, open_recordings(recordings))
    both = SpacedObservations(policy, data, 3 * (CALIBRATED + MEASURED))
    held_out = [one for one, (episode, _) in zip(both, both.places, strict=True) if episode % 3 == 0]
    others = [one for one, (episode, _) in zip(both, both.places, strict=True) if episode % 3]
    settings = None if bundled else json.loads((checkpoint / "settings.json").read_text())
    chosen = spaced(others, CALIBRATED), spaced(held_out, MEASURED)
    return Trained(name, checkpoint, *chosen, tasks, sha256, settings)


def spaced(observations: Sequence[Any], count: int) -> list[Any]:
    """As many of them, evenly spaced.

    Example:
        >>> spaced(range(11), 3)
        [0, 5, 10]
    """
    places = np.linspace(0, len(observations) - 1, count).round().astype(int)
    if len(set(places)) < count:
        raise SystemExit(
            f"benches.int4: {len(observations)} recorded observations, expected at least {count}"
        )
    return [observations[place] for place in places]


def results_of(policy: Policy, observations: Observations) -> tuple[Floats, Floats]:
    """Normalised actions of all observations, each from the same noise in every call, and their features."""
    actions, features = [], []
    for index, observation in enumerate(observations):
        state = read_observations(observation, policy.requirements).state
        context = policy.encode(observation)
        chunks = policy.sample(context, state, seed=index, num_samples=SAMPLES)
        normalised = np.asarray(policy.normalizer.normalize_actions(chunks, state), np.float64)
        actions.append(normalised[..., : policy.normalizer.head_action_width])
        tokens = np.asarray(context.features[0].backbone_features, np.float64)
        features.append(tokens.reshape(-1, tokens.shape[-1]))
    return np.stack(actions), np.concatenate(features)


def error(found: Floats, exact: Floats) -> float:
    """Root of the sum of squared differences, relative to that of the squares."""
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def copies(model: Model, work: Path) -> dict[str, Path]:
    """The checkpoint in four bits, rounded plainly and for observations."""
    folders = {"int4": work / "plain", "int4, calibrated": work / "calibrated"}
    for folder in folders.values():  # that of the model before has other files
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(folder.with_name(f"{folder.name}.calibrating"), ignore_errors=True)
    quantize(model.checkpoint, folders["int4"], to="int4")
    given = Calibration(model.policy(), model.calibrated)
    quantize(model.checkpoint, folders["int4, calibrated"], to="int4", calibration=given)
    return folders


def measure(model: Model, folders: dict[str, Path], note: Note) -> dict[str, Any]:
    """The errors of actions and features by precision, and of float32 from other noise."""
    actions, features = results_of(model.policy(), model.measured)
    other = np.roll(actions, 1, axis=2)  # of the same observation, another sample
    assert not np.array_equal(other, actions)
    found: dict[str, Any] = {"other noise": {"actions": error(other, actions), "features": 0.0}}
    runs: dict[str, tuple[Path | None, str]] = {"bfloat16": (None, "bfloat16"), "int8": (None, "int8")}
    runs |= {name: (folder, "int4") for name, folder in folders.items()}
    for name, (folder, precision) in runs.items():
        changed = results_of(model.policy(folder, precision), model.measured)
        found[name] = {"actions": error(changed[0], actions), "features": error(changed[1], features)}
        note(f"{model.name}: {name} {found[name]}")
    return found
