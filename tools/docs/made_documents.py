"""Shared by documents generated from the code: table cells, and checks that pages are up to date."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def cell(text: str | None) -> str:
    """``text`` as a Markdown table cell."""
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def write_or_check(page: Path, made: str, arguments: list[str]) -> int:
    """Writes the page; with ``--check`` reports an outdated page with exit code 1."""
    if "--check" not in arguments:
        page.write_text(made, encoding="utf-8")
        return 0
    holds = page.is_file() and page.read_text(encoding="utf-8") == made
    if not holds:
        print(f"{page.relative_to(ROOT)} is out of date; run: make architecture")
    return int(not holds)
