"""Which pages the site has, and where: copies of those of the repository, with links within the site."""

from __future__ import annotations

import posixpath
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

SITE = Path(__file__).resolve().parent
ROOT = SITE.parents[1]
#: The pages of the repository that are chapters, besides `docs`.
PAGES = (
    *("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md", "CHANGELOG.md"),
    *("lab/README.md", "plugins/lerobot/README.md"),
)
FOLDERS = ("docs", "studies")
#: A link or a picture of Markdown or HTML: what comes before the target, the target, its anchor, the end.
LINK = re.compile(r'(\]\(|src=")(?!https?:|mailto:|#)([^)\s"#]+)(#[^)\s"]*)?(\)|")')
LANGUAGES = {".rs": "rust", ".py": "python", ".toml": "toml", ".json": "json", ".yml": "yaml", ".cff": "yaml"}
#: Fences are copied as they are.
FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def tracked() -> list[str]:
    """The files of the repository, relative to its root."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def chapters(files: list[str]) -> list[str]:
    """The pages of the repository that are on the site."""
    below = tuple(f"{folder}/" for folder in FOLDERS)
    return [
        *PAGES,
        *(name for name in files if name.endswith(".md") and name.startswith(below) and "/site/" not in name),
    ]


def retarget(text: str, page: str, place: Callable[[str], str]) -> str:
    """Replaces targets of links outside of fences.

    Args:
        text: The page.
        page: Its path in the repository.
        place: Gives for a path in the repository the path on the site.
    """
    folder = posixpath.dirname(page)
    own = posixpath.dirname(place(page))

    def moved(found: re.Match[str]) -> str:
        before, target, anchor, after = found.groups()
        there = place(posixpath.normpath(posixpath.join(folder, target)))
        return f"{before}{posixpath.relpath(there, own or '.')}{anchor or ''}{after}"

    parts = FENCE.split(text)
    return "".join(part if part.startswith("```") else LINK.sub(moved, part) for part in parts)


def stage(pages: Path) -> None:
    """Writes everything that Sphinx reads below `pages`, which is created anew."""
    shutil.rmtree(pages, ignore_errors=True)
    files = tracked()
    shown = set(chapters(files))
    linked: set[str] = set()

    def place(path: str) -> str:
        """Where a file of the repository is on the site."""
        if path == "README.md":
            return "index.md"
        if path in shown or Path(path).suffix in (".png", ".gif"):
            return path
        if (ROOT / path).is_dir():
            return place(f"{path}/README.md")
        if path not in files:
            raise SystemExit(f"docs: {path} is linked, and is no tracked file")
        linked.add(path)
        return f"source/{path}.md"

    for page in sorted(shown):
        text = retarget((ROOT / page).read_text(encoding="utf-8"), page, place)
        if page == "README.md":
            text += "\n" + (SITE / "contents.md").read_text(encoding="utf-8")
        write(pages / place(page), text)
    for name in files:
        if Path(name).suffix in (".png", ".gif") and name.startswith(tuple(f"{top}/" for top in FOLDERS)):
            target = pages / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, target)
    for name in sorted(linked):
        write(pages / f"source/{name}.md", source_page(name))


def source_page(name: str) -> str:
    """A page that shows a file, and that the search leaves out."""
    text = (ROOT / name).read_text(encoding="utf-8")
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    language = LANGUAGES.get(Path(name).suffix, "text")
    return (
        f"---\norphan: true\nnosearch: true\n---\n# {name}\n\n{fence}{language}\n{text.rstrip()}\n{fence}\n"
    )


def write(path: Path, text: str) -> None:
    """Writes a page and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
