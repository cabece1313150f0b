"""The page of runs, made once and open in a browser, for the files that test it there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium
from looks import WHOLE, complaints
from made_pages import browser_for_pages, page_of_runs


@pytest.fixture(scope="session")
def runs_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return page_of_runs(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def opened_runs(runs_page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with browser_for_pages(tmp_path_factory.mktemp("profile")) as found:
        found.open(runs_page)
        found.until(WHOLE)
        yield found


@pytest.fixture
def browser(opened_runs: Chromium) -> Iterator[Chromium]:
    """The page as the tests before left it, which complains of nothing."""
    yield opened_runs
    assert complaints(opened_runs) == []
