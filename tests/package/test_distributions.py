"""What the three distributions contain: everything that their packages read, both licences, nothing else."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
VERSION = re.search(r'^version = "(.+)"', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)[1]  # type: ignore[index]
#: Folder -> the package in it, of the distributions that are pure Python.
PURE = {"lab": "saccade_lab", "plugins/lerobot": "lerobot_policy_saccade"}
#: What the extension is called in a wheel.
EXTENSION = "_saccade.pyd" if sys.platform == "win32" else "_saccade.abi3.so"
LICENCES = {"LICENSE-MIT", "LICENSE-APACHE"}


def run(*command: str | Path, cwd: Path = ROOT, **variables: str) -> str:
    """What a program prints."""
    words = list(map(str, command))
    environment = {**os.environ, **variables}
    return subprocess.run(words, check=True, capture_output=True, text=True, cwd=cwd, env=environment).stdout


def names_in(archive: Path) -> set[str]:
    """What a source archive contains."""
    with tarfile.open(archive) as file:
        return set(file.getnames())


def files_of(package: Path) -> set[str]:
    """The files of a package, relative to its folder's parent."""
    files = (path for path in package.rglob("*") if path.is_file())
    kept = (path for path in files if path.suffix not in (".pyc", ".so", ".pyd"))
    return {path.relative_to(package.parent).as_posix() for path in kept}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of saccade made from this tree, with the Rust code as it was built for the tests."""
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "maturin", "build", "--release", "--locked", "--quiet", "--out", folder)
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_serves_every_python_and_holds_what_the_package_reads(wheel: Path) -> None:
    assert wheel.name.startswith(f"saccade_vla-{VERSION}-cp310-abi3-")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        demo = [info for info in archive.infolist() if "/checkpoints/demo/" in info.filename]
    sources = files_of(ROOT / "python" / "saccade")
    folder = f"saccade_vla-{VERSION}.dist-info"
    assert {name for name in names if not name.startswith(folder)} == sources | {f"saccade/{EXTENSION}"}
    assert {f"saccade/checkpoints/demo/{name}" for name in ("config.json", "model.safetensors")} <= names
    assert sum(info.file_size for info in demo) < 10_000_000
    assert {f"{folder}/licenses/{name}" for name in LICENCES} <= names


def test_wheel_works_without_the_source_tree(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    code = (
        "import numpy as np, saccade, pathlib;"
        "package = pathlib.Path(saccade.__file__).parent;"
        "head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint()); c = head.config;"
        "features, state = np.zeros((1, 5, c.context_dim)), np.zeros((1, c.state_dim));"
        "actions = head(features, state, 0, seed=0);"
        "print(package.parent); print(actions.shape == (1, c.action_horizon, c.action_dim))"
    )
    said = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(site))
    assert said.splitlines() == [str(site), "True"]


def test_source_archive_has_the_licences_and_the_bundled_policy(tmp_path: Path) -> None:
    run(sys.executable, "-m", "maturin", "sdist", "--out", tmp_path)
    (archive,) = tmp_path.glob("*.tar.gz")
    folder = f"saccade_vla-{VERSION}"
    names = names_in(archive)
    assert {f"{folder}/{name}" for name in LICENCES} <= names
    assert f"{folder}/python/saccade/checkpoints/demo/model.safetensors" in names


@pytest.mark.parametrize(("folder", "package"), PURE.items())
def test_pure_distributions_hold_their_packages(folder: str, package: str, tmp_path: Path) -> None:
    code = (
        "import sys; from flit_core import buildapi;"
        "buildapi.build_wheel(sys.argv[1]); buildapi.build_sdist(sys.argv[1])"
    )
    run(sys.executable, "-c", code, tmp_path, cwd=ROOT / folder)
    (wheel,) = tmp_path.glob("*.whl")
    (archive,) = tmp_path.glob("*.tar.gz")
    sources = files_of(ROOT / folder / package)
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name for name in names if ".dist-info/" not in name} == sources
    assert {Path(name).name for name in names if ".dist-info/licenses/" in name} == LICENCES
    in_archive = {name.partition("/")[2] for name in names_in(archive)}
    assert sources | LICENCES <= in_archive


@pytest.mark.parametrize("folder", PURE)
@pytest.mark.parametrize("name", sorted(LICENCES))
def test_licences_are_copies(folder: str, name: str) -> None:
    assert (ROOT / folder / name).read_bytes() == (ROOT / name).read_bytes()
