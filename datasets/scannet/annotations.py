"""Which objects annotators saw in a scan: segments of the mesh (``.segs.json``) put together to objects
(``.aggregation.json``).

Ids are numbers or numbers written as text, as ScanNet's own reader takes them. A segment that several objects claim
belongs to the last of them; one that none claims is not annotated.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Int64Array
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.text_files import parsed_json

PREFIX = "scannet."  # before scene ids and file names of the second release, not of the first
MAX_SEGMENT_ID = 2**32 - 1
# Ground truth is label * 1000 + instance, and instances are ids + 1: a larger id would spill into the next label.
MAX_OBJECT_ID = 998


@dataclass(frozen=True)
class AnnotatedObject:
    """One object: its number in the scan, the raw category, and the ids of its segments."""

    id: int
    category: str
    segments: Int64Array


def segments_name(scan: str) -> str:
    return f"{scan}_vh_clean_2.0.010000.segs.json"


def aggregation_name(scan: str) -> str:
    return f"{scan}.aggregation.json"


def read_segments(path: Path, scan: str, where: str) -> Int64Array:
    """The segment id of every vertex, in the order of the mesh; ``where`` begins each message."""
    where = f"{where}: {path.name}"
    content = _read_table(path, scan, where)
    values = content.get("segIndices")
    if not isinstance(values, list):
        raise DataError(f"{where}: has no list 'segIndices'; copy the file again")
    return _segment_ids(values, f"{where}: 'segIndices'")


def read_objects(path: Path, scan: str, where: str) -> list[AnnotatedObject]:
    """The objects in the order of the file, which must refer to the segments of the decimated mesh."""
    where = f"{where}: {path.name}"
    content = _read_table(path, scan, where)
    segments_file = content.get("segmentsFile")
    if not isinstance(segments_file, str) or segments_file.removeprefix(PREFIX) != segments_name(scan):
        raise DataError(
            f"{where}: 'segmentsFile' is {_clip(segments_file)}, but {segments_name(scan)} is read; take the "
            "aggregation that belongs to it"
        )
    groups = content.get("segGroups")
    if not isinstance(groups, list):
        raise DataError(f"{where}: has no list 'segGroups'; copy the file again")
    objects = [_read_object(group, f"{where}: group {row}") for row, group in enumerate(groups)]
    category_of: dict[int, str] = {}
    for entry in objects:
        if category_of.setdefault(entry.id, entry.category) != entry.category:
            raise DataError(
                f"{where}: object {entry.id} stands there twice, as {_clip(category_of[entry.id])} and as "
                f"{_clip(entry.category)}"
            )
    return objects


def object_of_vertex(segments: Int64Array, objects: Sequence[AnnotatedObject]) -> Int64Array:
    """Row in ``objects`` of each vertex; -1 where its segment is in none."""
    ids, segment_rows = np.unique(segments, return_inverse=True)
    owner = np.full(len(ids), -1, np.int64)
    for row, entry in enumerate(objects):
        owner[np.isin(ids, entry.segments)] = row
    return owner[segment_rows.reshape(-1)] if len(ids) else np.zeros(0, np.int64)


def _read_table(path: Path, scan: str, where: str) -> dict[str, Any]:
    """The JSON object in a file that says of itself that it belongs to ``scan``."""
    content = parsed_json(read_bytes(path, where), where)
    if not isinstance(content, dict):
        raise DataError(f"{where}: is no JSON object; copy the file again")
    scene = content.get("sceneId")
    # Segmentator names the scene after the mesh file when a user runs it.
    belongs = isinstance(scene, str) and scene.removeprefix(PREFIX) in (scan, f"{scan}_vh_clean_2")
    if not belongs:
        raise DataError(f"{where}: 'sceneId' is {_clip(scene)}, not '{scan}'; this file belongs to another scan")
    return content


def _read_object(group: Any, where: str) -> AnnotatedObject:
    if not isinstance(group, dict):
        raise DataError(f"{where} is no JSON object; copy the file again")
    number = _whole_number(group.get("id"))
    if number is None or number > MAX_OBJECT_ID:
        raise DataError(
            f"{where}: 'id' is {_clip(group.get('id'))}; expected 0 to {MAX_OBJECT_ID}, since ground truth is "
            "label * 1000 + id + 1"
        )
    category, segments = group.get("label"), group.get("segments")
    if not isinstance(category, str):
        raise DataError(f"{where}: 'label' is {_clip(category)}; expected a category")
    if not isinstance(segments, list):
        raise DataError(f"{where}: has no list 'segments'; copy the file again")
    return AnnotatedObject(number, category.strip(), _segment_ids(segments, f"{where}: 'segments'"))


def _segment_ids(values: list[Any], where: str) -> Int64Array:
    numbers = [_whole_number(value) for value in values]
    wrong = next((row for row, number in enumerate(numbers) if number is None or number > MAX_SEGMENT_ID), None)
    if wrong is not None:
        raise DataError(f"{where}[{wrong}] is {_clip(values[wrong])}; expected a segment id, 0 to {MAX_SEGMENT_ID}")
    return np.array(numbers, np.int64)


def _whole_number(value: Any) -> int | None:
    """The value of a number or of one written as text; None where it is neither or below 0."""
    if isinstance(value, str):
        return int(value) if re.fullmatch(r"[0-9]{1,18}", value) else None
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None


def _clip(value: Any) -> str:
    """The value as it may stand in a message."""
    return ascii(value[:40] if isinstance(value, str) else str(value)[:40] if not isinstance(value, int) else value)[
        :80
    ]
