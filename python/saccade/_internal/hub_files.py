"""The files of a published repository that saccade reads; optimizer states and others are not needed."""

from __future__ import annotations

import json
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

#: Weights in safetensors, and what says how they are read.
WEIGHTS = (
    "config.json",
    "*.safetensors",
    "*.safetensors.index.json",
    "adapter_config.json",
    "saccade.json",
    "trainer_state.json",  # tells a checkpoint of Isaac-GR00T's training; a few kB
)
#: Statistics of states and actions, and what an observation must contain. lerobot stores statistics as
#: safetensors.
STATISTICS = (
    "config.json",
    "policy_*processor*.json",
    "policy_*processor*.safetensors",
    "processor_config.json",
    "statistics.json",
    "dataset_statistics.json",
    "embodiment_id.json",
    "metadata.json",
    "experiment_cfg/*.json",
    "processor/processor_config.json",
    "processor/statistics.json",
    "processor/dataset_statistics.json",
    "processor/embodiment_id.json",
)
#: A tokenizer, in the repository of its own or of a checkpoint.
TOKENIZER = (
    "tokenizer.json",
    "vocab.json",
    "merges.txt",
    "added_tokens.json",
    "tokenizer_config.json",
    "preprocessor_config.json",
)
#: Folders of a checkpoint that may hold a tokenizer.
TOKENIZER_FOLDERS = ("tokenizer", "processor", "eagle2hg-processor-groot-n1p5")

HEAD = (*WEIGHTS, *STATISTICS)  # with statistics, because `saccade.Policy(head)` reads them
BACKBONE = WEIGHTS
PROCESSOR = (
    *WEIGHTS,  # the version and sizes of the processor are those of the tensors
    *TOKENIZER,
    *(f"{folder}/{name}" for folder in TOKENIZER_FOLDERS for name in TOKENIZER),
    "processor_config.json",
    "processor/processor_config.json",
    "policy_*processor*.json",
)
#: Everything that saccade reads: head, backbone, processor, tokenizer and statistics.
POLICY = (*dict.fromkeys((*HEAD, *PROCESSOR)),)
#: With what belongs to a checkpoint that is rewritten.
WHOLE = (*dict.fromkeys((*POLICY, "*.json", "*.txt", "*.jinja", "*.md", "LICENSE*")),)


def wanted(files: tuple[str, ...], names: Iterable[str]) -> list[str]:
    """The names that match a pattern, in ascending order. A ``*`` does not match a slash."""
    return sorted(
        name
        for name in names
        if any(fnmatchcase(name, pattern) and name.count("/") == pattern.count("/") for pattern in files)
    )


def missing_files(folder: Path, files: tuple[str, ...], listed: list[str] | None) -> list[str]:
    """Names of the files that are needed and not in ``folder``, or a pattern of which no file exists.

    If it is not known which files are ``listed`` in the repository, only files without which nothing can be
    read are missing.
    """
    if listed is not None:
        return [name for name in wanted(files, listed) if not (folder / name).is_file()]
    there = [file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()]
    return absent_files(files, there) or _missing_shards(folder, files)


def absent_files(files: tuple[str, ...], names: Iterable[str]) -> list[str]:
    """Files without which nothing can be read, and which are not among ``names``."""
    there = set(wanted(files, names))
    if "*.safetensors" not in files:
        is_tokenizer = files == TOKENIZER
        complete = "tokenizer.json" in there or {"vocab.json", "merges.txt"} <= there
        return ["tokenizer.json"] if is_tokenizer and not complete else []
    if "adapter_config.json" in there:  # an adapter alone, whose readers say what it lacks
        return []
    needed = [] if "config.json" in there else ["config.json"]
    has_weights = any(name.endswith((".safetensors", ".safetensors.index.json")) for name in there)
    return needed if has_weights else [*needed, "*.safetensors"]


def _missing_shards(folder: Path, files: tuple[str, ...]) -> list[str]:
    """The files that an index names and that are missing."""
    if "*.safetensors" not in files:
        return []
    shards: set[str] = set()
    try:
        for index in folder.glob("*.safetensors.index.json"):
            shards.update(json.loads(index.read_text(encoding="utf-8"))["weight_map"].values())
        return sorted(shard for shard in shards if not (folder / shard).exists())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return []  # the reader of the index reports what is wrong with it
