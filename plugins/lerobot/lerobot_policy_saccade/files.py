"""Where a policy's files are: a directory or a published repository, and the checkpoint inside."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from huggingface_hub.errors import HfHubHTTPError

from saccade.errors import InputError
from saccade.hub import PUBLISHED, resolve

#: The folder of the checkpoint. It has a `config.json` of its own, as lerobot's policies do.
CHECKPOINT = "checkpoint"

#: What saccade reads of a checkpoint. Other files, such as an optimizer's state, are not fetched or copied.
FILES = ("*.json", "*.safetensors", "*.txt")


def folder_of(name: str | Path, *, revision: str | None, **hub_options: Any) -> Path:
    """The directory of a policy, which is downloaded if it is the id of a published repository.

    Args:
        name: A directory, or an id such as ``nvidia/GR00T-N1.5-3B``, optionally with ``@`` and a revision.
        revision: A branch, tag or commit.
        **hub_options: As in ``huggingface_hub.snapshot_download``.

    Raises:
        FileNotFoundError: There is neither the directory nor the repository.
    """
    path = Path(name)
    if path.is_dir():
        return path
    published = PUBLISHED.fullmatch(str(name))
    if published is None:
        raise FileNotFoundError(f"pretrained_name_or_path: expected a directory or an id, got {str(name)!r}")
    try:
        return Path(
            snapshot_download(
                published["id"],
                revision=revision or published["revision"],
                allow_patterns=list(FILES),
                **hub_options,
            )
        )
    except HfHubHTTPError as error:
        raise FileNotFoundError(f"pretrained_name_or_path: {name} is not on the Hub: {error}") from error


def copy_checkpoint(source: str, folder: Path) -> None:
    """Copies a checkpoint into the folder of a policy. What was there before is replaced at the end only.

    Args:
        source: The directory or id of a checkpoint, or its weights.
        folder: The policy's directory.

    Raises:
        InputError: ``folder`` is the checkpoint itself.
        OSError: The files cannot be copied; ``folder`` is then as before.
    """
    found = resolve(source)
    found = found if found.is_dir() else found.parent
    target = folder / CHECKPOINT
    if target.is_dir() and target.samefile(found):
        return
    if folder.samefile(found):
        raise InputError(f"save_directory: expected another directory than the checkpoint's, got {folder}")
    with tempfile.TemporaryDirectory(dir=folder, prefix=f".{CHECKPOINT}-") as temporary:
        copied, replaced = Path(temporary, "new"), Path(temporary, "old")
        for file in sorted(set(_files_of(found))):
            to = copied / file.relative_to(found)
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, to)
        if target.exists():
            target.rename(replaced)
        try:
            copied.rename(target)
        except BaseException:
            if replaced.exists():
                replaced.rename(target)
            raise


def _files_of(checkpoint: Path) -> Iterator[Path]:
    """The files of a checkpoint, without the intermediate ones that a training left in folders below it."""
    yield from checkpoint.glob("*.safetensors")
    for pattern in FILES:
        if pattern != "*.safetensors":
            for file in checkpoint.rglob(pattern):
                if not any(part.startswith("checkpoint-") for part in file.relative_to(checkpoint).parts):
                    yield file
