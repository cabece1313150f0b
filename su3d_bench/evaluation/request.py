"""What an evaluation is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Confidences = Literal["protocol", "file"]
ValuesForm = Literal["classes", "instances", "numbers"]


@dataclass(frozen=True)
class Request:
    """What to score: ``predictions`` are folders or files; everything else may be left out.

    ``ground_truth``: a folder of <scene>.txt in ScanNet's layout, in place of the dataset's own. ``truth_values``: what
    their values are, where that is not plain from them. ``protocols``: all that fit where none is named. ``scenes``:
    names or patterns. ``confidences``: where a protocol has 1 for every mask, its own rule, or what the files say;
    None: what the files say in the official script's format, which that script reads as it stands, and the protocol's
    rule in all others. ``queries``: a file of texts and the objects that they speak of, for ``query-ap``.
    """

    predictions: tuple[Path, ...]
    dataset: str | None = None
    ground_truth: Path | None = None
    truth_values: ValuesForm | None = None
    protocols: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    format: str | None = None
    text_features: Path | None = None
    confidences: Confidences | None = None
    queries: Path | None = None


def own_name(out: Path | None) -> str:
    """What predictions are called that nobody named: as the folder of their run, where they become one."""
    return "predictions" if out is None else out.resolve().name
