"""docs/robots.md says what the code does: its tables are those that benches.pages.robots writes."""

from __future__ import annotations

from benches.pages import robots


def test_the_tables_of_the_page_are_up_to_date() -> None:
    assert robots.page() == robots.PAGE.read_text(encoding="utf-8"), "run: python -m benches.pages.robots"
