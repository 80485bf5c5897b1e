"""Does `saccade diagnose` see diseases that training brought about? Four small policies, trained and judged.

    python studies/diagnosis/trained.py DEMOS OUT     DEMOS as `studies/guidance/guidance.py demos` wrote them

`healthy` is trained on the balanced demonstrations of the guidance study; `constant` on the same with one
instruction for all of them; `black` with one camera black; `leak` with the expert's action in place of the
state.
Each is judged on ten other demonstrations of each task, changed as its training ones were, and, but for
`leak`, on the unchanged ones. Every part resumes where it stopped. README.md says what was expected.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import saccade
from saccade._internal.files import write_atomically, write_json
from saccade_lab.sim import demos
from saccade_lab.sim.environment import SIMULATION_HZ
from saccade_lab.sim.recordings import Recording, write_recordings
from saccade_lab.sim.tasks import find_task
from saccade_lab.study.code_version import code_version
from saccade_lab.training.settings import TrainingSettings
from saccade_lab.training.train import train

TASKS = ("touch-yellow", "touch-blue")
JUDGED = 10  # demonstrations of each task, none of them trained on
BLACK = 2  # place of the camera that is black
#: That of the guidance study, with half of its steps.
SETTINGS = TrainingSettings(
    steps=1600, width=64, learning_rate=2e-3, ema_decay=0.995, num_future_tokens=8, absent_share=0.0
)
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


def derived(demonstrations: Path, out: Path, policy: str) -> Path:
    """The training demonstrations of a policy; those of the study where they are unchanged."""
    source = demonstrations / "balanced"
    if policy not in ("black", "leak"):
        return source
    for task in TASKS:
        folder = out / "demos" / policy / task
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / task / "recording.json", folder / "recording.json")
        for seed, one in demos.episodes(source, task):
            path = folder / f"{seed}.npz"
            if not path.exists():
                with write_atomically(path) as temporary, temporary.open("wb") as file:
                    np.savez_compressed(file, **vars(changed(one, policy)))
    return out / "demos" / policy


def judged(demonstrations: Path, policy: str) -> Iterator[Recording]:
    """The last demonstrations of each task that were not chosen for training, a step for each frame."""
    for task in TASKS:
        trained = {path.stem for path in (demonstrations / "balanced" / task).glob("[0-9]*.npz")}
        others = [
            path for path in (demonstrations / "all" / task).glob("[0-9]*.npz") if path.stem not in trained
        ]
        for path in sorted(others, key=lambda path: int(path.stem))[-JUDGED:]:
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


def main() -> None:
    """Trains, records and judges."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("demos", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    path = args.out / "verdicts.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    found["code"] = code_version()
    for policy in POLICIES:
        settings = replace(SETTINGS, language_dropout=float(policy == "constant"))
        train(derived(args.demos, args.out, policy), args.out / policy, settings, lambda progress: None)
        for seen in dict.fromkeys((policy, policy if policy == "leak" else "healthy")):
            recordings = args.out / "recordings" / seen
            if not recordings.exists():
                settings_of = demos.read_settings(args.demos / "all", list(TASKS))
                cameras = [camera.name for camera in settings_of.cameras]
                fps = SIMULATION_HZ // settings_of.frame_stride
                write_recordings(
                    recordings, judged(args.demos, seen), cameras, settings_of.image_size, fps, extra={}
                )
            name = f"{policy} on recordings of {seen}"
            if name not in found:
                found[name] = diagnosed(args.out / policy, recordings)
                write_json(path, found)
            print(name, {key: one["verdict"] for key, one in found[name].items()}, flush=True)


if __name__ == "__main__":
    main()
