"""What the library says while one scene runs under one method."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any


class SceneLog(logging.Handler):
    """Keeps what the library says while a scene runs: all ``lines`` for its log, ``warnings`` for the record too."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.warnings: list[str] = []

    def text(self, *last: str) -> str:
        return "\n".join([*self.lines, *last]) + "\n"

    def remarks(self) -> dict[str, list[str]]:
        """What a seal keeps of it, for a run that goes on from there."""
        return {"log": self.lines, "warnings": list(dict.fromkeys(self.warnings))}

    def recall(self, remarks: Mapping[str, Any]) -> None:
        """Begin with what an earlier process said."""
        self.lines[:0] = remarks.get("log", [])
        self.warnings[:0] = remarks.get("warnings", [])

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname.lower()}: {record.getMessage()}")
        if record.levelno >= logging.WARNING:
            self.warnings.append(record.getMessage())
