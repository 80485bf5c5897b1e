"""Files: written so that a reader never sees half of one, and hashed."""

import functools
import hashlib
import os
import time
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
        OSError: The file cannot be written; names `path`.
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


#: Seconds after a change in which another one may leave a file the same times; two on FAT.
UNSETTLED = 2.0


def remembered_sha256(path: Path) -> str:
    """SHA-256 of a file. It is read again only if it has changed since this process read it.

    Size, times and inode tell whether it has. A file that changed in the last seconds is always read.
    """
    about = path.stat()
    if time.time() - max(about.st_mtime, about.st_ctime) < UNSETTLED:
        return sha256_of(path)
    return _sha256_of_state(
        path, about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns
    )


@functools.cache
def _sha256_of_state(path: Path, *state: int) -> str:
    return sha256_of(path)


def sha256_of(*paths: Path) -> str:
    """SHA-256 of files, one after the other, read in blocks."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(1 << 24):
                digest.update(block)
    return digest.hexdigest()
