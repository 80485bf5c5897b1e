"""Builds the wheel: one file for every CPython from 3.10 on, for x86-64 Linux with an old glibc.

    python .ci/wheels/build.py --out dist

The sources are those of the last commit, unpacked into an empty folder, so that nothing else that lies in the
checkout gets into the wheel; times in it are the commit's. The same commit, Rust and tools give the same
bytes: `--twice` builds in two folders and compares. Runs in an environment that holds `requirements.txt`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
#: The oldest glibc that the wheel runs with, as platform tag: the oldest that Rust supports.
COMPATIBILITY = "manylinux_2_17"
BUILD = (
    f"-m maturin build --release --locked --quiet --zig --compatibility {COMPATIBILITY} --auditwheel check"
)


def git(*args: str) -> str:
    """What a git command prints, in the repository."""
    return subprocess.run(["git", *args], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def unpack(commit: str, folder: Path) -> None:
    """Puts the files of a commit, and no others, into `folder`."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)


def build(commit: str, folder: Path) -> Path:
    """Builds the wheel and returns it.

    Args:
        commit: What is built.
        folder: For the sources, what cargo compiles, and the wheel.
    """
    source, wheels = folder / "source", folder / "wheels"
    unpack(commit, source)
    shutil.rmtree(wheels, ignore_errors=True)
    cargo_home = os.environ.get("CARGO_HOME", str(Path.home() / ".cargo"))
    environment = {
        **os.environ,
        "SOURCE_DATE_EPOCH": git("show", "--no-patch", "--format=%ct", commit),
        # Panic messages name source files: by neither this folder nor the home directory.
        "RUSTFLAGS": f"--remap-path-prefix={source}=saccade --remap-path-prefix={cargo_home}=cargo",
        "CARGO_TARGET_DIR": str(folder / "target"),
        "CARGO_INCREMENTAL": "0",
        # Where maturin looks for the Python that has Zig.
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    command = [sys.executable, *BUILD.split(), "--out", str(wheels)]
    subprocess.run(command, cwd=source, env=environment, check=True)
    (wheel,) = wheels.glob("*.whl")
    return wheel


def digest(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def main() -> int:
    """Builds, compares if asked to, checks the platform tag."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the wheel (default: dist)")
    parser.add_argument(
        "--work", type=Path, default=ROOT / "target" / "wheel", help="what is kept between builds"
    )
    parser.add_argument(
        "--twice", action="store_true", help="build again from nothing; the bytes must be equal"
    )
    args = parser.parse_args()
    if git("status", "--porcelain", "--untracked-files=no"):
        print("note: built from the last commit; changes that are not committed are left out", flush=True)
    commit = git("rev-parse", "HEAD")  # another may come while this one is built
    built = build(commit, args.work.resolve())
    if args.twice:
        with tempfile.TemporaryDirectory() as folder:
            again = build(commit, Path(folder).resolve())
            if digest(again) != digest(built):
                shutil.copy2(again, built.with_suffix(".again.whl"))
                print(f"the two wheels differ: {built}, {built.with_suffix('.again.whl')}", file=sys.stderr)
                return 1
        print("two builds in different folders are equal byte for byte")
    args.out.mkdir(parents=True, exist_ok=True)
    wheel = args.out / built.name
    partial = wheel.with_suffix(".partial")
    shutil.copyfile(built, partial)
    partial.replace(wheel)
    subprocess.run([sys.executable, "-m", "auditwheel", "show", str(wheel)], check=True)
    print(f"{wheel}: {wheel.stat().st_size} bytes, commit {commit[:7]}")
    print(f"sha256 {digest(wheel)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
