"""``scores.json``, from which tables are made again."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import cache
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from su3d_bench.core.errors import DataError, printable
from su3d_bench.sheets.scores import METRICS, SCHEMA, ScoreCell, Scores
from su3d_bench.store.atomic import write_json

FILE = "scores.json"
MOST_BYTES = 64 << 20


def write_scores(folder: Path, scores: Scores) -> Path:
    """Write ``scores.json`` into ``folder``; its path."""
    write_json(folder / FILE, asdict(scores))
    return folder / FILE


def read_scores(path: Path) -> Scores:
    """The scores of a file or of the folder that holds it; ``DataError`` where it is not as ``sheets score`` writes."""
    file = path / FILE if path.is_dir() else path
    where = printable(str(file), 200)
    try:
        if file.stat().st_size > MOST_BYTES:
            raise DataError(f"{where}: has more than {MOST_BYTES >> 20} MiB; no file of scores does")
        content = file.read_bytes()
    except OSError as error:
        raise DataError(f"{where}: cannot be read: {error.strerror}") from error
    try:
        found = _reader().validate_json(content, strict=True)
    except ValidationError as error:
        place = printable(".".join(map(str, error.errors()[0]["loc"])), 120) or "it"
        raise DataError(f"{where}: {place} is not as su3d-bench sheets score writes it; score again") from error
    if found.schema_version != SCHEMA:
        raise DataError(f"{where}: has schema {found.schema_version}, this version reads {SCHEMA}; score again")
    if not all(_is_sound(cell) for cell in found.cells):
        raise DataError(f"{where}: holds a number that is no share or a metric that is none; score again")
    return found


@cache
def _reader() -> TypeAdapter[Scores]:
    return TypeAdapter(Scores)


def _is_sound(cell: ScoreCell) -> bool:
    values = [*(() if cell.value is None else (cell.value,)), *(cell.interval or ()), *cell.per_scene.values()]
    return cell.metric in METRICS and all(math.isfinite(one) and 0.0 <= one <= 1.0 for one in values)
