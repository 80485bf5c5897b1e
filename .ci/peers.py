"""The environments of `make bench-peers`, one for each release of GR00T, and the libraries of ggml."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Sequence

import nox
from environments import ENVIRONMENTS, PROGRAMS, ROOT, Environment, digest

SCRIPTS = ROOT / "benches" / "peers"
LIBRARIES = ENVIRONMENTS / "ggml"
#: What a build leaves in its folder.
MADE = {"ggml": "build/bin/libggml.so", "vla": "libvla.so"}


def releases(options: Sequence[str]) -> list[str]:
    """The releases that a run measures: that of `--release`, or both of the whole policy."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--release")
    parser.add_argument("--only", nargs="+", default=[])
    found, _ = parser.parse_known_args(options)
    if found.release is not None:
        return [found.release]
    return ["n1.5", "n1.7"] if found.only == ["policy"] else ["n1.5"]


def environment_of(session: nox.Session, release: str) -> tuple[Environment, dict[str, str]]:
    """The environment with the lerobot of a release, and the variables that `benches.peers` needs in it."""
    if release == "n1.7":
        python = os.environ.get("SACCADE_PYTHON312") or shutil.which("python3.12")
        if python is None:
            session.error("lerobot 0.6.1 needs Python 3.12: put python3.12 on PATH, or set SACCADE_PYTHON312")
        environment = Environment(session, ENVIRONMENTS / "peers-n17", python)
        environment.install("lerobot-0.6.1", "tests/compat").install("peers-n17")
    else:
        environment = Environment(session, ENVIRONMENTS / "peers").install("peers")
    environment.install_saccade().install_lab()
    LIBRARIES.mkdir(exist_ok=True)
    ggml = digest([SCRIPTS / "build_ggml.sh"])
    # It is optional: without it, the report has no rows of ggml and says so.
    build(environment, "ggml", ggml, optional=True)
    if source := os.environ.get("VLA_SOURCE", ""):
        command = ("git", "-C", source, "describe", "--always", "--dirty", "--exclude", "*")
        commit = str(session.run(*command, external=True, silent=True, log=False)).strip()
        build(environment, "vla", f"{ggml} {digest([SCRIPTS / 'build_vla.sh'])} {commit}", source)
    return environment, {
        "SACCADE_PEERS_GGML": str(LIBRARIES / "ggml/build/bin"),
        "SACCADE_PEERS_VLA": str(LIBRARIES / "vla"),
    }


def build(
    environment: Environment, name: str, made_from: str, *arguments: str, optional: bool = False
) -> None:
    """Runs benches/peers/build_NAME.sh, unless the library is there and made from the same as before."""
    stamp, library = LIBRARIES / f"{name}.txt", LIBRARIES / name / MADE[name]
    if library.exists() and stamp.exists() and stamp.read_text() == made_from:
        return
    print(f"setup: {name} (takes minutes)", flush=True)
    path = os.pathsep.join((str(environment.folder / PROGRAMS), os.environ["PATH"]))
    environment.session.run(
        "sh",
        str(SCRIPTS / f"build_{name}.sh"),
        str(LIBRARIES),
        *arguments,
        external=True,
        env={"PATH": path},
        success_codes=range(256) if optional else [0],
    )
    stamp.write_text(made_from)
