"""Where a policy's files are: a directory or a published repository, with checkpoint and tokenizer inside."""

import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError, RevisionNotFoundError

from saccade._internal import hub_files
from saccade._internal.hub import PUBLISHED, resolve
from saccade._internal.tokenizers import tokenizer_path
from saccade.errors import InputError

#: The folder of the checkpoint. It has a `config.json` of its own, as lerobot's policies do.
CHECKPOINT = "checkpoint"

#: The folder of the tokenizer, if the checkpoint's own is not used.
TOKENIZER = "tokenizer"

#: The folder of a data config that was given as a file, and its name there.
DATA_CONFIG = "data_config"
DATA_CONFIG_FILE = "data_config.json"

#: What saccade reads of a checkpoint. Other files, such as an optimizer's state, are not fetched or copied.
FILES = ("*.json", "*.safetensors", "*.txt")


def folder_of(name: str | Path, *, revision: str | None, **hub_options: Any) -> Path:
    """The directory of a policy, which is downloaded if it is the id of a published repository.

    Args:
        name: A directory, or an id such as ``nvidia/GR00T-N1.5-3B``, optionally with ``@`` and a revision.
        revision: A branch, tag or commit.
        **hub_options: As in ``huggingface_hub.snapshot_download``.

    Raises:
        FileNotFoundError: There is neither the directory nor the repository or revision.
        huggingface_hub.errors.HfHubHTTPError: The Hub refuses, or fails in another way.
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
    except GatedRepoError:  # it is there, for those who have accepted its conditions
        raise
    except (RepositoryNotFoundError, RevisionNotFoundError) as error:
        raise FileNotFoundError(f"pretrained_name_or_path: {name} is not on the Hub: {error}") from error


def copy_checkpoint(source: str, tokenizer: str | None, data_config: Path | None, folder: Path) -> None:
    """Copies a checkpoint into the folder of a policy, and what else the policy was loaded from.

    The folder then needs no other file: also where the local cache has no tokenizer. What was there before is
    replaced at the end only.

    Args:
        source: The directory or id of a checkpoint, or its weights.
        tokenizer: As :meth:`saccade.Policy.from_pretrained` takes it. It is copied if the checkpoint has
        none.
        data_config: The file of a data config, or None.
        folder: The policy's directory.

    Raises:
        InputError: ``folder`` is the checkpoint itself.
        OSError: The files cannot be copied; ``folder`` is then as before.
    """
    checkpoint = resolve(source)
    files = tokenizer_path(checkpoint, tokenizer)
    checkpoint = checkpoint if checkpoint.is_dir() else checkpoint.parent
    if folder.samefile(checkpoint):
        raise InputError(f"save_directory: expected another directory than the checkpoint's, got {folder}")
    parts: dict[str, Mapping[Path, Path]] = {}
    if not _is(folder / CHECKPOINT, checkpoint):
        parts[CHECKPOINT] = {file.relative_to(checkpoint): file for file in _files_of(checkpoint)}
    if files is None:
        parts[TOKENIZER] = {}
    elif not _is(folder / TOKENIZER, files):
        parts[TOKENIZER] = _files_of_tokenizer(files)
    if data_config is None:
        parts[DATA_CONFIG] = {}
    elif not _is(folder / DATA_CONFIG / DATA_CONFIG_FILE, data_config):
        parts[DATA_CONFIG] = {Path(DATA_CONFIG_FILE): data_config}
    with tempfile.TemporaryDirectory(dir=folder, prefix=".saving-") as temporary:
        for name, part in parts.items():
            for below, file in part.items():
                to = Path(temporary, name, below)
                to.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, to)
        _replace(parts, folder, Path(temporary))


def _is(path: Path, other: Path) -> bool:
    """Whether two paths lead to the same file or directory."""
    return path.exists() and path.samefile(other)


def _replace(names: Iterable[str], folder: Path, temporary: Path) -> None:
    """Moves new folders into place, if they are there, instead of the old ones; all of them or none."""
    moves: list[tuple[Path, Path]] = []

    def move(source: Path, target: Path) -> None:
        if source.exists():
            source.rename(target)
            moves.append((source, target))

    try:
        for name in names:
            move(folder / name, temporary / f"old-{name}")
            move(temporary / name, folder / name)
    except BaseException:
        for source, target in reversed(moves):
            target.rename(source)
        raise


def _files_of(checkpoint: Path) -> Iterator[Path]:
    """The files of a checkpoint, without the intermediate ones that a training left in folders below it."""
    yield from checkpoint.glob("*.safetensors")
    for pattern in FILES:
        if pattern != "*.safetensors":
            for file in checkpoint.rglob(pattern):
                if not any(part.startswith("checkpoint-") for part in file.relative_to(checkpoint).parts):
                    yield file


def _files_of_tokenizer(path: Path) -> dict[Path, Path]:
    """The files of a tokenizer, by their names in a directory of their own."""
    if path.is_dir():
        return {Path(name): path / name for name in hub_files.TOKENIZER if (path / name).is_file()}
    beside = path.with_name("preprocessor_config.json")
    found = {Path("tokenizer.json"): path}
    return found | ({Path(beside.name): beside} if beside.is_file() else {})
