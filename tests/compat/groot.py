"""Runs Isaac-GR00T's released clients, unmodified, against `saccade serve`.

    python tests/compat/groot.py --clone PATH [PATH ...] [--releases n1.5]

Nothing is fetched: the clients are read with `git show` from local clones, at the commits that
isaac-groot.txt names; `make test-clients CLIENTS_ARGS="--clone PATH"` does the same. The environment is
`.venv-compat-groot` next to the Makefile. It is created again when its list of packages changes.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PACKAGES = HERE / "isaac-groot.txt"
FOLDER = ROOT / ".venv-compat-groot"
SOURCES = ROOT / "out" / "compat" / "groot"
PIP = ("-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--quiet", "--no-deps")


@dataclass(frozen=True)
class Part:
    """A file of a release. Of a file that imports much else, only the named classes are kept.

    Attributes:
        path: Its path.
        classes: The classes, or empty for the whole file.
        imports: Lines that these classes need.
    """

    path: str
    classes: tuple[str, ...] = ()
    imports: str = ""


_MESSAGES = (
    Part("gr00t/data/embodiment_tags.py"),
    Part("gr00t/data/types.py"),
    Part("gr00t/data/utils.py"),
    Part("gr00t/configs/data/embodiment_configs.py"),
    Part("gr00t/policy/policy.py"),
    Part("gr00t/policy/server_client.py"),
)
_BASE = Part(
    "gr00t/model/policy.py",
    ("BasePolicy",),
    "from abc import ABC, abstractmethod\nfrom typing import *\n"
    "from gr00t.data.dataset import ModalityConfig\n",
)
_CONFIG = Part("gr00t/data/dataset.py", ("ModalityConfig",), "from pydantic import BaseModel\n")

#: What is read of each release: the client's own files as they are, and what they import.
RELEASES = {
    "n1": (Part("gr00t/eval/service.py"),),
    "n1.5-early": (Part("gr00t/eval/service.py"),),
    "n1.5": (Part("gr00t/eval/service.py"), Part("gr00t/eval/robot.py"), _CONFIG, _BASE),
    "n1.6": _MESSAGES,
    "n1.7": _MESSAGES,
}


def main() -> None:
    """Sets up, reads the clients and runs the tests."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--clone", type=Path, nargs="+", required=True, help="clones with the commits")
    parser.add_argument("--releases", nargs="+", choices=RELEASES, default=list(RELEASES))
    options = parser.parse_args()
    for release in options.releases:
        read(release, options.clone)
    set_up()
    paths = os.pathsep.join(map(str, (ROOT / "python", ROOT / "lab", ROOT, HERE)))
    command = [str(FOLDER / "bin" / "python"), "-m", "pytest", "--noconftest", "--quiet"]
    chosen = {"SACCADE_GROOT_SOURCES": str(SOURCES), "SACCADE_GROOT_RELEASES": " ".join(options.releases)}
    done = subprocess.run(
        [*command, str(HERE / "groot_clients.py")], cwd=ROOT, env=os.environ | {"PYTHONPATH": paths} | chosen
    )
    sys.exit(done.returncode)


def commits() -> dict[str, str]:
    """The commit of each release, from the list of packages."""
    return dict(re.findall(r"^# (n[\w.-]+) +([0-9a-f]{40})", PACKAGES.read_text(), re.MULTILINE))


def read(release: str, clones: list[Path]) -> None:
    """Writes the files of a release below `SOURCES`."""
    commit = commits()[release]
    folder = SOURCES / release
    shutil.rmtree(folder, ignore_errors=True)
    for part in RELEASES[release]:
        text = show(f"{commit}:{part.path}", clones)
        if part.classes:
            text = part.imports + "\n\n".join(classes(text, part.classes))
        path = folder / part.path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def show(name: str, clones: list[Path]) -> str:
    """A file from the first clone that has it."""
    for clone in clones:
        done = subprocess.run(["git", "-C", clone, "show", name], capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return done.stdout
    sys.exit(f"{name}: in none of the clones {', '.join(map(str, clones))}")


def classes(text: str, names: tuple[str, ...]) -> list[str]:
    """The source of classes, as it is."""
    found = {node.name: node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)}
    return [ast.get_source_segment(text, found[name]) or "" for name in names]


def set_up() -> None:
    """Creates the environment on top of the one that runs this, unless it exists."""
    stamp = FOLDER / "packages.txt"
    if stamp.is_file() and stamp.read_text() == PACKAGES.read_text():
        return
    print("setup: Isaac-GR00T's clients", flush=True)
    subprocess.run([sys.executable, "-m", "venv", "--clear", FOLDER], check=True)
    python = FOLDER / "bin" / "python"
    below, own = (
        subprocess.run(
            [interpreter, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        for interpreter in (sys.executable, python)
    )
    Path(own, "below.pth").write_text(f"{below}\n")
    subprocess.run([python, *PIP, "--requirement", str(PACKAGES)], check=True)
    stamp.write_text(PACKAGES.read_text())


if __name__ == "__main__":
    main()
