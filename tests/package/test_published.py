"""What is known only when the project is published: it is written everywhere, and a release needs it."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.systems import posix

SCRIPT = ROOT / ".ci" / "published.py"
ADDRESS = "https://github.com/someone/saccade"
NAMES = {"saccade-vla", "saccade-vla-lab", "lerobot-policy-saccade"}


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """`.ci/published.py` as a module."""
    monkeypatch.syspath_prepend(SCRIPT.parent)
    return importlib.import_module("published")


@pytest.fixture
def links(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """`.ci/wheels/links.py` as a module."""
    monkeypatch.syspath_prepend(SCRIPT.parent / "wheels")
    return importlib.import_module("links")


@pytest.fixture
def tree(tmp_path: Path, program: ModuleType) -> Path:
    """A copy of the files that the program reads, as they are before the project is published."""
    if program.held(ROOT) != program.UNKNOWN:
        pytest.skip("the project is published")
    files = {ROOT / name for name in program.ADDRESSED} | set(program.pages(ROOT))
    for path in files:
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    return tmp_path


def test_every_file_says_the_same_and_a_release_needs_the_address(program: ModuleType) -> None:
    unknown = program.held(ROOT) == program.UNKNOWN
    found = program.problems(ROOT)
    assert [line.startswith("Cargo.toml: the address is not known") for line in found] == [True] * unknown
    done = subprocess.run([sys.executable, SCRIPT, "--check"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (unknown, "".join(f"published: {line}\n" for line in found))


def test_the_address_is_written_everywhere_and_pages_install_from_the_index(
    program: ModuleType, tree: Path
) -> None:
    program.write(tree, ADDRESS)
    assert program.problems(tree) == []
    project = (tree / "pyproject.toml").read_text()
    assert f'Repository = "{ADDRESS}"\nDocumentation = "https://someone.github.io/saccade"\n' in project
    installed = set()
    for path in program.pages(tree):
        for command in re.findall(r"pip install ([^`#\n&]*)", path.read_text()):
            installed |= {re.sub(r'"?([\w-]+)(\[.*\])?"?', r"\1", word) for word in command.split()}
    assert installed <= NAMES | {"--no-deps"}
    assert installed >= NAMES
    assert "pip install saccade-vla\n" in (tree / "README.md").read_text()


def test_it_may_be_written_twice_and_moved(program: ModuleType, tree: Path) -> None:
    program.write(tree, ADDRESS)
    before = {path: path.read_text() for path in tree.rglob("*") if path.is_file()}
    program.write(tree, ADDRESS)
    assert {path: path.read_text() for path in before} == before
    program.write(tree, "https://github.com/others/vla")
    assert program.problems(tree) == []
    assert program.held(tree) == "https://github.com/others/vla"


def test_a_file_that_was_left_behind_is_named(program: ModuleType, tree: Path) -> None:
    page = (tree / "docs" / "tutorial.md").read_text()
    citation = (tree / "CITATION.cff").read_text()
    program.write(tree, ADDRESS)
    (tree / "docs" / "tutorial.md").write_text(page)
    (tree / "CITATION.cff").write_text(citation)
    assert program.problems(tree) == [
        f"CITATION.cff: expected the address {ADDRESS}",
        "CITATION.cff: holds an address that does not exist",
        "docs/tutorial.md: says what was true before it was published",
    ]


@pytest.mark.parametrize(
    "words", [[], [ADDRESS, "--check"], ["https://example.org/x"], [f"{ADDRESS}.git"], [f"{ADDRESS}/"]]
)
def test_nonsense_is_refused(words: list[str]) -> None:
    done = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "expected" in done.stderr


def test_links_of_a_readme_lead_to_the_repository(links: ModuleType) -> None:
    text = (
        "![Moves](docs/a.gif) [next](docs/a.md#there) [up](../README.md) [here](#here) [web](https://x.org/)\n"
        "```text\n[in a fence](a.md)\n```\n"
    )
    assert links.absolute(text, "lab", ADDRESS, "v1.2.3") == (
        f"![Moves]({ADDRESS}/raw/v1.2.3/lab/docs/a.gif) [next]({ADDRESS}/blob/v1.2.3/lab/docs/a.md#there) "
        f"[up]({ADDRESS}/blob/v1.2.3/README.md) [here](#here) [web](https://x.org/)\n"
        "```text\n[in a fence](a.md)\n```\n"
    )


@pytest.mark.parametrize("folder", ["", "lab", "plugins/lerobot"])
def test_no_readme_of_a_package_keeps_a_relative_link(links: ModuleType, folder: str) -> None:
    text = links.absolute((ROOT / folder / "README.md").read_text(), folder, ADDRESS, "v1.2.3")
    targets = re.findall(r"\]\(([^)\s]+)", text)
    assert targets
    assert [target for target in targets if not target.startswith(("https://", "#"))] == []
    assert 'src="' not in text


@posix
@pytest.mark.parametrize(
    ("there", "published"),
    [
        ("", "--package saccade-vla-kernels --package saccade-vla-checkpoint --package saccade-vla"),
        ("saccade-vla-kernels saccade-vla-checkpoint", "--package saccade-vla"),
        ("saccade-vla-kernels saccade-vla-checkpoint saccade-vla", None),
    ],
)
def test_crates_that_the_index_has_are_not_uploaded_again(
    there: str, published: str | None, tmp_path: Path
) -> None:
    """`.ci/publish.sh` with a cargo that knows which crates are there."""
    version = re.search(r'^version = "(.+)"', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)[1]  # type: ignore[index]
    cases = " | ".join(f'"info --quiet --registry crates-io {name}@{version}"' for name in there.split())
    (tmp_path / "cargo").write_text(
        f"""#!/bin/sh
case "$*" in
{cases or "none"}) [ ! -e Cargo.toml ];;
info*) exit 101;;
*) echo "ran $*";;
esac
"""
    )
    (tmp_path / "cargo").chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    command: list[str | Path] = [ROOT / ".ci" / "publish.sh", "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    ran = [line for line in done.stdout.splitlines() if line.startswith("ran ")]
    assert ran == ([f"ran publish --locked {published} --dry-run"] if published else [])
