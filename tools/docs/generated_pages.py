"""What documents that are made from the code share: how a cell is written, and whether what stands still holds."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def cell(text: str | None) -> str:
    """``text`` as a cell of a table in Markdown."""
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def write_or_check(page: Path, made: str, arguments: list[str]) -> int:
    """Writes the page; with ``--check`` says where it does not hold any more, which is exit code 1."""
    if "--check" not in arguments:
        page.write_text(made, encoding="utf-8")
        return 0
    holds = page.is_file() and page.read_text(encoding="utf-8") == made
    if not holds:
        print(f"{page.relative_to(ROOT)} is not what the code says any more; run: make architecture")
    return int(not holds)
