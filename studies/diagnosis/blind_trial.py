"""A blind trial of `saccade diagnose`: checkpoints operated on, judged without knowing which, then opened.

    python studies/diagnosis/blind_trial.py make WORK [--checkpoints 12]
    python studies/diagnosis/blind_trial.py judge WORK RECORDINGS [--jobs 4]
    python studies/diagnosis/blind_trial.py open WORK SEAL studies/diagnosis/blind-trial-2.json

`make` copies the bundled policy and operates on each copy in a way that it draws: nothing, all text
embeddings made equal, the patch embedding zeroed (no camera sees), or the last layer of the state encoder
zeroed. What it did is written packed, and its SHA-256 is printed: the seal. `judge` reads the copies and the
recordings only. `open` checks the seal and compares. README.md has what counts as right.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import secrets
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

import saccade
from saccade._internal.files import write_json
from saccade_lab.parallel import Lost, Workers, each
from saccade_lab.study.code_version import code_version

EMBEDDINGS = "backbone.eagle_model.language_model.model.embed_tokens.weight"
PATCHES = "backbone.eagle_model.vision_model.vision_model.embeddings.patch_embedding.weight"
STATE = ("action_head.state_encoder.layer2.W", "action_head.state_encoder.layer2.b")

CAMERAS = ("camera.left", "camera.right", "camera.top")
#: What must be ignored after each operation; nothing else may be.
IGNORED = {"nothing": (), "text": ("instruction",), "vision": CAMERAS, "state": ("state",)}


def operate(tensors: dict[str, torch.Tensor], name: str, rng: secrets.SystemRandom) -> None:
    """Plants a disease."""
    if name == "text":
        table = tensors[EMBEDDINGS]
        tensors[EMBEDDINGS] = table[rng.randrange(len(table))].expand_as(table).contiguous()
    if name == "vision":
        tensors[PATCHES] = torch.zeros_like(tensors[PATCHES])
    if name == "state":
        for key in STATE:
            tensors[key] = torch.zeros_like(tensors[key])


def make(work: Path, checkpoints: int) -> None:
    """Writes the copies and the sealed labels."""
    rng, labels = secrets.SystemRandom(), {}
    for number in range(checkpoints):
        folder = work / f"{number:02d}"
        shutil.copytree(saccade.demo_checkpoint(), folder)
        tensors = load_file(folder / "model.safetensors")
        labels[folder.name] = rng.choice(list(IGNORED))
        operate(tensors, labels[folder.name], rng)
        save_file(tensors, folder / "model.safetensors")
    sealed = base64.b85encode(json.dumps([secrets.token_hex(16), labels]).encode())
    (work / "labels.sealed").write_bytes(sealed)
    print("seal", hashlib.sha256(sealed).hexdigest())


@dataclass(frozen=True)
class Judge:
    """Diagnoses a copy, in any process."""

    recordings: str

    def __call__(self, folder: str) -> dict[str, Any]:
        """Verdicts and effects."""
        start = time.perf_counter()
        policy = saccade.Policy.from_pretrained(folder, num_threads=1)
        report = saccade.diagnose(policy, saccade.datasets.open(self.recordings))
        return {
            "verdicts": {
                name: [one.name, round(one.effect, 4), round(one.low, 4), round(one.high, 4)]
                for name, one in report.inputs.items()
            },
            "changes": {
                f"{name}: {change}": round(one.share.value, 4)
                for name, verdict in report.inputs.items()
                for change, one in verdict.changes.items()
            },
            "seconds": round(time.perf_counter() - start, 1),
        }


def judge(work: Path, recordings: Path, jobs: int) -> None:
    """Diagnoses every copy that has no verdict yet; does not open the labels."""
    data = saccade.datasets.open(recordings)
    about = {"code": code_version(), "episodes": len(data), "recordings": data.fingerprint()}
    path = work / "verdicts.json"
    found: dict[str, Any] = {}
    if path.exists():
        earlier = json.loads(path.read_text(encoding="utf-8"))
        found = earlier.pop("checkpoints")
        if earlier != about:
            raise SystemExit(f"{path}: was written with other code or recordings: {earlier}, not {about}")
    folders = sorted(str(one) for one in work.iterdir() if one.is_dir() and one.name not in found)
    for folder, one in each(Judge(str(recordings)), folders, Workers(jobs=jobs)):
        if isinstance(one, Lost):
            print(f"{folder}: {one.reason}", flush=True)
            continue
        found[Path(folder).name] = one
        write_json(path, {**about, "checkpoints": dict(sorted(found.items()))})
        print(Path(folder).name, {name: verdict[0] for name, verdict in one["verdicts"].items()}, flush=True)


def unseal(work: Path, seal: str, out: Path) -> None:
    """Opens the labels after the verdicts, and writes both."""
    verdicts = json.loads((work / "verdicts.json").read_text(encoding="utf-8"))
    sealed = (work / "labels.sealed").read_bytes()
    if hashlib.sha256(sealed).hexdigest() != seal:
        raise SystemExit("the labels are not those of the seal")
    salt, labels = json.loads(base64.b85decode(sealed))
    right = 0
    for name, one in verdicts["checkpoints"].items():
        ignored = [key for key, verdict in one["verdicts"].items() if verdict[0] == "ignored"]
        used = one["verdicts"]["instruction"][0] == "used" or labels[name] == "text"
        one.update(label=labels[name], right=ignored == list(IGNORED[labels[name]]) and used)
        right += one["right"]
        print(name, labels[name], "right" if one["right"] else "WRONG", ignored)
    judged = len(verdicts["checkpoints"])
    print(f"{right} of {judged} right")
    write_json(out, {"seal": seal, "salt": salt, "right": right, "of": judged, **verdicts})


def main() -> None:
    """Runs one of the three parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = parser.add_subparsers(dest="part", required=True)
    made = parts.add_parser("make")
    made.add_argument("work", type=Path)
    made.add_argument("--checkpoints", type=int, default=12)
    judged = parts.add_parser("judge")
    judged.add_argument("work", type=Path)
    judged.add_argument("recordings", type=Path)
    judged.add_argument("--jobs", type=int, default=1)
    opened = parts.add_parser("open")
    opened.add_argument("work", type=Path)
    opened.add_argument("seal", help="that `make` printed")
    opened.add_argument("out", type=Path)
    args = parser.parse_args()
    if args.part == "make":
        make(args.work, args.checkpoints)
    elif args.part == "judge":
        judge(args.work, args.recordings, args.jobs)
    else:
        unseal(args.work, args.seal, args.out)


if __name__ == "__main__":
    main()
