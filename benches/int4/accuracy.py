"""Errors of actions against float32: int8, and int4 rounded plainly and for observations."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import saccade
from benches.checkpoints import written
from saccade import Policy
from saccade.checkpoints import Calibration, quantize
from saccade.datasets import open as open_recordings
from saccade.evaluation.recordings import SpacedObservations, fitted
from saccade.policy.reading import read_observations
from saccade_lab import random_checkpoint
from saccade_lab.published import CONFIGS, RELEASED

#: Observations that weights are rounded for, others that errors are measured on, and chunks of each of these.
CALIBRATED, MEASURED, SAMPLES = 24, 12, 4
#: Episodes of each of its tasks that the bundled policy is recorded in.
EPISODES = 4

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


def models(work: Path, *, small: bool) -> list[Model]:
    """The bundled policy, trained, on its own recordings; and random ones with planted outliers.

    Args:
        work: Folder that keeps recordings and checkpoints.
        small: Leaves out the one of published width.
    """
    found = [_bundled(work)]
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
    if not small:
        folders["n1.5, published width, 4 + 4 + 4 layers"] = _wide(work)
    for name, folder in folders.items():
        policy = Policy.from_pretrained(folder)
        examples = [policy.example_observation(seed=seed) for seed in range(CALIBRATED + MEASURED)]
        found.append(Model(f"outliers, {name}", folder, examples[:CALIBRATED], examples[CALIBRATED:]))
    return found


def _bundled(work: Path) -> Model:
    """The bundled policy in episodes of its own."""
    recordings, checkpoint = work / "recordings", saccade.demo_checkpoint()
    if not recordings.is_dir():
        arguments = ["rollout", "--episodes", str(EPISODES), "--record", str(recordings)]
        subprocess.run(
            [sys.executable, "-m", "saccade", *arguments, "--out", str(work / "rollout")], check=True
        )
    policy = Policy.from_pretrained(checkpoint)
    data = fitted(policy, open_recordings(recordings))
    both = SpacedObservations(policy, data, 2 * (CALIBRATED + MEASURED))
    held_out = [one for one, (episode, _) in zip(both, both.places, strict=True) if episode % 3 == 0]
    others = [one for one, (episode, _) in zip(both, both.places, strict=True) if episode % 3]
    return Model(
        "the bundled policy, its own episodes",
        checkpoint,
        others[:: max(1, len(others) // CALIBRATED)],
        held_out[:: max(1, len(held_out) // MEASURED)],
    )


def _wide(work: Path) -> Path:
    """Layers of N1.5's published width, but few of them and few words."""
    backbone, head = random_checkpoint.small_backbone("n1.5"), random_checkpoint.small_head("n1.5")
    released, full = RELEASED["n1.5"], CONFIGS["n1.5"]
    vocabulary = backbone["text_config"]["vocab_size"]
    backbone["text_config"] = {**released["text_config"], "vocab_size": vocabulary}
    backbone["vision_config"] = {**released["vision_config"], "num_hidden_layers": 4}
    backbone["select_layer"] = 4
    head["backbone_embedding_dim"] = full["backbone_embedding_dim"]
    head["vl_self_attention_cfg"] = {**full["vl_self_attention_cfg"], "num_layers": 1}
    head["diffusion_model_cfg"] = {**full["diffusion_model_cfg"], "num_layers": 4}
    for key in ("hidden_size", "input_embedding_dim"):
        head[key] = full[key]
    return written(work / "outliers-wide", backbone=backbone, head=head, outliers=True)


def actions_of(policy: Policy, observations: Observations) -> npt.NDArray[np.float64]:
    """Normalised actions of all observations, each from the same noise in every call."""
    found = []
    for index, observation in enumerate(observations):
        state = read_observations(observation, policy.requirements).state
        chunks = policy.sample(policy.encode(observation), state, seed=index, num_samples=SAMPLES)
        normalised = np.asarray(policy.normalizer.normalize_actions(chunks, state), np.float64)
        found.append(normalised[..., : policy.normalizer.head_action_width])
    return np.stack(found)


def features_of(policy: Policy, observations: Observations) -> npt.NDArray[np.float64]:
    """Features of the backbone, all tokens of all observations."""
    features = [policy.encode(observation).features[0].backbone_features for observation in observations]
    return np.concatenate([np.asarray(one, np.float64).reshape(-1, one.shape[-1]) for one in features])


def error(found: npt.NDArray[np.float64], exact: npt.NDArray[np.float64]) -> float:
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
    exact = model.policy()
    actions, features = actions_of(exact, model.measured), features_of(exact, model.measured)
    other = np.roll(actions, 1, axis=2)  # of the same observation, another sample
    assert not np.array_equal(other, actions)
    found: dict[str, Any] = {"other noise": {"actions": error(other, actions), "features": 0.0}}
    runs: dict[str, tuple[Path | None, str]] = {"bfloat16": (None, "bfloat16"), "int8": (None, "int8")}
    runs |= {name: (folder, "int4") for name, folder in folders.items()}
    for name, (folder, precision) in runs.items():
        policy = model.policy(folder, precision)
        found[name] = {
            "actions": error(actions_of(policy, model.measured), actions),
            "features": error(features_of(policy, model.measured), features),
        }
        note(f"{model.name}: {name} {found[name]}")
    return found
