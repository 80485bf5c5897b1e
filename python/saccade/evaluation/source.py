"""How a process loads the policy and the recordings of a command, once, and what decides their actions."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from saccade._internal.environment import arithmetic
from saccade._internal.files import remembered_sha256
from saccade._internal.hub import commit_of, locate, parse
from saccade._internal.hub_files import POLICY, TOKENIZER
from saccade._internal.tokenizers import tokenizer_path
from saccade.datasets import Dataset
from saccade.datasets import open as open_recordings
from saccade.datasets.source import folder_of
from saccade.errors import InputError
from saccade.policy.policy import Policy
from saccade.robots.data_configs import RELEASED

#: Options whose files may be read besides the checkpoint.
OPTION_FILES = ("tokenizer", "data_config")


@dataclass(frozen=True)
class Source:
    """A checkpoint and recordings. It is pickled; each process loads them once.

    Attributes:
        checkpoint: Path of the checkpoint's directory.
        recordings: Path of the data set, or its id and commit.
        options: Keyword arguments of :meth:`saccade.Policy.from_pretrained`, as JSON values.
        published: Id and commit of the checkpoint, ``owner/name@commit``; None for a local one.
    """

    checkpoint: str
    recordings: str
    options: Mapping[str, Any]
    published: str | None = None

    @classmethod
    def of(cls, checkpoint: str | Path, recordings: str, options: Mapping[str, Any]) -> Source:
        """The source of a checkpoint and recordings by their paths or ids, which are downloaded if need be.

        What has an id is that of one commit, in every process and in a certificate.
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
        found = locate(checkpoint)
        return cls(str(found.path), recordings, values, found.published)

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
        """What decides the actions: recordings, and all of :meth:`checkpoint_identity`.

        Nothing in it is what a user calls a file, so that renamed files are the same ones.
        """
        return {
            **self.checkpoint_identity(),
            "recordings": {"sha256": _data(self.recordings).fingerprint()},
        }

    def checkpoint_identity(self) -> dict[str, Any]:
        """What decides the actions besides the recordings: hashes, options, and what computes."""
        weights, files = weights_hash(self.checkpoint), self.option_files()
        return {
            "checkpoint": {"sha256": weights},
            "options": {
                name: value
                for name, value in self.options.items()
                if name != "num_threads" and name not in files
            },
            "option_files": files,
            **arithmetic(),
        }

    def option_files(self) -> dict[str, str]:
        """As :func:`option_files`."""
        return option_files(self.checkpoint, self.options)

    def names(self) -> dict[str, str]:
        """What readers call checkpoint and recordings: their ids, or the names of their folders."""
        return {
            "checkpoint": _name(self.published or self.checkpoint),
            "recordings": _name(self.recordings),
        }

    def from_anywhere(self) -> Source:
        """The same source for a reader in another directory: ids and commits, or absolute paths.

        Its ``checkpoint`` is the id and commit of a published one, which is not the path of a directory.
        """
        files = {
            name: _absolute(given)
            for name in OPTION_FILES
            if isinstance(given := self.options.get(name), str)
            and not (name == "data_config" and given in RELEASED)
        }
        return replace(
            self,
            checkpoint=self.published or _absolute(self.checkpoint),
            recordings=_absolute(self.recordings),
            options={**self.options, **files},
        )


def _name(path_or_id: str) -> str:
    published = parse(path_or_id)
    return Path(path_or_id).resolve().name if published is None else published[0]


def _absolute(path_or_id: str) -> str:
    return str(Path(path_or_id).resolve()) if parse(path_or_id) is None else path_or_id


def named(settings: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Settings for readers: with the names of checkpoint and recordings, as ``Source.names`` has them.

    Without a name, that is the beginning of the hash.
    """
    found = dict(settings)
    for part in ("checkpoint", "recordings"):
        sha256 = settings[part]["sha256"]
        found[part] = {"name": names.get(part, f"{part} {sha256[:12]}"), "sha256": sha256}
    return found


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


def option_files(checkpoint: str | Path, options: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the files that are read besides a checkpoint, by the option that names them.

    The published tokenizer of a checkpoint without one is among them.

    Args:
        checkpoint: Path of the checkpoint.
        options: Of :meth:`saccade.Policy.from_pretrained`.
    """
    found = {}
    tokenizer = tokenizer_path(checkpoint, options.get("tokenizer"))
    if tokenizer is not None:
        found["tokenizer"] = contents_hash(tokenizer, TOKENIZER)
    data_config = options.get("data_config")
    if isinstance(data_config, str) and data_config not in RELEASED:
        found["data_config"] = contents_hash(Path(data_config), ())
    return found


def weights_hash(checkpoint: str | Path) -> str:
    """SHA-256 of the weights of a checkpoint, and of the files that decide how they are used.

    These are the files that :meth:`saccade.Policy.from_pretrained` reads. Results in the same directory, and
    folders of other checkpoints, do not count.
    """
    return contents_hash(Path(checkpoint), POLICY)


def contents_hash(path: Path, files: Sequence[str]) -> str:
    """SHA-256 of a file's contents; or of the files of a directory that match a pattern.

    The digest of a directory is that of lines with name, relative to the directory, and hash of each file.

    Args:
        path: The file or the directory.
        files: Patterns, as those of ``saccade._internal.hub_files``.

    Raises:
        FileNotFoundError: There is no such path.
    """
    if not path.is_dir():
        return remembered_sha256(path)
    found = {one.relative_to(path).as_posix(): one for pattern in files for one in path.glob(pattern)}
    lines = "".join(
        f"{name} {remembered_sha256(one)}\n" for name, one in sorted(found.items()) if one.is_file()
    )
    return hashlib.sha256(lines.encode()).hexdigest()
