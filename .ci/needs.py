"""Reports missing system requirements and the packages that provide them, before a long build starts.

    python3 .ci/needs.py python rust opengl

Runs on Python 3.6 and later, so that users of an old Python get a clear message.
"""

import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

OLDEST_PYTHON = (3, 10)
CARGO_TOML = Path(__file__).resolve().parent.parent / "Cargo.toml"


def lacks_python():
    """What is wrong with this interpreter, or None."""
    if sys.version_info[:2] < OLDEST_PYTHON:
        oldest = ".".join(map(str, OLDEST_PYTHON))
        return (
            f"Python {oldest} or newer is needed; {sys.executable} is {sys.version.split()[0]}."
            "\n    To use another one: make PYTHON=/path/to/python3 ..."
        )
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        return (
            f"{sys.executable} cannot create virtual environments."
            "\n    Debian, Ubuntu: apt-get install python3-venv"
        )
    return None


def lacks_rust():
    """What is wrong with the Rust toolchain, or None."""
    oldest = re.search(r'rust-version = "([\d.]+)"', CARGO_TOML.read_text()).group(1)
    how = "\n    Install or update it with rustup (rustup.rs), then: rustup update stable"
    if not shutil.which("cargo"):
        return f"Rust {oldest} or newer is needed; no cargo was found on PATH.{how}"
    said = subprocess.run(["cargo", "--version"], stdout=subprocess.PIPE, check=False).stdout.decode().strip()
    found = re.search(r"(\d+)\.(\d+)", said)
    if not found or tuple(map(int, found.groups())) < tuple(map(int, oldest.split(".")[:2])):
        return f"Rust {oldest} or newer is needed; found {said or 'a cargo that does not run'}.{how}"
    # On Windows Rust finds Visual Studio's linker by itself.
    if sys.platform != "win32" and not shutil.which("cc"):
        return (
            "Rust needs a C compiler to link with; no cc was found on PATH."
            "\n    Debian, Ubuntu: apt-get install build-essential"
            "\n    Fedora: dnf install gcc"
        )
    return None


def lacks_opengl():
    """What is missing for rendering without a display, or None."""
    if not sys.platform.startswith("linux"):
        return None  # macOS and Windows include it
    for name in ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6"):
        try:
            ctypes.CDLL(name)
            return None
        except OSError:
            pass
    return (
        "The simulation renders with OpenGL; neither libEGL nor libOSMesa was found."
        "\n    Debian, Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
        "\n    Fedora: dnf install mesa-libEGL mesa-dri-drivers"
        "\n    Arch: pacman -S mesa"
    )


def lacks_browser():
    """What is missing for testing a web page without a display, or None."""
    if shutil.which("chromium") and shutil.which("chromedriver"):
        return None
    return (
        "Chromium and its driver were not found; the tests of the attention page are skipped without them."
        "\n    Debian: apt-get install chromium chromium-driver"
    )


def lacks_qemu():
    """What is missing for emulating an old CPU, or None."""
    if shutil.which("qemu-x86_64"):
        return None
    return (
        "Emulating old CPUs needs qemu-user; no qemu-x86_64 was found on PATH."
        "\n    Debian, Ubuntu: apt-get install qemu-user"
    )


CHECKS = {
    "python": lacks_python,
    "rust": lacks_rust,
    "opengl": lacks_opengl,
    "browser": lacks_browser,
    "qemu": lacks_qemu,
}


def main():
    """Prints a paragraph for each missing requirement. The exit status is 1 if there is one."""
    problems = [problem for problem in (CHECKS[name]() for name in sys.argv[1:]) if problem]
    for problem in problems:
        print(f"missing: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
