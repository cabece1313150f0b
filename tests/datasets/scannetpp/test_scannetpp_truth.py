"""ScanNet++'s ground truth compared with results of the official toolkit, and faults in the files of a scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES
from recording_files import grid
from scannetpp_scene import NAMES, write_lists, write_scans

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import GroundTruth
from su3d_bench.datasets.scannetpp import truth as truth_files

CASE = json.loads((CASES / "scannetpp_truth.json").read_text())
NO_LABEL = -100


def truth_of(folder: Path, lists: Path) -> GroundTruth:
    files = {name: folder / name for name in truth_files.TRUTH_NAMES}
    return truth_files.vertex_truth(
        truth_files.read_annotated_scan(files, truth_files.read_benchmark_classes(lists, "here"), "here")
    )


def written(root: Path, segments: Any, groups: Any, masked: Any = (), mesh: Any = None) -> GroundTruth:
    write_lists(root)
    write_scans(root / "scans", segments, groups, masked, mesh)
    return truth_of(root / "scans", root / "metadata/semantic_benchmark")


def row_of_points(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(3 * n, dtype=np.float32).reshape(n, 3), np.array([[0, 1, 2]], np.int32)


@pytest.mark.parametrize("problem", CASE["problems"])
def test_ground_truth_matches_the_official_toolkit(tmp_path: Path, problem: dict[str, Any]) -> None:
    for name, text in (
        ("top100.txt", "\n".join(problem["names"])),
        ("top100_instance.txt", "\n".join(problem["inst"])),
        ("map_benchmark.csv", problem["csv"]),
    ):
        (tmp_path / name).write_text(text)
    mesh = row_of_points(len(problem["segs"]))
    write_scans(tmp_path / "scans", problem["segs"], problem["groups"], problem["mask"], mesh)
    truth = truth_of(tmp_path / "scans", tmp_path)
    assert truth.every_semantic is not None
    official = {name: np.array(answer) for name, answer in problem["answer"].items()}
    is_kept = np.ones(len(problem["segs"]), bool)
    is_kept[problem["mask"]] = False
    for ours, theirs in ((truth.semantic, official["single"]), (truth.every_semantic, official["multi"])):
        np.testing.assert_array_equal(ours[is_kept], np.where(theirs == NO_LABEL, 0, theirs + 1)[is_kept])
    instance = official["single_instance"]  # prepare_semantic_gt.py: 0 and below are none
    np.testing.assert_array_equal(truth.instance[is_kept], np.where(instance <= 0, 0, instance + 1)[is_kept])
    assert (truth.semantic[~is_kept] == -1).all() and not truth.instance[~is_kept].any()


def test_vertex_keeps_three_classes_and_the_smallest_object_counts(tmp_path: Path) -> None:
    groups = [("floor", (1, 2, 3)), ("couch", (1, 2)), ("chair", (1,)), ("rug", (1, 3))]
    truth = written(tmp_path, [1, 2, 2, 3, 9], groups, masked=[2], mesh=row_of_points(5))
    floor, chair, sofa, mat = (NAMES.index(name) + 1 for name in ("floor", "chair", "sofa", "mat"))
    assert truth.every_semantic is not None
    # The rug is dropped on the first vertex, and so covers one less.
    assert truth.every_semantic.tolist() == [[floor, sofa, chair], [floor, sofa, 0], [0] * 3, [floor, mat, 0], [0] * 3]
    assert truth.semantic.tolist() == [chair, sofa, -1, mat, 0]
    assert truth.instance.tolist() == [3, 2, 0, 4, 0]


def test_object_surface_has_the_majority_of_corners(tmp_path: Path) -> None:
    points, triangles = grid(3, 2)
    write_lists(tmp_path)
    write_scans(tmp_path, [1, 1, 2, 1, 1, 2], [("floor", (1,)), ("couch", (2,))], mesh=(points, triangles))
    classes = truth_files.read_benchmark_classes(tmp_path / "metadata/semantic_benchmark", "here")
    mesh = truth_files.instance_mesh(
        truth_files.read_annotated_scan({name: tmp_path / name for name in truth_files.TRUTH_NAMES}, classes, "here")
    )
    assert mesh.instance_of_triangle.tolist() == [1, 1, 1, 2]
    assert mesh.class_of_instance == {1: 2, 2: 4}


def test_too_many_objects_for_the_ids_are_rejected(tmp_path: Path) -> None:
    groups = [*[("floor", (1,))] * 999, ("chair", (2,))]
    assert written(tmp_path, [1, 2, 2], groups, mesh=row_of_points(3)).instance.tolist() == [0, 1000, 1000]
    with pytest.raises(DataError, match="allows at most 1000"):
        written(tmp_path, [1, 2, 2], [*groups, ("chair", (2,))], mesh=row_of_points(3))
