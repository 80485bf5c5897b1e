"""Does `saccade diagnose` see diseases that training brought about? Four small policies, trained and judged.

    python studies/diagnosis/trained.py train DEMOS OUT
    python studies/diagnosis/trained.py judge DEMOS OUT

DEMOS is what `studies/guidance/guidance.py demos` wrote.
`healthy` is trained on all demonstrations of the guidance study but the last ten of each task; `constant` on
the same with one instruction for all of them; `black` with one camera black; `leak` with the expert's action
in place of the state.
Each is judged on the ten others of each task, changed as its training ones were, and, but for `leak`, on the
unchanged ones. Every part resumes where it stopped. README.md says what was expected.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from saccade._internal.files import write_atomically, write_json
from saccade_lab.sim import demos
from saccade_lab.sim.recordings import Recording, write_recordings
from saccade_lab.sim.tasks import find_task
from saccade_lab.study.code_version import code_version
from saccade_lab.training.settings import TrainingSettings

TASKS = ("touch-yellow", "touch-blue")
JUDGED = 10  # demonstrations of each task, none of them trained on
BLACK = 2  # place of the camera that is black
#: Those with which the guidance study's balanced policy learned the task on a GPU.
SETTINGS = TrainingSettings(steps=2200, batch_size=64, learning_rate=1.2e-3, absent_share=0.0)
#: The released default for a missing instruction, which is what `constant` is trained with.
TEXT = "Perform the default behavior."
POLICIES = ("healthy", "constant", "black", "leak")


def changed(one: demos.Demonstration, policy: str) -> demos.Demonstration:
    """A demonstration with the disease in it."""
    if policy == "black":
        images = one.images.copy()
        images[:, BLACK] = 0
        return replace(one, images=images)
    if policy == "leak":
        return replace(one, proprio=one.actions[one.frame_steps].astype(np.float32))
    return one


def recorded(demonstrations: Path, task: str) -> tuple[list[Path], list[Path]]:
    """The files of a task's demonstrations: those to train on, and those to judge on."""
    paths = demos.episode_files(demonstrations / "all", task)
    return paths[:-JUDGED], paths[-JUDGED:]


def derived(demonstrations: Path, out: Path, policy: str) -> Path:
    """The training demonstrations of a policy."""
    for task in TASKS:
        folder = out / "demos" / policy / task
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(demonstrations / "all" / task / "recording.json", folder / "recording.json")
        for source in recorded(demonstrations, task)[0]:
            path = folder / source.name
            if not path.exists():
                with write_atomically(path) as temporary, temporary.open("wb") as file:
                    np.savez(file, **vars(changed(demos.load(source), policy)))
    return out / "demos" / policy


def judged(demonstrations: Path, policy: str) -> Iterator[Recording]:
    """The demonstrations of each task that were not trained on, a step for each frame."""
    for task in TASKS:
        for path in recorded(demonstrations, task)[1]:
            one = changed(demos.load(path), policy)
            instruction = find_task(task).instruction(int(path.stem))
            if policy == "constant":
                instruction = TEXT
            yield Recording(
                instruction, one.images, one.proprio, one.actions[one.frame_steps].astype(np.float32)
            )


def diagnosed(folder: Path, recordings: Path) -> dict[str, Any]:
    """Verdicts and effects."""
    report = saccade.diagnose(
        saccade.Policy.from_pretrained(folder, num_threads=1), saccade.datasets.open(recordings)
    )
    return {
        name: {
            "verdict": one.name,
            "effect": [round(value, 4) for value in (one.effect, one.low, one.high)],
            "changes": {change: round(effect.share.value, 4) for change, effect in one.changes.items()},
        }
        for name, one in report.inputs.items()
    }


def train_all(demonstrations: Path, out: Path, names: Sequence[str], device: str) -> None:
    """Trains the policies of these names."""
    import torch

    from saccade_lab.training.train import train

    torch.set_num_threads(1)
    for policy in names:
        settings = replace(SETTINGS, language_dropout=float(policy == "constant"))
        folder = derived(demonstrations, out, policy)
        train(folder, out / policy, settings, lambda progress: None, device=device)


def judge_all(demonstrations: Path, out: Path, names: Sequence[str]) -> None:
    """Diagnoses each policy on recordings like those of its training, and on those of ``healthy``."""
    from saccade_lab.sim.environment import SIMULATION_HZ

    path = out / "verdicts.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    found["code"] = code_version()
    for policy in names:
        for seen in dict.fromkeys((policy, policy if policy == "leak" else "healthy")):
            recordings = out / "recordings" / seen
            if not recordings.exists():
                settings_of = demos.read_settings(demonstrations / "all", list(TASKS))
                cameras = [camera.name for camera in settings_of.cameras]
                fps = SIMULATION_HZ // settings_of.frame_stride
                write_recordings(
                    recordings, judged(demonstrations, seen), cameras, settings_of.image_size, fps, extra={}
                )
            name = f"{policy} on recordings of {seen}"
            if name not in found:
                found[name] = diagnosed(out / policy, recordings)
                write_json(path, found)
            print(name, {key: one["verdict"] for key, one in found[name].items()}, flush=True)


def main() -> None:
    """Trains, or records and judges."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("train", "judge"))
    parser.add_argument("demos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--policies", nargs="*", choices=POLICIES, default=POLICIES, help="only these")
    parser.add_argument("--device", default="cpu", help="torch's name of the device to train on")
    args = parser.parse_args()
    if args.part == "train":
        train_all(args.demos, args.out, args.policies, args.device)
    else:
        judge_all(args.demos, args.out, args.policies)


if __name__ == "__main__":
    main()
