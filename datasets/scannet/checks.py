"""Everything that is wrong with the files of a scan, one line each, where a reader stops at the first fault.

Lost poses and missing truth are no faults. Images are left to who reads the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.datasets import openscan
from su3d_bench.datasets.recordings.registration import Grid, make_registration
from su3d_bench.datasets.recordings.source import RgbdSource
from su3d_bench.datasets.scannet.annotations import aggregation_name, read_objects, read_segments, segments_name
from su3d_bench.datasets.scannet.frames import classify_poses, faulty_pose, read_walk
from su3d_bench.datasets.scannet.labels import FIRST_TABLE_NAME, TABLE_NAME, read_label_table
from su3d_bench.datasets.scannet.truth import (
    labels_name,
    mesh_name,
    meta_name,
    read_annotated_scan,
    read_axis_alignment,
    truth_names,
)
from su3d_bench.formats.ply import read_ply

MOST_POSES = 20  # named one by one; the rest is counted


def recording_problems(open_source: Callable[[], RgbdSource], grid: Grid, where: str) -> Iterator[str]:
    """Faults of the recording's index, its cameras and its poses."""
    try:
        source = open_source()
        walk, is_faulty = classify_poses(source)
    except DataError as error:
        yield str(error)
        return
    numbers = walk.numbers[np.flatnonzero(is_faulty)]
    yield from (faulty_pose(where, int(number)) for number in numbers[:MOST_POSES])
    if len(numbers) > MOST_POSES:
        yield f"{where}: {len(numbers) - MOST_POSES} more poses are not rigid motions"
    if len(numbers) == 0:
        yield from _fault(read_walk, source)
    yield from _fault(make_registration, source.camera, grid, where)


def annotation_problems(files: Mapping[str, Path], scan: str, where: str) -> Iterator[str]:
    """Faults of the files that there are (by their names), each alone and, where all of the truth is, together."""
    readers: dict[str, Callable[[Path], object]] = {
        TABLE_NAME: lambda path: read_label_table(path, where),
        FIRST_TABLE_NAME: lambda path: read_label_table(path, where),
        openscan.RAW_NAME: openscan.read_attributes,
        meta_name(scan): lambda path: read_axis_alignment(path, where),
        segments_name(scan): lambda path: read_segments(path, scan, where),
        aggregation_name(scan): lambda path: read_objects(path, scan, where),
        mesh_name(scan): lambda path: read_ply(path, f"{where}: {path.name}"),
        labels_name(scan): lambda path: read_ply(path, f"{where}: {path.name}"),
    }
    faults = [line for name, read in readers.items() if name in files for line in _fault(read, files[name])]
    yield from faults
    if set(truth_names(scan)) <= set(files):
        yield from (line for line in _fault(read_annotated_scan, files, scan, where) if line not in faults)


def _fault(read: Callable[..., object], *arguments: object) -> list[str]:
    """The line that ``read`` fails with; none where it does not."""
    try:
        read(*arguments)
    except DataError as error:
        return [str(error)]
    return []
