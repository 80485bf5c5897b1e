"""The pages of the commands: what `saccade COMMAND --help` prints here."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path
from unittest import mock

from saccade import cli

#: Columns of the help, so that it does not depend on a terminal.
WIDTH = "84"


def write_all(folder: Path) -> None:
    """Writes a page of each command below a new folder, and one for all of them."""
    folder.mkdir(parents=True)
    for name, line in {**cli.COMMANDS, **cli.LAB_COMMANDS}.items():
        text = f"# saccade {name}\n\n{line[0].upper()}{line[1:]}.\n\n```text\n{help_of(name)}```\n"
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    names = "\n".join([*cli.COMMANDS, *cli.LAB_COMMANDS])
    text = f"# Commands\n\n```text\n{help_of()}```\n\n```{{toctree}}\n:hidden:\n\n{names}\n```\n"
    (folder / "index.md").write_text(text, encoding="utf-8")


def help_of(*words: str) -> str:
    """What `saccade WORDS --help` prints."""
    printed = io.StringIO()
    with (
        mock.patch.dict(os.environ, COLUMNS=WIDTH, NO_COLOR="1"),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        cli.build_parser(words[0] if words else None).parse_args([*words, "--help"])
    text = printed.getvalue()
    if not text.startswith("usage: saccade"):
        raise SystemExit(f"docs: saccade {' '.join(words)} --help printed {text[:80]!r}, expected its usage")
    return text
