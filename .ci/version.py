"""The version of everything that is released, which Cargo.toml holds and other files repeat.

    python .ci/version.py              prints it
    python .ci/version.py --check      fails if a file says another one
    python .ci/version.py --tag v0.2.0 the same, and the tag and the top of CHANGELOG.md must be of it
    python .ci/version.py 0.2.0        writes it everywhere, and today as its day in CITATION.cff and
                                       CHANGELOG.md; then `cargo check` writes the Cargo.lock files

A version has three numbers, because Cargo and Python spell pre-releases differently. Package formats want a
literal version in each file, so it cannot be read from one at build. Needs Python 3.10 and nothing else.
"""

from __future__ import annotations

import argparse
import datetime
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Where the version is held: `[workspace.package]`, which the crates and the wheel of saccade-vla read.
HELD = ("Cargo.toml", r'(?m)^(version = ")([^"]+)(")$')
#: A file and what surrounds a version in it. Each pattern matches at least once, always a version.
REPEATED = (
    ("Cargo.toml", r'(?m)^(saccade-[\w-]+ = \{ path = "[^"]+", version = ")([^"]+)(" \})$'),
    ("lab/pyproject.toml", r'(?m)^(version = ")([^"]+)(")'),
    ("lab/pyproject.toml", r'("saccade-vla\[cli\]==)([^"]+)(")'),
    ("plugins/lerobot/pyproject.toml", r'(?m)^(version = ")([^"]+)(")'),
    ("plugins/lerobot/pyproject.toml", r'("saccade-vla==)([^"]+)(")'),
    ("CITATION.cff", r"(?m)^(version: )(\S+)()$"),
)
VERSION = re.compile(r"\d+\.\d+\.\d+")
#: The file with the day of the release, and its line. Before the first release there is none.
CITATION = "CITATION.cff"
DAY = re.compile(r"(?m)^date-released: (\d{4}-\d{2}-\d{2})\n")


def held(root: Path) -> str:
    """The version of the tree in `root`."""
    file, pattern = HELD
    (found,) = re.findall(pattern, (root / file).read_text(encoding="utf-8"))
    return str(found[1])


def problems(root: Path) -> list[str]:
    """The places that do not repeat the version, as lines for a reader."""
    version, found = held(root), []
    for file, pattern in REPEATED:
        places = re.findall(pattern, (root / file).read_text(encoding="utf-8"))
        if not places:
            found.append(f"{file}: expected a version, where {pattern} finds it")
        found += [f"{file}: {place[1]}, expected {version}" for place in places if place[1] != version]
    return found


def problems_of_tag(root: Path, tag: str) -> list[str]:
    """What keeps `tag` from being the tag of this tree's release."""
    version = held(root)
    text = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    (first, *_) = re.findall(r"(?m)^## (.+)$", text)
    found = [] if tag == f"v{version}" else [f"tag {tag}, expected v{version}"]
    if not re.fullmatch(rf"{re.escape(version)} - \d{{4}}-\d{{2}}-\d{{2}}", first):
        found.append(f"CHANGELOG.md begins with {first}, expected {version} and its day")
    if not DAY.search((root / CITATION).read_text(encoding="utf-8")):
        found.append(f"{CITATION} has no date-released: python .ci/version.py {version} writes it")
    return found


def write(root: Path, version: str, day: datetime.date) -> None:
    """Writes a version and the day of its release into every file of `root` that has it."""
    for file, pattern in (HELD, *REPEATED):
        path = root / file
        text = re.sub(pattern, rf"\g<1>{version}\g<3>", path.read_text(encoding="utf-8"))
        path.write_text(text, encoding="utf-8", newline="\n")
    path = root / CITATION
    text = DAY.sub("", path.read_text(encoding="utf-8"))
    dated = f"version: {version}\ndate-released: {day.isoformat()}\n"
    path.write_text(text.replace(f"version: {version}\n", dated), encoding="utf-8", newline="\n")
    path = root / "CHANGELOG.md"
    heading = rf"(?m)^## {re.escape(version)}( - \S+)?$"
    text = re.sub(heading, f"## {version} - {day.isoformat()}", path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8", newline="\n")


def main() -> int:
    """Prints, checks or writes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("version", nargs="?", help="the version to write")
    parser.add_argument("--check", action="store_true", help="fail if a file says another version")
    parser.add_argument("--tag", help="fail also if this tag, or the changelog, is of another version")
    args = parser.parse_args()
    if args.version is not None:
        if args.check or args.tag:
            parser.error("--check and --tag write nothing: give them without a version")
        if not VERSION.fullmatch(args.version):
            parser.error(f"expected a version such as 0.2.0, got {args.version!r}")
        write(ROOT, args.version, datetime.date.today())
    elif args.check or args.tag:
        found = problems(ROOT) + (problems_of_tag(ROOT, args.tag) if args.tag else [])
        for line in found:
            print(f"version: {line}", file=sys.stderr)
        if found:
            return 1
    print(held(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
