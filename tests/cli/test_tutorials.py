"""The tutorials have the form that .ci/tutorials.py types, and it notices what is not printed any more."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

PROGRAM = runpy.run_path(str(ROOT / ".ci" / "tutorials.py"))
PAGES: dict[str, Path] = PROGRAM["PAGES"]


def steps(name: str) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = PROGRAM["steps_of"](PAGES[name].read_text(encoding="utf-8"))
    return found


def not_printed(shown: str, printed: str) -> Any:
    return PROGRAM["not_printed"](shown, printed)


@pytest.mark.parametrize("name", PAGES)
def test_a_tutorial_has_no_block_that_is_shown_and_compared_with_nothing(name: str) -> None:
    text = PAGES[name].read_text(encoding="utf-8")
    assert text.count("```text\n") == sum(bool(shown) for _, shown in steps(name))


@pytest.mark.parametrize("name", PAGES)
def test_what_a_tutorial_shows_passes_under_other_numbers_and_not_under_other_words(name: str) -> None:
    for _, shown in steps(name):
        assert not_printed(shown, shown.replace("5", "6").replace("1", "2")) == []
        telling = [line for line in shown.splitlines() if any(letter.isalpha() for letter in line)]
        assert len(not_printed(shown, "something else\n")) >= len(telling)


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("| mine | 54.8 |", "| mine | - |"),
        ("| method | AP |", "| method | AP | AP50 |"),
        ("paper.tex: 8 cells", "other.tex: 8 cells"),
        ("3 scenes", "3 rooms"),
    ],
)
def test_a_line_with_another_word_or_column_was_not_printed(shown: str, printed: str) -> None:
    assert not_printed(shown, printed) == [shown]
