"""Finds the tokenizer of a checkpoint: its own, a requested one, or a published one of its release."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.hub import locate_published, resolve
from saccade._internal.hub_files import PROCESSOR, TOKENIZER
from saccade._internal.warning import warn


def tokenizer_path(
    id_or_path: str | os.PathLike[str], tokenizer: str | os.PathLike[str] | None = None
) -> Path | None:
    """The file or directory of the tokenizer that :meth:`saccade.Processor.from_pretrained` reads.

    None if that is the checkpoint's own, because no other is requested.
    """
    found = tokenizer_of(processor_source(id_or_path, None), tokenizer)
    return None if found is None else Path(found)


def processor_source(id_or_path: str | os.PathLike[str], revision: str | None) -> _saccade.ProcessorSource:
    """What a checkpoint says about its processor; raises as :meth:`saccade.Processor.from_pretrained`."""
    return _saccade.ProcessorSource(os.fspath(resolve(id_or_path, revision, files=PROCESSOR)))


def tokenizer_of(source: _saccade.ProcessorSource, given: Any) -> str | None:
    """The path of the tokenizer to read instead of the checkpoint's own; None for that one."""
    if given is not None:
        return given_tokenizer(given)
    return None if source.has_tokenizer else _published_tokenizer(source)


def given_tokenizer(given: Any) -> str:
    """The path of a tokenizer that is given as a path or as an id."""
    return os.fspath(resolve(given, files=TOKENIZER, argument="tokenizer"))


def _published_tokenizer(source: _saccade.ProcessorSource) -> str:
    """The tokenizer for a checkpoint without one: that of its release, or else one with the same ids.

    Raises:
        FileNotFoundError: None of them can be had.
        PermissionError: The Hub denies access to one that comes first.
    """
    problems: list[str] = []
    for name in source.published:
        try:
            found = locate_published(name, files=TOKENIZER, argument="tokenizer").path
        except FileNotFoundError as error:
            problems.append(str(error))
            continue
        if problems:
            warn(f"tokenizer: using {name} in place of {source.published[0]} ({problems[0]})")
        return os.fspath(found)
    commands = [f"hf download {name} {' '.join(source.needed_files)}" for name in source.published]
    listed = "".join(f"\n  {problem}" for problem in problems)
    raise FileNotFoundError(
        f"tokenizer: the checkpoint has none, and no published one can be used:{listed}\nDownload that of "
        f"{source.version.upper()} with: {' or: '.join(commands)}. Or pass tokenizer=, a tokenizer.json or a "
        "directory with vocab.json and merges.txt"
    )
