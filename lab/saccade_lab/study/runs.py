"""Runs of ``saccade train`` in a study: planned, trained and read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade.errors import InputError
from saccade_lab.files import checkpoint_identity

if TYPE_CHECKING:
    from saccade_lab.training.settings import TrainingSettings

SETTINGS_FILE = "settings.json"


@dataclass(frozen=True)
class Planned:
    """A run to be trained.

    Attributes:
        name: Name of its directory.
        demonstrations: Directory of ``saccade demos``.
        training: Its settings.
    """

    name: str
    demonstrations: str
    training: TrainingSettings

    def settings(self) -> dict[str, Any]:
        """What ``settings.json`` of the run will contain."""
        from saccade_lab.sim import demos
        from saccade_lab.training.dataset import describe

        directory = Path(self.demonstrations)
        return {
            **self.training.to_dict(),
            "demonstrations": describe(directory, demos.recorded_tasks(directory)),
        }

    def train(self, out: Path, start: Path | None = None) -> None:
        """Trains the run on one thread, or continues the one in ``out``.

        Args:
            out: The run's directory.
            start: The policy to start from; None for random weights.
        """
        import torch

        from saccade_lab.training.train import train

        torch.set_num_threads(1)  # runs are spread over processes
        train(Path(self.demonstrations), out, self.training, lambda progress: None, start=start)


@dataclass(frozen=True)
class Run:
    """A trained policy, or one in training.

    Attributes:
        name: Name of its directory.
        directory: The run's directory.
        settings: Contents of ``settings.json``.
        history: Contents of ``history.json``.
        point: Names and values of what the sweep varies.
    """

    name: str
    directory: Path
    settings: Mapping[str, Any]
    history: Sequence[Mapping[str, float]]
    point: Mapping[str, float]

    @property
    def seed(self) -> int:
        """The training seed."""
        return int(self.settings["seed"])

    @property
    def step(self) -> int:
        """The last step of the training so far."""
        return int(self.history[-1]["step"]) if self.history else 0

    @property
    def checkpoint_sha256(self) -> str:
        """Hash of the policy's files, equal to ``Policy.checkpoint_sha256``."""
        return checkpoint_identity(self.directory)["sha256"]

    @property
    def finished(self) -> bool:
        """Whether the training is complete."""
        return self.step == int(self.settings["steps"])


def read_run(directory: Path, varied: Sequence[str]) -> Run:
    """A run of ``saccade train``.

    Raises:
        FileNotFoundError: There is none.
        InputError: Its files are not what ``saccade train`` writes.
    """
    from saccade.processor import Processor
    from saccade_lab.sim.policy import num_vl_tokens
    from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig

    if not (directory / SETTINGS_FILE).is_file():
        raise FileNotFoundError(
            f"{directory / SETTINGS_FILE}: no such file; expected a run of `saccade train`"
        )
    try:
        settings = json.loads((directory / SETTINGS_FILE).read_text(encoding="utf-8"))
        history_file = directory / "history.json"
        history = json.loads(history_file.read_text(encoding="utf-8")) if history_file.exists() else []
        config = SimulationConfig.from_file(directory / CONFIG_FILE)
        known = {
            **settings,
            "image_size": config.image_size,
            "num_cameras": len(config.cameras),
            "num_vl_tokens": num_vl_tokens(Processor.from_pretrained(directory), config),
        }
        return Run(directory.name, directory, settings, history, {name: known[name] for name in varied})
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{directory}: not written by `saccade train`: {error}") from None


def saved_step(state: Path) -> int:
    """The step at which a run can be continued from its ``training.pt``; 0 if there is none."""
    if not state.is_file():
        return 0
    import torch

    return int(torch.load(state, weights_only=True)["step"])


def find_runs(directories: Iterable[Path], varied: Sequence[str]) -> list[Run]:
    """All runs in directories of runs, sorted by what varies and then by seed.

    A run that has not written its policy yet is skipped.

    Raises:
        FileNotFoundError: A directory does not exist, or none of them contains a run.
    """
    from saccade_lab.sim.settings import TENSOR_FILE

    found = []
    for directory in directories:
        if not directory.is_dir():
            raise FileNotFoundError(f"{directory}: no such directory of policies")
        written = sorted(path.parent for path in directory.glob(f"*/{SETTINGS_FILE}"))
        found += [read_run(path, varied) for path in written if (path / TENSOR_FILE).is_file()]
    if not found:
        raise FileNotFoundError(f"{', '.join(map(str, directories))}: contain no runs of `saccade train`")
    return sorted(found, key=lambda run: (*run.point.values(), run.seed))


def describe_run(run: Run) -> dict[str, Any]:
    """The columns of the table that identify a policy."""
    return {
        "policy": run.name,
        **run.point,
        "training_seed": run.seed,
        "checkpoint_sha256": run.checkpoint_sha256,
    }
