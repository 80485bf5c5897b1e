"""Files: written so that a reader never sees half of one, and hashed."""

import errno
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from saccade._internal.json import dumps


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Gives a temporary path in the same directory, which is renamed to `path` at the end.

    After an error it is removed. The temporary name keeps the suffix, because some writers choose the format
    by it.

    Raises:
        OSError: the file cannot be written; names `path`.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:
            # A failed write, such as to a full disk, does not know the name of the file.
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_json(path: Path, value: Any) -> None:
    """Writes indented JSON with a final newline; numbers that are not finite become ``null``."""
    with write_atomically(path) as temporary:
        temporary.write_text(dumps(value, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def path_text(path: Path) -> str:
    """A path as text that contains a separator, so that it cannot be taken for a word.

    Example:
        >>> path_text(Path("reach")), path_text(Path("out/reach"))
        ('./reach', 'out/reach')
    """
    return str(path) if os.sep in str(path) else f"{os.curdir}{os.sep}{path}"


def writable_directory(path: Path) -> Path:
    """Creates the directory if it does not exist, and checks that files can be written to it.

    Raises:
        OSError: it cannot be created or written to, or is not a directory.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(errno.ENOTDIR, "exists and is not a directory", str(path)) from None
    probe = path / f".writable.{os.getpid()}"
    probe.touch()
    probe.unlink()
    return path


def sha256_of(*paths: Path) -> str:
    """SHA-256 of files, one after the other, read in blocks."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(1 << 24):
                digest.update(block)
    return digest.hexdigest()


def checkpoint_identity(checkpoint: Path) -> dict[str, str]:
    """`name` and `sha256` of a checkpoint.

    The hash covers the tensors and what decides how they are used: config, tokenizer and statistics, where
    there are such files.
    """
    directory = checkpoint if checkpoint.is_dir() else checkpoint.parent
    tensors = sorted(directory.glob("*.safetensors")) if checkpoint.is_dir() else [checkpoint]
    companions = [
        directory / name
        for name in (
            "config.json",
            "tokenizer.json",
            "experiment_cfg/metadata.json",
            "experiment_cfg/data_config.json",
        )
    ]
    return {
        "name": checkpoint.resolve().name,
        "sha256": sha256_of(*filter(Path.is_file, companions), *tensors),
    }
