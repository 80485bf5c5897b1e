"""docs/robots.md says what the code does: its tables are those that docs/make_robots.py writes."""

from __future__ import annotations

import runpy

from tests.helpers import released


def test_the_tables_of_the_page_are_up_to_date() -> None:
    script = runpy.run_path(str(released.DATA.parents[1] / "docs" / "make_robots.py"))
    assert script["page"]() == script["PAGE"].read_text(encoding="utf-8"), "run: python docs/make_robots.py"
