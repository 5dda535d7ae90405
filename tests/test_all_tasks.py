"""The table of all tasks on the page of results."""

from __future__ import annotations

from studies.all_tasks import table
from tests.configs import ROOT


def test_page_of_results_has_the_table_of_the_committed_files():
    page = (ROOT / "docs" / "results" / "README.md").read_text(encoding="utf-8")
    assert "\n".join(table()) in page
