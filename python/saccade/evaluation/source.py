"""How a process loads the policy and the recordings of a command, once."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saccade._internal.environment import show_config
from saccade._internal.files import sha256_of
from saccade._internal.hub import commit_of, locate, parse
from saccade.datasets import Dataset
from saccade.datasets import open as open_recordings
from saccade.datasets.source import folder_of
from saccade.errors import InputError
from saccade.policy.policy import Policy

#: Files of a checkpoint that decide what it computes.
WEIGHTS, COMPANIONS = ("*.safetensors",), ("*.json", "*.txt", "*/*.json", "*/*.txt", "*/*.safetensors")
#: Options that may be paths of files, which can change while their names stay.
FILES = ("tokenizer", "data_config")


@dataclass(frozen=True)
class Source:
    """A checkpoint and recordings. It is pickled; each process loads them once.

    Attributes:
        checkpoint: Path of the checkpoint's directory.
        recordings: Path of the data set, or its id and commit.
        options: Keyword arguments of :meth:`saccade.Policy.from_pretrained`, as JSON values.
    """

    checkpoint: str
    recordings: str
    options: Mapping[str, Any]

    @classmethod
    def of(cls, checkpoint: str | Path, recordings: str, options: Mapping[str, Any]) -> Source:
        """The source of a checkpoint and recordings by their paths or ids, which are downloaded if need be.

        Recordings with an id are those of one commit, in every process and in a certificate.
        """
        values = {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
        published = parse(recordings)
        if published is not None:
            folder = folder_of(recordings)
            commit = commit_of(folder)
            if commit is None:
                raise InputError(
                    f"recordings: {recordings}: its commit is not known, got the folder {folder}"
                )
            recordings = f"{published[0]}@{commit}"
        return cls(str(locate(checkpoint).path), recordings, values)

    @property
    def policy(self) -> Policy:
        """The policy; raises as :meth:`saccade.Policy.from_pretrained`."""
        return _policy(self.checkpoint, json.dumps(self.options, sort_keys=True))

    @property
    def data(self) -> Dataset:
        """The recordings, with the keys and steps of the policy.

        Raises:
            FileNotFoundError, DatasetError, InputError, MissingExtraError: As :func:`saccade.datasets.open`
                and :meth:`saccade.datasets.Dataset.for_policy`.
        """
        return _data(self.recordings).for_policy(self.policy)

    def identity(self) -> dict[str, Any]:
        """What decides the actions: recordings, and all of :meth:`checkpoint_identity`."""
        recordings = {
            "name": Path(self.recordings).name,
            "sha256": _data(self.recordings).fingerprint(),
        }
        return {**self.checkpoint_identity(), "recordings": recordings}

    def checkpoint_identity(self) -> dict[str, Any]:
        """What decides the actions besides the recordings: hashes, options, and what computes."""
        config = show_config("dicts")
        return {
            "checkpoint": {
                "name": Path(self.checkpoint).resolve().name,
                "sha256": weights_hash(self.checkpoint),
            },
            "options": {name: value for name, value in self.options.items() if name != "num_threads"},
            "option_files": {
                name: weights_hash(path)
                for name in FILES
                if isinstance(path := self.options.get(name), str) and Path(path).exists()
            },
            "saccade": config["saccade"],
            "instruction_set": config["isa"],
        }


#: The policy that this process has loaded, by checkpoint and options.
_loaded: dict[tuple[str, str], Policy] = {}


def _policy(checkpoint: str, options: str) -> Policy:
    found = _loaded.get((checkpoint, options))
    if found is None:
        forget_policy()
        found = _loaded[checkpoint, options] = Policy.from_pretrained(checkpoint, **json.loads(options))
    return found


@functools.lru_cache(maxsize=1)
def _data(recordings: str) -> Dataset:
    return open_recordings(recordings)


def forget_policy() -> None:
    """Drops the policy that this process has loaded, so that another one finds its memory free."""
    _loaded.clear()


def weights_hash(checkpoint: str | Path) -> str:
    """SHA-256 of the weights of a checkpoint, and of the files that decide how they are used.

    The digest is that of lines with name, relative to the directory, and hash of each file.
    """
    folder = Path(checkpoint)
    files = (
        sorted(
            {path for pattern in (*WEIGHTS, *COMPANIONS) for path in folder.glob(pattern) if path.is_file()}
        )
        if folder.is_dir()
        else [folder]
    )
    names = [path.name if path == folder else path.relative_to(folder).as_posix() for path in files]
    lines = "".join(f"{name} {sha256_of(path)}\n" for name, path in zip(names, files, strict=True))
    return hashlib.sha256(lines.encode()).hexdigest()
