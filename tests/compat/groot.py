"""Runs Isaac-GR00T's released clients against `saccade serve`, its open loop against `evaluate`; unmodified.

    python tests/compat/groot.py --clone PATH [PATH ...] [--releases n1.5]

Nothing is fetched: the files are read with `git show` from local clones, at the commits that
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
    """A file of a release. Of a file that imports much else, only the named classes and functions are kept.

    Attributes:
        path: Its path.
        names: The classes and functions, or empty for the whole file.
        imports: Lines that these need.
    """

    path: str
    names: tuple[str, ...] = ()
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

_OPEN_LOOP_15 = Part(
    "gr00t/utils/eval.py",
    ("calc_mse_for_single_trajectory",),
    "from __future__ import annotations\nimport numpy as np\n",
)
#: The loop with the functions that it calls, and its reader of a step.
_OPEN_LOOP = (
    Part(
        "gr00t/eval/open_loop_eval.py",
        (
            "plot_trajectory_results",
            "parse_observation_gr00t",
            "parse_action_gr00t",
            "evaluate_single_trajectory",
        ),
        "from __future__ import annotations\nimport logging\n"
        "from copy import deepcopy\nfrom pathlib import Path\nfrom typing import Any\n"
        "import numpy as np\nimport pandas as pd\nfrom matplotlib import pyplot as plt\n"
        "from gr00t.data.dataset.sharded_single_step_dataset import extract_step_data\n",
    ),
    Part(
        "gr00t/data/dataset/sharded_single_step_dataset.py",
        ("extract_step_data",),
        "from __future__ import annotations\nimport numpy as np\nfrom gr00t.data.types import VLAStepData\n",
    ),
)

#: What is read of each release: the client's own files as they are, and what they import; the open loop.
RELEASES = {
    "n1": (Part("gr00t/eval/service.py"),),
    "n1.5-early": (Part("gr00t/eval/service.py"),),
    "n1.5": (Part("gr00t/eval/service.py"), Part("gr00t/eval/robot.py"), _CONFIG, _BASE, _OPEN_LOOP_15),
    "n1.6": (*_MESSAGES, *_OPEN_LOOP),
    "n1.7": (*_MESSAGES, *_OPEN_LOOP),
}
#: The tests.
TESTS = ("groot_clients.py", "groot_open_loop.py")


def main() -> None:
    """Sets up, reads the released files and runs the tests."""
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
    tests = [str(HERE / name) for name in TESTS]
    done = subprocess.run([*command, *tests], cwd=ROOT, env=os.environ | {"PYTHONPATH": paths} | chosen)
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
        if part.names:
            text = part.imports + "\n\n".join(definitions(text, part.names))
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


def definitions(text: str, names: tuple[str, ...]) -> list[str]:
    """The source of classes and functions, as it is."""
    kinds = (ast.ClassDef, ast.FunctionDef)
    found = {node.name: node for node in ast.parse(text).body if isinstance(node, kinds)}
    return [ast.get_source_segment(text, found[name]) or "" for name in names]


def set_up() -> None:
    """Creates the environment on top of the one that runs this, unless it exists."""
    stamp = FOLDER / "packages.txt"
    if stamp.is_file() and stamp.read_text() == PACKAGES.read_text():
        return
    print("setup: Isaac-GR00T's released code", flush=True)
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
