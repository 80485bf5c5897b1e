"""The documentation is tested: examples in docstrings and pages, commands, links, pictures."""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image, ImageSequence

import saccade
from saccade import cli
from saccade._internal.extras import SACCADE
from saccade_lab.extras import LAB
from tests.docs.test_docs_checkpoints import PAGES as WITH_CHECKPOINTS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "ARCHITECTURE.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    ROOT / "CODE_OF_CONDUCT.md",
    ROOT / "studies" / "README.md",
    ROOT / "lab" / "README.md",
    ROOT / "plugins" / "lerobot" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
#: These pages need checkpoints or a server: `test_docs_checkpoints` and `test_tutorial` run them.
NEED_MORE = (*(f"{name}.md" for name in WITH_CHECKPOINTS), "tutorial.md")
MODULES = sorted(
    info.name
    for info in pkgutil.walk_packages(saccade.__path__, "saccade.")
    if info.name not in ("saccade._saccade", "saccade.__main__")
)


def code_blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def command_lines(text: str, program: str) -> list[list[str]]:
    """The arguments of each line of `text` that calls `program`, without comments after two blanks."""
    lines = (
        re.split(r"\s{2,}|\s#", line.strip())[0] for line in re.sub(r"\s*\\\n\s*", " ", text).splitlines()
    )
    return [shlex.split(line)[1:] for line in lines if line.split(" ")[0] == program]


def page_id(page: Path) -> str:
    """A page's path as a test id."""
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    # Files that examples name.
    backbone = ROOT / "tests" / "data" / "backbone"
    shutil.copy(backbone / "tiny_tokenizer.json", "tokenizer.json")
    shutil.copy(backbone / "n15_two_views.safetensors", "n1.5-backbone.safetensors")
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.failed == 0


#: Packages with public names.
PUBLIC = (
    *("saccade", "saccade.checkpoints", "saccade.datasets", "saccade.diagnosis", "saccade.evaluation"),
    *("saccade.integrations", "saccade.linalg", "saccade.serve", "saccade.torch"),
)
#: Classes that a program makes or loads. The others are results, and errors.
MADE = ["ActionHead", "Backbone", "BackboneInputs", "Chunking", "Client", "CrossAttention", "Dataset"]
MADE += [
    "Intervention",
    "Normalizer",
    "PCA",
    "Policy",
    "Processor",
    "Ridge",
    "Server",
    "Standardizer",
    "Writer",
]


@pytest.mark.parametrize("package", PUBLIC)
def test_public_functions_and_what_programs_make_have_examples(package: str) -> None:
    module = importlib.import_module(package)
    finder = doctest.DocTestFinder()
    public = {name: getattr(module, name) for name in module.__all__}
    wanted = {name: one for name, one in public.items() if inspect.isfunction(one) or name in MADE}
    assert wanted
    without = [name for name, one in wanted.items() if not any(found.examples for found in finder.find(one))]
    assert without == []


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_rows_of_a_table_have_as_many_cells_as_its_head(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        bars = {line: len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}
        assert len(set(bars.values())) == 1, bars


@pytest.mark.parametrize("page", [page for page in PAGES if page.name not in NEED_MORE], ids=page_id)
def test_python_on_pages_runs(page: Path, tmp_path: Path) -> None:
    blocks = code_blocks(page, "python")
    if blocks:  # one program from top to bottom, as a reader would paste it
        code = "\n".join(blocks)
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr


def test_the_readme_needs_numpy_only(tmp_path: Path) -> None:
    modules = sorted(set().union(*SACCADE.modules.values(), *LAB.modules.values()))
    hidden = f"import sys; sys.modules.update(dict.fromkeys({modules}))\n"
    code = hidden + "\n".join(code_blocks(ROOT / "README.md", "python"))
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_commands_on_pages_exist(page: Path) -> None:
    makefile = (ROOT / "Makefile").read_text().replace("\\\n", "")
    targets = set(re.findall(r"^([\w-]+):(?!=)", makefile, re.MULTILINE))
    targets |= set(re.findall(r"^SESSIONS := (.*)", makefile, re.MULTILINE)[0].split())
    for block in code_blocks(page, "bash") + code_blocks(page, "sh"):  # those in bash also run, if they can
        for arguments in command_lines(block, "make"):
            assert {word for word in arguments if "=" not in word} <= targets  # variables aside
        for arguments in command_lines(block, "saccade"):
            assert_parses(arguments)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_examples_of_commands_parse(name: str) -> None:
    parser = cli.Parser(prog=f"saccade {name}")
    cli.load_command(name).add_arguments(parser)
    examples = command_lines(parser.epilog or "", "saccade")
    assert examples
    for arguments in examples:
        assert arguments[0] == name
        assert_parses(arguments)


def assert_parses(arguments: list[str]) -> None:
    """Fails if the command line does not accept these arguments."""
    parser = cli.build_parser(arguments[0])
    if "--help" not in arguments:
        parser.parse_args(arguments)  # a SystemExit fails the test; its message is on standard error


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)", page.read_text()) + re.findall(r'src="([^"]+)"', page.read_text())
    for target in targets:
        if "://" not in target:
            assert (page.parent / target).exists(), target


def tree_of_architecture() -> set[Path]:
    """The files and folders that the tree in ARCHITECTURE.md names; each belongs to the last folder above it
    that is indented less.
    """
    text = (ROOT / "ARCHITECTURE.md").read_text()
    block = text.split("```")[1]
    found: set[Path] = set()
    above: list[tuple[int, Path]] = []
    for line in filter(str.strip, block.splitlines()):
        indent = len(line) - len(line.lstrip())
        above = [(depth, folder) for depth, folder in above if depth < indent]
        base = above[-1][1] if above else Path()
        names = [base / name for name in re.split(r"\s{2,}", line.strip())[0].split()]
        found |= set(names)
        above.append((indent, names[0]))
    return found


def test_architecture_names_every_package_and_nothing_that_is_not_there() -> None:
    named = tree_of_architecture()
    assert [str(path) for path in sorted(named) if not (ROOT / path).exists()] == []
    packages = {
        Path(base) / folder.name
        for base in ("crates", "lab/saccade_lab", "python/saccade")
        for folder in (ROOT / base).iterdir()
        if folder.is_dir() and folder.name != "__pycache__"
    }
    assert [str(folder) for folder in sorted(packages - named)] == []


def test_pictures_are_made_from_what_commands_write(tmp_path: Path) -> None:
    shades = np.linspace(0, 255, 9).astype(np.uint8)
    frames = [np.full((64, 96, 3), shade, np.uint8) for shade in shades]
    imageio.mimwrite(tmp_path / "one.mp4", frames, fps=20, macro_block_size=16)  # type: ignore[arg-type]
    gif = ["gif", str(tmp_path / "one.mp4"), "--out", str(tmp_path / "one.gif"), "--width", "48"]
    for arguments in (gif, ["step", "--out", str(tmp_path / "step.png")]):
        subprocess.run(
            [sys.executable, "-m", "benches.pages.pictures", *arguments],
            cwd=ROOT,
            check=True,
            capture_output=True,
        )
    with Image.open(tmp_path / "one.gif") as made:
        assert made.size == (48, 32)
        assert len(list(ImageSequence.Iterator(made))) == 5  # every second of eight, and the last
        assert made.info["loop"] == 0
    with (
        Image.open(tmp_path / "step.png") as made,
        Image.open(ROOT / "docs" / "images" / "step.png") as shown,
    ):
        assert made.size == shown.size


def test_every_image_of_the_docs_is_shown() -> None:
    text = "".join(page.read_text() for page in PAGES)
    images = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".gif")]
    assert [path.name for path in images if path.name not in text] == []


def test_messages_that_the_page_of_errors_quotes_are_in_the_code() -> None:
    table = (ROOT / "docs" / "errors.md").read_text().partition("| the message contains |")[2]
    quoted = re.findall(r"^\| `(.*?)` \|", table, re.MULTILINE)
    assert len(quoted) == len(re.findall(r"^\| [^-]", table, re.MULTILINE)) > 10
    folders = ("python/saccade", "lab/saccade_lab", "crates")
    files = (
        path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".rs")
    )
    code = "\n".join(path.read_text() for path in files)
    assert [part for part in quoted if part not in code] == []


def test_every_page_that_names_a_published_checkpoint_says_that_none_was_run() -> None:
    caveat = "yet been run"
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    named = [page for page in pages if re.search(r"nvidia/|GR00T-N1", page.read_text())]
    assert [page_id(page) for page in named if caveat not in " ".join(page.read_text().split())] == []


def test_nothing_names_a_package_registry_or_a_path_of_one_machine() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    words = [
        "py" + "pi.org",
        "python" + "hosted.org",
        "index.cra" + "tes.io",
        "/ro" + "ot/",
        os.sep + "work" + os.sep,
    ]
    found = []
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if (
            path.suffix in (".safetensors", ".png", ".gif", ".mp4")
            or path.name == "Cargo.lock"
            or not path.is_file()
        ):
            continue
        text = path.read_text(errors="replace")
        found += [f"{name}: {word}" for word in words if word in text]
    assert found == []
