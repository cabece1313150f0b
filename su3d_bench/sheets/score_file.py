"""``scores.json``, from which tables are made again."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

from su3d_bench.core.errors import DataError, printable
from su3d_bench.sheets.items import read_record
from su3d_bench.sheets.scores import METRICS, SCHEMA, ScoreCell, Scores
from su3d_bench.store.atomic import write_json

FILE = "scores.json"


def write_scores(folder: Path, scores: Scores) -> Path:
    """Write ``scores.json`` into ``folder``; its path."""
    write_json(folder / FILE, asdict(scores))
    return folder / FILE


def read_scores(path: Path) -> Scores:
    """The scores of a file or of the folder that holds it; ``DataError`` where it is not as ``sheets score`` writes."""
    file = path / FILE if path.is_dir() else path
    found = read_record(file, Scores, SCHEMA, "sheets score", "score again")
    if not all(_is_sound(cell) for cell in found.cells):
        raise DataError(
            f"{printable(str(file), 200)}: holds a number that is no share or a metric that is none; score again"
        )
    return found


def _is_sound(cell: ScoreCell) -> bool:
    values = [*(() if cell.value is None else (cell.value,)), *(cell.interval or ()), *cell.per_scene.values()]
    return cell.metric in METRICS and all(math.isfinite(one) and 0.0 <= one <= 1.0 for one in values)
