"""Builds the wheels of saccade (one file for every CPython from 3.10 on), of the lab and of the plugin.

    python .ci/wheels/build.py --out dist [--target aarch64-unknown-linux-gnu]

Those for Linux, with an old glibc or with musl, are built on any Linux, because Zig links them; those for
macOS and Windows on such a machine. The sources are those of the last commit, unpacked into an empty folder,
so that no other file of the checkout gets into a wheel. Timestamps are the commit's. The same commit, Rust
and tools give the same bytes; `--twice` builds in two folders and compares. Needs an environment with
`requirements/wheels.txt`.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import published
import version
from links import absolute

ROOT = Path(__file__).resolve().parent.parent.parent
#: Without the default features of the binding, which only tests need.
BUILD = "-m maturin build --release --locked --quiet --no-default-features"
#: In addition on Linux; what follows is a platform tag.
LINK_WITH_ZIG = "--zig --auditwheel check --compatibility"
#: Pure Python, the same for every target. The plugin needs lerobot to run, but not to be packed.
PURE = ("./lab", "./plugins/lerobot")
PACK = (
    "-m pip --disable-pip-version-check wheel --quiet --no-deps --no-build-isolation --ignore-requires-python"
)

#: What wheels are built for, and on Linux the platform tag: the oldest glibc and musl that Rust supports.
TARGETS = {
    "x86_64-unknown-linux-gnu": "manylinux_2_17",
    "aarch64-unknown-linux-gnu": "manylinux_2_17",
    "x86_64-unknown-linux-musl": "musllinux_1_2",
    "aarch64-unknown-linux-musl": "musllinux_1_2",
    "aarch64-apple-darwin": None,
    "x86_64-pc-windows-msvc": None,
}
DEFAULT_TARGET = "x86_64-unknown-linux-gnu"
#: A compiler with the ARM standard library, which `.ci/aarch64/run.sh setup` puts there.
ARM_COMPILER = ROOT / "target" / "aarch64" / "bin" / "rustc"


def git(*args: str) -> str:
    """The output of a git command in the repository."""
    return subprocess.run(["git", *args], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def unpack(commit: str, folder: Path) -> None:
    """Unpacks the files of a commit into an empty `folder`; READMEs get links that lead out of it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as opened:  # tar is another program on each system
        opened.extractall(folder, filter="data")
    for name in ("", *PURE):
        readme = folder / name / "README.md"
        text = readme.read_text(encoding="utf-8")
        tag, place = f"v{version.held(folder)}", name.removeprefix("./")
        readme.write_bytes(absolute(text, place, published.held(folder), tag).encode())


def has_standard_library(target: str) -> bool:
    """Whether the Rust on PATH can build for `target`."""
    said = subprocess.run(
        ["rustc", "--print", "target-libdir", "--target", target], capture_output=True, text=True
    )
    return said.returncode == 0 and Path(said.stdout.strip()).is_dir()


def build(commit: str, folder: Path, target: str) -> list[Path]:
    """Builds the wheels and returns them, that of saccade first.

    Args:
        commit: The commit to build.
        folder: For the sources, the build outputs and the wheel.
        target: One of `TARGETS`.
    """
    source, wheels = folder / "source", folder / "wheels"
    unpack(commit, source)
    shutil.rmtree(wheels, ignore_errors=True)
    cargo_home = os.environ.get("CARGO_HOME", str(Path.home() / ".cargo"))
    environment = {
        **os.environ,
        "SOURCE_DATE_EPOCH": git("show", "--no-patch", "--format=%ct", commit),
        # Panic messages contain source paths, which must name neither this folder nor the home directory.
        "RUSTFLAGS": f"--remap-path-prefix={source}=saccade --remap-path-prefix={cargo_home}=cargo",
        "CARGO_TARGET_DIR": str(folder / "target"),
        "CARGO_INCREMENTAL": "0",
        # maturin looks here for the Python that has Zig.
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    if not has_standard_library(target):
        environment["RUSTC"] = str(ARM_COMPILER)
    tag = TARGETS[target]
    link = [*LINK_WITH_ZIG.split(), tag] if tag else []
    command = [sys.executable, *BUILD.split(), *link, "--target", target, "--out", str(wheels)]
    subprocess.run(command, cwd=source, env=environment, check=True)
    (wheel,) = wheels.glob("*.whl")
    pack = [sys.executable, *PACK.split(), "--wheel-dir", str(wheels), *PURE]
    subprocess.run(pack, cwd=source, env=environment, check=True)
    return [wheel, *sorted(set(wheels.glob("*.whl")) - {wheel})]


def digest(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def main() -> int:
    """Builds, optionally compares two builds, and checks the platform tag."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "dist", help="folder of the wheels (default: dist)"
    )
    parser.add_argument(
        "--work", type=Path, default=ROOT / "target" / "wheel", help="folder that is kept between builds"
    )
    parser.add_argument(
        "--target", choices=TARGETS, default=DEFAULT_TARGET, help=f"default: {DEFAULT_TARGET}"
    )
    parser.add_argument(
        "--twice", action="store_true", help="build a second time from scratch; the bytes must be equal"
    )
    args = parser.parse_args()
    if git("status", "--porcelain", "--untracked-files=no"):
        print("note: building the last commit; uncommitted changes are not included", flush=True)
    if not has_standard_library(args.target) and not (
        args.target == "aarch64-unknown-linux-gnu" and ARM_COMPILER.exists()
    ):
        how = f"rustup target add {args.target}, or on Debian: .ci/aarch64/run.sh setup"
        print(f"this Rust has no standard library for {args.target}: {how}", file=sys.stderr)
        return 1
    commit = git("rev-parse", "HEAD")  # another commit may be made during the build
    built = build(commit, args.work.resolve(), args.target)
    if args.twice:
        with tempfile.TemporaryDirectory() as folder:
            again = build(commit, Path(folder).resolve(), args.target)
            for first, second in zip(built, again, strict=True):
                if digest(first) != digest(second):
                    kept = shutil.copy2(second, first.with_suffix(".again.whl"))
                    print(f"the two wheels differ: {first}, {kept}", file=sys.stderr)
                    return 1
        print("two builds in different folders are equal byte for byte")
    args.out.mkdir(parents=True, exist_ok=True)
    for file in built:
        partial = args.out / f"{file.name}.partial"
        shutil.copyfile(file, partial)
        partial.replace(args.out / file.name)
    wheel = args.out / built[0].name
    wheel.with_suffix(".commit").write_text(commit[:7] + "\n")  # for the page of `test.py`
    # maturin has checked the tag. auditwheel fails on wheels for musl where the system has glibc: the
    # libc.so that it finds there is a script of the linker.
    if args.target.endswith("-gnu"):
        subprocess.run([sys.executable, "-m", "auditwheel", "show", str(wheel)], check=True)
    print(f"{wheel}: {wheel.stat().st_size} bytes, commit {commit[:7]}")
    print(f"sha256 {digest(wheel)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
