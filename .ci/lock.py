"""Writes constraints.txt: one exact version of every Python package in the development environment.

Each given interpreter resolves `.[all]` to the newest compatible versions. Where the versions differ, lines
carry a marker. The last interpreter's versions also apply to every newer Python.

    python .ci/lock.py python3.10 python3.11
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RELEASED_HEAD = "lerobot==0.4.4"  # installed without its requirements, so it is not in an extra of saccade
# The numbers in the docs were measured with these versions. Change them deliberately, not in a refresh.
HELD = ("torch==2.13.0", "gymnasium==1.4.0")
HEADER = f"""\
# One exact version of every Python package in the development environment; every pip call of the Makefile
# uses it. Do not edit: `python .ci/lock.py python3.10 python3.11` writes it. Then run `make test`.
{RELEASED_HEAD}
"""


def resolve(python: str) -> dict[str, str]:
    """Package name -> version, as that interpreter's pip would install them into an empty environment."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        report = Path(folder, "report.json")
        pip = [str(Path(folder, "bin", "python")), "-m", "pip", "install", "--quiet"]
        subprocess.run(
            [*pip, "--dry-run", "--ignore-installed", "--report", str(report), f"{ROOT}[all]", *HELD],
            check=True,
        )
        packages = [item["metadata"] for item in json.loads(report.read_text())["install"]]
    versions = {re.sub(r"[-_.]+", "-", package["name"]).lower(): package["version"] for package in packages}
    del versions["saccade"]
    return versions


def python_version(python: str) -> str:
    """`3.11` for an interpreter of that version."""
    command = [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def marked_lines(resolved: dict[str, dict[str, str]]) -> list[str]:
    """The lines of constraints.txt.

    Args:
        resolved: Python version -> package name -> package version, in ascending order of Python versions.
    """
    pythons = list(resolved)
    markers = {python: f'; python_version == "{python}"' for python in pythons}
    markers[pythons[-1]] = f'; python_version >= "{pythons[-1]}"'
    lines = []
    for name in sorted({name for versions in resolved.values() for name in versions}):
        found = {python: versions[name] for python, versions in resolved.items() if name in versions}
        if len(found) == len(pythons) and len(set(found.values())) == 1:
            lines.append(f"{name}=={found[pythons[0]]}")
        else:
            lines += [f"{name}=={version} {markers[python]}" for python, version in found.items()]
    return lines


def main() -> None:
    """Resolves for each interpreter of the command line, in ascending order."""
    resolved = {python_version(python): resolve(python) for python in sys.argv[1:]}
    (ROOT / "constraints.txt").write_text(HEADER + "\n".join(marked_lines(resolved)) + "\n")


if __name__ == "__main__":
    main()
