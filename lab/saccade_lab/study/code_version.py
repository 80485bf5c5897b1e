"""Which saccade measured something."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

import saccade

SECONDS = 10  # to wait for git


@functools.cache
def code_version() -> str:
    """The version of saccade; in a clone, followed by the commit, as a local version of PEP 440.

    ``0.1.0+g0123456789ab`` was installed in place from that commit, and ``0.1.0+g0123456789ab.changed`` had
    changes of the package or the crates that were not committed. It is found at the first call: a commit that
    is made between the import and that call would be named instead.
    """
    package = Path(saccade.__file__).resolve().parent
    root = package.parents[1]
    try:
        if Path(git(root, "rev-parse", "--show-toplevel")).resolve() != root:
            return saccade.__version__  # installed in an environment that is inside another clone
        commit = git(root, "rev-parse", "--short=12", "HEAD")
        changed = git(root, "--no-optional-locks", "status", "--porcelain", "--", str(package), "crates")
    except (OSError, subprocess.SubprocessError):  # no git, or no clone
        return saccade.__version__
    return f"{saccade.__version__}+g{commit}{'.changed' if changed else ''}"


def git(directory: Path, *arguments: str) -> str:
    """What a git command prints."""
    done = subprocess.run(
        ["git", "-C", str(directory), *arguments],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=True,
    )
    return done.stdout.strip()
