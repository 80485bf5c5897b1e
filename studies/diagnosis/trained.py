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
import itertools
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from saccade._internal.files import sha256_of, write_json
from saccade.errors import InputError
from saccade_lab.sim import demos
from saccade_lab.sim.recordings import Recording, write_recordings
from saccade_lab.sim.settings import TENSOR_FILE
from saccade_lab.sim.tasks import find_task
from saccade_lab.study.code_version import code_version
from saccade_lab.training.settings import TrainingSettings

TASKS = ("touch-yellow", "touch-blue")
JUDGED = 10  # demonstrations of each task, none of them trained on
BLACK = 2  # place of the camera that is black
#: Fewer and larger steps than the guidance study's, for a GPU. They are not tuned.
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
    """The files of a task's demonstrations: those to train on, and those to judge on.

    A seed has the same scene in both tasks, so the split is that of the seeds.

    Raises:
        InputError: The tasks have demonstrations of different seeds.
    """
    found = {one: demos.episode_files(demonstrations / "all", one) for one in TASKS}
    paths = found[task]
    if len(paths) <= JUDGED or len({tuple(path.name for path in files) for files in found.values()}) != 1:
        counts = {one: len(files) for one, files in found.items()}
        raise InputError(
            f"{demonstrations / 'all'}: expected the same seeds of both tasks, got {counts} files"
        )
    return paths[:-JUDGED], paths[-JUDGED:]


def derived(demonstrations: Path, out: Path, policy: str) -> Path:
    """The training demonstrations of a policy, written anew."""
    folder = out / "demos" / policy
    shutil.rmtree(folder, ignore_errors=True)
    for task in TASKS:
        (folder / task).mkdir(parents=True)
        shutil.copyfile(demonstrations / "all" / task / "recording.json", folder / task / "recording.json")
        for source in recorded(demonstrations, task)[0]:
            path = folder / task / source.name
            if policy in ("black", "leak"):
                np.savez_compressed(path, **vars(changed(demos.load(source), policy)))
            else:
                shutil.copyfile(source, path)
    return folder


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


def diagnosed(policy: saccade.Policy, recordings: Path) -> dict[str, Any]:
    """Verdicts and effects."""
    report = saccade.diagnose(policy, saccade.datasets.open(recordings))
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
    import torch  # not at the top: judging needs no torch

    from saccade_lab.training.train import train

    torch.set_num_threads(1)
    for policy in names:
        settings = replace(SETTINGS, language_dropout=float(policy == "constant"))
        folder = derived(demonstrations, out, policy)
        train(folder, out / policy, settings, lambda progress: None, device=device)


def trained(folder: Path) -> saccade.Policy:
    """A policy whose training has ended.

    Raises:
        InputError: It has not.
    """
    step = json.loads((folder / "history.json").read_text(encoding="utf-8"))[-1]["step"]
    if step != SETTINGS.steps:
        raise InputError(f"{folder}: trained for {step} of {SETTINGS.steps} steps: train it to the end first")
    return saccade.Policy.from_pretrained(folder, num_threads=1)


def record(demonstrations: Path, folder: Path, seen: str) -> None:
    """Writes the recordings to judge on."""
    from saccade_lab.sim.environment import SIMULATION_HZ  # not at the top: training needs no simulator

    settings = demos.read_settings(demonstrations / "all", list(TASKS))
    cameras = [camera.name for camera in settings.cameras]
    fps = SIMULATION_HZ // settings.frame_stride
    shutil.rmtree(folder, ignore_errors=True)
    write_recordings(folder, judged(demonstrations, seen), cameras, settings.image_size, fps, extra={})


def judge_all(demonstrations: Path, out: Path, names: Sequence[str]) -> None:
    """Diagnoses each policy on recordings like those of its training, and on those of ``healthy``. A verdict
    is kept as long as weights, recordings and code are the same.
    """
    path = out / "verdicts.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    seen_by = {name: dict.fromkeys((name, name if name == "leak" else "healthy")) for name in names}
    for seen in dict.fromkeys(itertools.chain.from_iterable(seen_by.values())):
        record(demonstrations, out / "recordings" / seen, seen)
    for name in names:
        policy = trained(out / name)
        for seen in seen_by[name]:
            recordings = out / "recordings" / seen
            about = {
                "sha256": sha256_of(out / name / TENSOR_FILE),
                "recordings": saccade.datasets.open(recordings).fingerprint(),
                "code": code_version(),
            }
            title = f"{name} on recordings of {seen}"
            if found.get(title, {}).get("about") != about:
                found[title] = {"about": about, "inputs": diagnosed(policy, recordings)}
                write_json(path, found)
            inputs = found[title]["inputs"]
            print(title, {key: one["verdict"] for key, one in inputs.items()}, flush=True)


def main() -> None:
    """Trains, or records and judges."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("train", "judge"))
    parser.add_argument("demos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=POLICIES, help="only these")
    parser.add_argument("--device", default="cpu", help="torch's name of the device to train on")
    args = parser.parse_args()
    if args.part == "train":
        train_all(args.demos, args.out, args.policies, args.device)
    else:
        judge_all(args.demos, args.out, args.policies)


if __name__ == "__main__":
    main()
