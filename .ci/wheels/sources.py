"""Writes the source archives of the last commit, and builds each of them from itself.

    python .ci/wheels/sources.py --out dist [--no-build]

A source archive is what distributors build from, and pip where no wheel fits. Each is unpacked into an empty
folder and must give a wheel there, without the checkout. Needs an environment with `requirements/wheels.txt`
and Rust.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from build import PACK, PURE, ROOT, git, unpack

#: Writes the source archive of the folder that it runs in.
FLIT = "import sys; from flit_core import buildapi; buildapi.build_sdist(sys.argv[1])"


def write(commit: str, folder: Path) -> list[Path]:
    """The source archives of a commit, below `folder`: of saccade, the lab and the plugin."""
    source, archives = folder / "source", folder / "archives"
    unpack(commit, source)
    archives.mkdir()
    environment = os.environ | {"SOURCE_DATE_EPOCH": git("show", "--no-patch", "--format=%ct", commit)}
    maturin = [sys.executable, "-m", "maturin", "sdist", "--out", str(archives)]
    subprocess.run(maturin, cwd=source, env=environment, check=True)
    flit = [sys.executable, "-c", FLIT, str(archives)]
    for name in PURE:
        subprocess.run(flit, cwd=source / name, env=environment, check=True)
    return sorted(archives.glob("*.tar.gz"))


def build(archive: Path, folder: Path) -> Path:
    """The wheel that a source archive gives in an empty folder."""
    with tarfile.open(archive) as opened:
        opened.extractall(folder, filter="data")
    (tree,) = folder.iterdir()
    wheels = folder / "wheels"
    # maturin looks on PATH for itself, as pip's builds do.
    # Not --locked: Cargo.lock also has what benches need, which the archive leaves out.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path}
    command = [sys.executable, *PACK.split(), "--wheel-dir", str(wheels), str(tree)]
    subprocess.run(command, cwd=folder, env=environment, check=True)
    (wheel,) = wheels.glob("*.whl")
    return wheel


def main() -> int:
    """Writes, builds, and copies the archives."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder (default: dist)")
    parser.add_argument("--no-build", action="store_true", help="write the archives only")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        archives = write(git("rev-parse", "HEAD"), folder)
        for archive in archives:
            if not args.no_build:
                (folder / archive.stem).mkdir()
                print(f"{archive.name}: builds {build(archive, folder / archive.stem).name}", flush=True)
        args.out.mkdir(parents=True, exist_ok=True)
        for archive in archives:
            shutil.copy2(archive, args.out / archive.name)
    print(f"{args.out}: {', '.join(archive.name for archive in archives)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
