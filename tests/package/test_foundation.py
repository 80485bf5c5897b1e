"""What is installed and imported: light, typed, one version; what a machine lacks is named."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import saccade
from tests.helpers.systems import linux, posix

ROOT = Path(__file__).resolve().parents[2]
VERSION = re.search(r'^version = "(.+)"', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)[1]  # type: ignore[index]


def python(code: str, *, env: dict[str, str] | None = None, cwd: Path | None = None) -> str:
    """What a fresh interpreter prints for `code`."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=cwd, env=os.environ | (env or {})
    )
    return done.stdout.strip()


def test_import_runs_few_modules() -> None:
    # Modules are counted, not seconds: a busy machine makes every import slow.
    code = "import sys, numpy; before = set(sys.modules); import saccade; print(*set(sys.modules) - before)"
    loaded = python(code).split()
    own = {name for name in loaded if name.partition(".")[0] == "saccade"}
    foreign = set(loaded) - own
    assert len(foreign) < 40, sorted(foreign)
    assert len(own) < 80, sorted(own)
    assert {name.split(".")[1] for name in own if "." in name} & {
        "cli",
        "integrations",
        "serve",
        "torch",
    } == set()


def test_import_loads_numpy_and_nothing_else() -> None:
    code = (
        "import sys, numpy; before = set(sys.modules); import saccade; new = set(sys.modules) - before;"
        "names = {name.partition('.')[0] for name in new} - set(sys.stdlib_module_names);"
        "print(*sorted(names))"
    )
    assert python(code) in ("saccade", "numpy saccade")


@linux
def test_import_starts_no_thread() -> None:
    code = (
        "import os, numpy; count = lambda: len(os.listdir('/proc/self/task'));"
        "before = count(); import saccade; print(count() - before)"
    )
    assert python(code) == "0"


def test_one_version() -> None:
    assert saccade.__version__ == VERSION
    assert importlib.metadata.version("saccade-vla") == VERSION


def test_package_is_typed() -> None:
    package = Path(saccade.__file__).parent
    assert (package / "py.typed").is_file()
    assert (package / "_saccade.pyi").is_file()


def test_only_numpy_is_required_and_extras_are_named() -> None:
    metadata = importlib.metadata.metadata("saccade-vla")
    required = [line for line in metadata.get_all("Requires-Dist") or [] if "extra ==" not in line]
    assert required == ["numpy>=1.24"]
    assert set(metadata.get_all("Provides-Extra") or []) == {"cli", "data", "hub", "serve", "torch"}


@pytest.fixture
def needs() -> ModuleType:
    """`.ci/needs.py`, which says what the machine lacks."""
    spec = importlib.util.spec_from_file_location("needs", ROOT / ".ci" / "needs.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_nothing_is_missing_here(needs: ModuleType) -> None:
    # Without a browser the tests of the attention page are skipped.
    assert [needs.CHECKS[name]() for name in ("python", "rust", "opengl")] == [None, None, None]


def test_old_python_is_named(needs: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(needs, "OLDEST_PYTHON", (4, 0))
    assert "Python 4.0 or newer is needed" in needs.lacks_python()


@posix
def test_missing_or_old_rust_is_named(
    needs: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "no cargo was found" in needs.lacks_rust()
    cargo = tmp_path / "cargo"
    cargo.write_text("#!/bin/sh\necho 'cargo 1.70.0 (ec8a8a0ca 2023-04-25)'\n")
    cargo.chmod(0o755)
    assert "found cargo 1.70.0" in needs.lacks_rust()
    cargo.write_text("#!/bin/sh\necho 'cargo 1.99.0'\n")
    assert "no cc was found" in needs.lacks_rust()


@pytest.mark.parametrize(("platform", "missing"), [("linux", True), ("win32", False)])
def test_rust_needs_a_cc_on_path_except_on_windows(
    needs: ModuleType, monkeypatch: pytest.MonkeyPatch, platform: str, missing: bool
) -> None:
    said = subprocess.CompletedProcess(["cargo"], 0, stdout=b"cargo 1.999.0")
    monkeypatch.setattr(needs.shutil, "which", lambda name: name if name == "cargo" else None)
    monkeypatch.setattr(needs.subprocess, "run", lambda *words, **options: said)
    monkeypatch.setattr(sys, "platform", platform)
    assert (needs.lacks_rust() is not None) == missing


def test_missing_opengl_names_the_packages(needs: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(needs.ctypes, "CDLL", absent)
    monkeypatch.setattr(sys, "platform", "linux")
    assert "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri" in needs.lacks_opengl()


def test_every_problem_is_printed(
    needs: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        needs, "CHECKS", {"one": lambda: "this", "two": lambda: None, "three": lambda: "that"}
    )
    monkeypatch.setattr(sys, "argv", ["needs.py", "one", "two", "three"])
    assert needs.main() == 1
    assert capsys.readouterr().err == "missing: this\nmissing: that\n"


@posix
@pytest.mark.parametrize(
    ("installed", "default", "built_with"),
    [
        ("{oldest}.0", "1.999.0", "ran +{oldest}.0 build --locked "),
        ("{oldest}.0", "{oldest}.0", "cargo is the oldest"),  # everything else is built with it
        ("", "{oldest}.3", "cargo is the oldest"),
        ("", "1.999.0", None),
    ],
)
def test_the_declared_rust_is_what_builds(
    installed: str, default: str, built_with: str | None, tmp_path: Path
) -> None:
    """`.ci/oldest_rust.sh` with a cargo whose named and default toolchains are of these versions."""
    oldest = re.search(r'^rust-version = "(.+)"', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)[1]  # type: ignore[index]
    assert f"Rust {oldest} or newer" in (ROOT / "docs/quickstart.md").read_text()
    named, default = installed.format(oldest=oldest), default.format(oldest=oldest)
    (tmp_path / "cargo").write_text(
        f"#!/bin/sh\nversion={default}\n"
        f"case $1 in +{oldest}.0) version={named};; +*) exit 1;; esac\n"
        '[ -n "$version" ] || exit 1\n'
        'case "$*" in *--version) echo "cargo $version (date)";; *) echo "ran $*";; esac\n'
    )
    (tmp_path / "cargo").chmod(0o755)
    done = subprocess.run(
        [ROOT / ".ci/oldest_rust.sh"],
        capture_output=True,
        text=True,
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )
    if built_with is None:
        assert done.returncode == 1
        assert f"rustup toolchain install {oldest}.0" in done.stderr
    else:
        assert built_with.format(oldest=oldest) in done.stdout.splitlines()[-1]
