"""What is known only when the project is published: its address, and that an index has its packages.

    python .ci/published.py --check                          fails before it is known, and says what to do
    python .ci/published.py https://github.com/OWNER/NAME    writes it everywhere

Until then files hold an address that cannot exist, pages install from a clone, and a release is refused. The
pages already hold the sentences that follow, in comments. Needs Python 3.10 and nothing else.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Where the address of the repository is held.
HELD = ("Cargo.toml", r'(?m)^repository = "([^"]+)"$')
#: The address of the repository, and that of the site, before anybody knows them: `.invalid` is nobody's.
UNKNOWN = "https://saccade.invalid/repository"
UNKNOWN_SITE = "https://saccade.invalid/site"
GITHUB = re.compile(r"https://github\.com/([\w-]+)/([\w.-]+)")
#: Files with the address.
ADDRESSED = (
    *("Cargo.toml", "pyproject.toml", "lab/pyproject.toml", "plugins/lerobot/pyproject.toml"),
    *("CITATION.cff", "README.md", "CONTRIBUTING.md", ".github/ISSUE_TEMPLATE/config.yml"),
)
#: Where pages lie that change when saccade is published, and those in the root.
FOLDERS = ("docs", "lab", "plugins")
PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
#: A passage, and in a comment what takes its place.
PASSAGE = re.compile(
    r"<!-- until it is published -->\n(.*?)<!-- once it is published:\n(.*?)-->\n", re.DOTALL
)
MARK = re.compile(r"<!-- (until|once) it is published")
#: What pip installs from a clone, and what it is called on the index.
INSTALLED = (
    (r'"\.\[', '"saccade-vla['),
    (r'"\./lab\[', '"saccade-vla-lab['),
    (r"(?<![\w./])\./lab(?![\w/])", "saccade-vla-lab"),
    (r"(?<![\w./])\./plugins/lerobot(?![\w/])", "lerobot-policy-saccade"),
    (r"(?<=pip install )\.(?![\w./])", "saccade-vla"),
)


def held(root: Path) -> str:
    """The address of the repository, as the tree in `root` has it."""
    file, pattern = HELD
    (found,) = re.findall(pattern, (root / file).read_text(encoding="utf-8"))
    return str(found)


def site_of(address: str) -> str:
    """The address of the site: where GitHub's Pages are for a repository.

    Args:
        address: Of the repository; `UNKNOWN` or one that `GITHUB` matches.
    """
    found = GITHUB.fullmatch(address)
    return f"https://{found[1].lower()}.github.io/{found[2]}" if found else UNKNOWN_SITE


def pages(root: Path) -> list[Path]:
    """The pages that change when saccade is published."""
    found = (path for folder in FOLDERS for path in sorted((root / folder).rglob("*.md")))
    return [*(root / name for name in PAGES), *found]


def installed_from_index(text: str) -> str:
    """A page on which pip takes saccade's packages from the index."""
    lines = PASSAGE.sub(r"\2", text).splitlines(keepends=True)
    for place, line in enumerate(lines):
        if "pip install" in line:
            for pattern, name in INSTALLED:
                line = re.sub(pattern, name, line)
            lines[place] = line
    return "".join(lines)


def write(root: Path, address: str) -> None:
    """Writes the address everywhere, and the pages as they are to be from then on."""
    old = held(root)
    for name in ADDRESSED:
        path = root / name
        text = path.read_text(encoding="utf-8").replace(old, address)
        path.write_text(text.replace(site_of(old), site_of(address)), encoding="utf-8", newline="\n")
    for path in pages(root):
        text = path.read_text(encoding="utf-8")
        if (new := installed_from_index(text)) != text:
            path.write_text(new, encoding="utf-8", newline="\n")


def problems(root: Path) -> list[str]:
    """What a release would still say that is not true, as lines for a reader."""
    address = held(root)
    found = []
    if address == UNKNOWN:
        found.append(
            f"{HELD[0]}: the address is not known: python .ci/published.py https://github.com/OWNER/NAME"
        )
    for name in ADDRESSED:
        text = (root / name).read_text(encoding="utf-8")
        if address not in text:
            found.append(f"{name}: expected the address {address}")
        if address != UNKNOWN and re.search(r"saccade\.invalid", text):
            found.append(f"{name}: holds an address that does not exist")
    if address == UNKNOWN:
        return found
    for path in pages(root):
        text = path.read_text(encoding="utf-8")
        if MARK.search(text) or installed_from_index(text) != text:
            found.append(f"{path.relative_to(root).as_posix()}: says what was true before it was published")
    return found


def main() -> int:
    """Checks or writes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("address", nargs="?", help="of the repository, to write")
    parser.add_argument("--check", action="store_true", help="fail if it is not known, or not everywhere")
    args = parser.parse_args()
    if args.check == (args.address is not None):
        parser.error("expected an address or --check")
    if args.check:
        found = problems(ROOT)
        for line in found:
            print(f"published: {line}", file=sys.stderr)
        return 1 if found else 0
    if not GITHUB.fullmatch(args.address) or args.address.endswith(".git"):
        parser.error(f"expected an address such as https://github.com/OWNER/NAME, got {args.address!r}")
    write(ROOT, args.address)
    print(f"{args.address}, {site_of(args.address)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
