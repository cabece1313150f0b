"""Which objects annotators saw in a scan of ScanNet++: segments of the mesh (``segments.json``) put together to objects
(``segments_anno.json``), and the vertices that nobody is judged by (``mesh_aligned_0.05_mask.txt``).

Unlike ScanNet's, a segment may belong to several objects.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Int64Array
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.text_files import parsed_json, read_text

MESH_NAME = "mesh_aligned_0.05.ply"
MASK_NAME = "mesh_aligned_0.05_mask.txt"
SEGMENTS_NAME, OBJECTS_NAME = "segments.json", "segments_anno.json"
MAX_SEGMENT_ID = 2**32 - 1  # the toolkit keeps them in 32 bits
MAX_VERTEX = re.compile(r"[0-9]{1,10}")


@dataclass(frozen=True)
class AnnotatedObject:
    """One object: the word that the annotator typed, and the ids of its segments."""

    word: str
    segments: Int64Array


def read_segments(path: Path, where: str) -> Int64Array:
    """The segment id of every vertex, in the order of the mesh; ``where`` begins each message."""
    where = f"{where}: {path.name}"
    values = _read_table(path, where).get("segIndices")
    if not isinstance(values, list):
        raise DataError(f"{where}: has no list 'segIndices'; copy the file again")
    return _segment_ids(values, f"{where}: 'segIndices'")


def read_objects(path: Path, where: str) -> list[AnnotatedObject]:
    """The objects in the order of the file."""
    where = f"{where}: {path.name}"
    groups = _read_table(path, where).get("segGroups")
    if not isinstance(groups, list):
        raise DataError(f"{where}: has no list 'segGroups'; copy the file again")
    return [_read_object(group, f"{where}: group {row}") for row, group in enumerate(groups)]


def _read_object(group: Any, where: str) -> AnnotatedObject:
    if not isinstance(group, dict):
        raise DataError(f"{where} is no JSON object; copy the file again")
    word, segments = group.get("label"), group.get("segments")
    if not isinstance(word, str):
        raise DataError(f"{where}: 'label' is {ascii(word)[:40]}; expected a word")
    if not isinstance(segments, list):
        raise DataError(f"{where}: has no list 'segments'; copy the file again")
    return AnnotatedObject(word, _segment_ids(segments, f"{where}: 'segments'"))


def vertices_of_segments(segments: Int64Array) -> _Members:
    """A way from ids of segments to the vertices in them."""
    ids, row_of_vertex = np.unique(segments, return_inverse=True)
    rows = row_of_vertex.reshape(-1)
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(ids)))]).astype(np.int64)
    return _Members(ids, starts, np.argsort(rows, kind="stable"))


@dataclass(frozen=True)
class _Members:
    ids: Int64Array
    starts: Int64Array
    vertices: Int64Array

    def of(self, segments: Int64Array) -> Int64Array:
        """The vertices in any of ``segments``; those that no vertex has are passed over."""
        places = np.searchsorted(self.ids, segments)
        is_known = places < len(self.ids)
        is_known[is_known] = self.ids[places[is_known]] == segments[is_known]
        rows = np.unique(places[is_known])
        lengths = self.starts[rows + 1] - self.starts[rows]
        within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        members: Int64Array = self.vertices[np.repeat(self.starts[rows], lengths) + within]
        return members


def read_mask(path: Path, n_vertices: int, where: str) -> BoolArray:
    """Which of the vertices (V,) evaluations leave out: the file lists them by their numbers, and may be empty."""
    where = f"{where}: {path.name}"
    is_masked = np.zeros(n_vertices, np.bool_)
    words: Sequence[str] = read_text(path, where).split()
    wrong = next((word for word in words if not MAX_VERTEX.fullmatch(word) or int(word) >= n_vertices), None)
    if wrong is not None:
        raise DataError(f"{where}: {wrong[:20]!a} is no vertex of {MESH_NAME}, which has {n_vertices} (from 0)")
    is_masked[[int(word) for word in words]] = True
    return is_masked


def _read_table(path: Path, where: str) -> dict[str, Any]:
    content = parsed_json(read_bytes(path, where), where)
    if not isinstance(content, dict):
        raise DataError(f"{where}: is no JSON object; copy the file again")
    return content


def _segment_ids(values: list[Any], where: str) -> Int64Array:
    wrong = next((row for row, value in enumerate(values) if not _is_segment_id(value)), None)
    if wrong is not None:
        raise DataError(
            f"{where}[{wrong}] is {ascii(values[wrong])[:40]}; expected a segment id, 0 to {MAX_SEGMENT_ID}"
        )
    return np.array(values, np.int64)


def _is_segment_id(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_SEGMENT_ID
