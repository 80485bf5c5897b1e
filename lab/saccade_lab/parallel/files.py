"""Files on other machines: packed once, kept in a directory of each machine, and found by the work there."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MethodType
from typing import Any

import numpy as np

from saccade._internal.arrays import UInt8Array

CHUNK_BYTES = 1 << 28  # bytes of a file that travel as one object


@dataclass(frozen=True)
class Shipment:
    """A file or directory on its way to other machines.

    Attributes:
        name: Its name, which it keeps there.
        sha256: Hash of names and contents.
        files: For each file, by its path below the directory that contains ``name``, what ``put`` returned
            for each of its chunks.
    """

    name: str
    sha256: str
    files: Mapping[str, tuple[Any, ...]]


def files_of(path: Path) -> dict[str, Path]:
    """The files of a shipment, by their paths below the directory that contains it.

    Hidden files are left out. A ``.safetensors`` file takes ``config.json`` with it, if that is next to it.
    """
    if path.is_dir():
        return {f"{path.resolve().name}/{file.relative_to(path).as_posix()}": file for file in walked(path)}
    config = path.with_name("config.json")
    companions = [config] if path.suffix == ".safetensors" and config.is_file() else []
    return {file.name: file for file in (path, *companions)}


def walked(directory: Path) -> list[Path]:
    """All files below a directory, except hidden ones; links to directories are followed, circles are not."""
    found: list[Path] = []
    for folder, inner, names in os.walk(directory, followlinks=True):
        here = Path(folder)
        above = {here.resolve(), *here.resolve().parents}
        inner[:] = [
            name for name in inner if not name.startswith(".") and (here / name).resolve() not in above
        ]
        found += [here / name for name in names if not name.startswith(".") and (here / name).is_file()]
    return sorted(found)


def pack(path: Path, put: Callable[[UInt8Array], Any]) -> Shipment:
    """Reads a file or directory and hands its bytes to ``put``, in chunks of at most ``CHUNK_BYTES``."""
    digest, files = hashlib.sha256(), {}
    for name, file in files_of(path).items():
        size = file.stat().st_size
        digest.update(f"{name}\0{size}\0".encode())
        chunks = []
        for start in range(0, size, CHUNK_BYTES):
            chunk = np.fromfile(file, np.uint8, CHUNK_BYTES, offset=start)
            digest.update(chunk.data)
            chunks.append(put(chunk))
        files[name] = tuple(chunks)
    # A link to a file keeps its own name, as its key does.
    return Shipment(path.resolve().name if path.is_dir() else path.name, digest.hexdigest(), files)


def place(shipment: Shipment, get: Callable[[Any], UInt8Array]) -> Path:
    """The path of a shipment on this machine, written if no process has done so before.

    Processes that ask at the same time wait for the one that writes. Nothing is half written: a process that
    dies leaves a temporary directory, which the next one removes.

    Args:
        shipment: What ``pack`` returned.
        get: The bytes of a chunk.

    Raises:
        OSError: It cannot be written, or what arrived is not what was packed.
    """
    cache = cache_directory()
    folder = cache / shipment.sha256
    found = folder / shipment.name

    def is_complete() -> bool:
        """Whether no cleaner of temporary files took some of them away."""
        return all((folder / name).is_file() for name in shipment.files)

    if is_complete():
        return found
    import fcntl  # not at the top: Windows has none, and imports this module

    with (cache / f"{shipment.sha256}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed, by a killed process too
        if not is_complete():
            temporary = cache / f"{shipment.sha256}.part"
            shutil.rmtree(temporary, ignore_errors=True)
            _unpack(shipment, get, temporary)
            shutil.rmtree(folder, ignore_errors=True)
            temporary.rename(folder)
    return found


def _unpack(shipment: Shipment, get: Callable[[Any], UInt8Array], folder: Path) -> None:
    """Writes the files and checks their hash."""
    digest = hashlib.sha256()
    for name, chunks in shipment.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            for chunk in chunks:
                file.write(get(chunk).data)
        digest.update(f"{name}\0{path.stat().st_size}\0".encode())
        with path.open("rb") as file:
            while read := file.read(1 << 24):
                digest.update(read)
    if digest.hexdigest() != shipment.sha256:
        raise OSError(f"{shipment.name}: expected the hash {shipment.sha256}, got {digest.hexdigest()}")


def cache_directory() -> Path:
    """The directory of this machine that keeps shipments: ``saccade-UID`` where temporary files are.

    It may be deleted when nothing runs. ``TMPDIR`` puts it elsewhere.

    Raises:
        PermissionError: It belongs to someone else.
    """
    path = Path(tempfile.gettempdir()) / f"saccade-{os.getuid()}"
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if path.is_symlink() or path.stat().st_uid != os.getuid():
        raise PermissionError(f"{path}: expected a directory of user {os.getuid()}")
    return path


def located(work: Any, files: Iterable[str | Path]) -> tuple[dict[str, Path], Any]:
    """The files to bring, by absolute paths, and the work with these paths in place of its own.

    A path may be relative, contain ``..`` or lead through links; it means what it means here. Files that do
    not exist, for example because they are names of published checkpoints, are left as they are.

    Args:
        work: As ``relocated`` takes values. A string is a path if it contains a separator (see
            ``saccade_lab.files.path_text``); a word may be equal to the name of a file.
        files: Files and directories, each named in any way.
    """
    sources = {str(path): path for path in (_absolute(file) for file in files if Path(file).exists())}

    def absolute(text: str, is_path: bool) -> str:
        path = str(_absolute(text)) if is_path or os.sep in text else text
        return path if path in sources else text

    return sources, _replaced(work, absolute)


def relocated(work: Any, places: Mapping[str, Path]) -> Any:
    """Work in which paths are replaced; the work itself if it contains none of them.

    Args:
        work: Strings and paths are compared as a whole; dataclasses, bound methods, sequences and mappings
            are searched.
        places: New path by old one.

    Example:
        >>> relocated({"run": Path("/a/b"), "name": "a"}, {"/a/b": Path("/tmp/b")})
        {'run': PosixPath('/tmp/b'), 'name': 'a'}
    """
    return _replaced(work, lambda text, is_path: str(places.get(text, text)))


def _absolute(path: str | Path) -> Path:
    """An absolute path without ``..`` and links, except that a link to a file keeps its own name.

    A file's name tells its type, and the files next to it belong to it; in the cache of ``huggingface_hub``
    it is a link to a file without either.
    """
    path = Path(path)
    try:
        return path.resolve() if path.is_dir() else path.parent.resolve() / path.name
    except (OSError, RuntimeError, ValueError):  # a text that cannot be a path; links in a circle
        return path


def _replaced(value: Any, replace: Callable[[str, bool], str]) -> Any:
    """A value in which ``replace`` was applied to strings and paths; the value itself if nothing changed.

    Args:
        value: See ``relocated``.
        replace: Gets the text, and whether it is that of a ``Path``.
    """
    if isinstance(value, (str, Path)):
        text = replace(str(value), isinstance(value, Path))
        return value if text == str(value) else type(value)(text)
    if isinstance(value, MethodType):
        owner = _replaced(value.__self__, replace)
        return value if owner is value.__self__ else getattr(owner, value.__name__)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        held = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        changed = {name: _replaced(inner, replace) for name, inner in held.items()}
        same = all(changed[name] is inner for name, inner in held.items())
        return value if same else dataclasses.replace(value, **changed)
    if isinstance(value, Mapping):
        inner = {key: _replaced(held, replace) for key, held in value.items()}
        return value if all(inner[key] is held for key, held in value.items()) else inner
    if isinstance(value, (tuple, list)) and not hasattr(value, "_fields"):
        items = [_replaced(held, replace) for held in value]
        return value if all(map(lambda new, old: new is old, items, value)) else type(value)(items)
    return value
