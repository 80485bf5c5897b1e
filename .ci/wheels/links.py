"""Links of a README that lead somewhere on the page of a package index, too."""

from __future__ import annotations

import posixpath
import re

#: A relative target of a link or picture of Markdown: what is before it, the target with its anchor, the end.
LINK = re.compile(r"(!?)(\[[^\]]*\]\()(?![a-z]+:|#)([^)\s]+)(\))")
#: Fences are copied as they are.
FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def absolute(text: str, folder: str, address: str, tag: str) -> str:
    """A page whose relative links lead to the repository.

    Args:
        text: The page, in Markdown.
        folder: Its folder in the repository, `""` for the root.
        address: Of the repository on GitHub.
        tag: The tag or commit that they lead to.
    """

    def moved(found: re.Match[str]) -> str:
        picture, before, target, after = found.groups()
        path, hash_, anchor = target.partition("#")
        there = posixpath.normpath(posixpath.join(folder, path))
        return (
            f"{picture}{before}{address}/{'raw' if picture else 'blob'}/{tag}/{there}{hash_}{anchor}{after}"
        )

    parts = FENCE.split(text)
    return "".join(part if part.startswith("```") else LINK.sub(moved, part) for part in parts)
