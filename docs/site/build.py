"""Builds the documentation site: `make docs`.

    python docs/site/build.py [--out out/site]

The pages of the repository are copied to `OUT/pages` with their relative paths, so that the same links work
on the site and in the repository. The README is the front page. Added are the API reference, the help of
each command, and each file that a page links to. Sphinx makes `OUT/html` of it. A warning is an error, and so
is a local link that leads nowhere.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import api_pages
import check_site
import command_pages
import staging
from sphinx.cmd.build import build_main

SITE = Path(__file__).resolve().parent
ROOT = SITE.parents[1]


def main() -> int:
    """Builds and checks; the exit status is 1 if anything is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "site", help="folder (default: out/site)")
    out = parser.parse_args().out.resolve()
    pages, html = out / "pages", out / "html"
    staging.stage(pages)
    names = api_pages.write_all(pages / "api")
    command_pages.write_all(pages / "commands")
    shutil.rmtree(html, ignore_errors=True)
    options = [
        "--fail-on-warning",
        "--keep-going",
        "--quiet",
        "--fresh-env",
        "--conf-dir",
        str(SITE),
    ]
    if build_main([*options, "--doctree-dir", str(out / "doctrees"), str(pages), str(html)]):
        return 1
    problems = check_site.problems(html) + check_site.missing(html / "api", names)
    for line in problems:
        print(f"docs: {line}", file=sys.stderr)
    print(f"docs: {html / 'index.html'}: {len(list(html.rglob('*.html')))} pages, {len(problems)} problems")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
