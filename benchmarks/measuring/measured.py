"""Results of a measuring script as a JSON file, from which ``write_performance`` creates a table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path


def write_measured(
    path: Path, title: str, command: str, columns: Sequence[str], rows: Sequence[Sequence[str]], notes: Sequence[str]
) -> None:
    """Write one table: ``rows`` of text under ``columns``; ``command`` reproduces it; ``notes`` are sentences."""
    assert all(len(row) == len(columns) for row in rows), (columns, rows)
    content = {"title": title, "command": command, "columns": columns, "rows": rows, "notes": notes}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
