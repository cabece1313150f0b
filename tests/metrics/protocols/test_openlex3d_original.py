"""Generated problems of OpenLex3D's three protocols with the original's results, and the files of its datasets.

A problem has scenes of one dataset; positions are in tenths of a millimetre, objects and labels as in the release.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.maps import Partition
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.datasets.openlex3d.release import (
    LabelledPoints,
    OpenLexFiles,
    OpenLexRelease,
    categories_truth,
    points_of,
    queries_truth,
)
from su3d_bench.formats.ply import PlyElement, write_ply
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

PROBLEMS = json.loads((CASES / "openlex3d01_made.json").read_text())
TOPN, RANKING, QUERIES = (load_protocol(f"openlex3d-{name}") for name in ("topn", "ranking", "queries"))
SAMPLED = CASES / "openlex3d/0a76e06478.pth"  # one scene of the problems as saved by ScanNet++'s toolbox with torch


@dataclass
class TableEncoder:
    """Text features from a problem."""

    table: dict[str, list[int]]
    name: str = "table"
    digest: str = "table"
    dim: int = 8

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring looks at no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        rows = np.array([self.table[text] for text in texts], np.float32)
        features: Float32Array = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        return features


def metres(places: list[list[int]]) -> Float32Array:
    return (np.array(places, np.float64).reshape(-1, 3) / 10_000).astype(np.float32)


def write_labels(root: Path, problem: dict[str, Any]) -> dict[str, OpenLexFiles]:
    """The release's files of every scene of a problem."""
    dataset, written = problem["dataset"], {}
    for name, scene in problem["scenes"].items():
        folder = root / dataset / name
        folder.mkdir(parents=True)
        (folder.parent / "prompt_list.txt").write_text("\n".join(problem["prompts"]) + "\n")
        tiers = ("synonyms", "depictions", "vis_sim", "clutter")
        samples = [
            {"object_id": int(one), "labels": {"image_attributes": dict(zip(tiers, labels, strict=True))}}
            for one, labels in scene["objects"].items()
        ]
        (folder / "gt_categories.json").write_text(json.dumps({"dataset": {"samples": samples}}))
        queries = json.dumps({"level0": scene["queries"]})
        (folder / "gt_categories_query_to_object_mapping_l0.json").write_text(queries)
        if scene["visible"] is not None:
            write_visible(folder, metres(scene["visible"]))
        written[name] = OpenLexFiles(root, dataset, name)
    return written


def write_visible(folder: Path, points: np.ndarray) -> None:
    fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1"
    size = f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}"
    head = f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n{fields}\n{size}\nDATA binary\n"
    (folder / "gt_visible_cloud.pcd").write_bytes(head.encode() + points.astype("<f4").tobytes())


def write_objects(folder: Path, scene: dict[str, Any]) -> None:
    """The files of an HM3DSem walk that are read."""
    owner, points = np.array(scene["owner"]), metres(scene["points"]).astype(np.float64)
    ids = [int(one) for one in dict.fromkeys(scene["owner"])]
    (folder / "objects").mkdir(parents=True)
    (folder / "scene_info.json").write_text(json.dumps({"levels": [], "objects": [{"id": one} for one in ids]}))
    for one in ids:
        own = points[owner == one]
        columns = {axis: own[:, column] for column, axis in enumerate("xyz")}
        write_ply(folder / f"objects/{one}.ply", [PlyElement("vertex", len(own), columns)])


def predicted(scene: dict[str, Any]) -> Partition:
    features = np.array(scene["features"], np.float32)
    return Partition(metres(scene["cloud"]), np.array(scene["index"], np.int32), features)


# ---- equal to the original


@pytest.mark.parametrize("number", range(len(PROBLEMS)))
def test_generated_problem_equals_openlex3d_in_three_protocols(number: int, tmp_path: Path) -> None:
    problem = PROBLEMS[number]
    encoder, files = TableEncoder(problem["texts"]), write_labels(tmp_path, problem)
    for rules in (TOPN, RANKING, QUERIES):
        scores = {}
        for name, scene in problem["scenes"].items():
            labelled = LabelledPoints(metres(scene["points"]), np.array(scene["owner"]), "made")
            if rules is QUERIES:
                truth: Any = queries_truth(files[name], labelled, "l0")
            else:
                truth = categories_truth(files[name], labelled)
            scores[name] = score_scene(rules, truth, predicted(scene), encoder)
        found, answer = combine(rules, scores, with_intervals=False), problem["answers"][rules.name]
        rows = [found.metrics] if rules is QUERIES else [found.per_scene[name] for name in scores]
        for row, wanted in zip(rows, [answer] if rules is QUERIES else answer, strict=True):
            known = {key: np.nan if value is None else value for key, value in wanted.items()}
            assert {key: row[key] for key in known} == pytest.approx(known, rel=0, abs=1e-15, nan_ok=True)


# ---- the points of each dataset


def of_dataset(name: str) -> dict[str, Any]:
    """A problem of a dataset, some of whose points have no object, without a cloud of visible points."""
    first = {"scannetpp": "0a76e06478", "hm3d": "00824"}[name]
    own = [problem for problem in PROBLEMS if problem["dataset"] == name]
    fitting = (one for one in own if one["scenes"][first]["visible"] is None)
    return next(one for one in fitting if name == "hm3d" or -1 in one["scenes"][first]["owner"])


def test_sampled_points_of_scannetpp_are_read_and_points_without_object_match_nothing(tmp_path: Path) -> None:
    problem, scene = of_dataset("scannetpp"), "0a76e06478"
    (tmp_path / "scannetpp/prepared_semantics").mkdir(parents=True)
    shutil.copy(SAMPLED, tmp_path / "scannetpp/prepared_semantics")
    labelled = points_of("scannetpp", tmp_path, scene)
    assert labelled.object_of_point.tolist() == problem["scenes"][scene]["owner"]
    np.testing.assert_array_equal(labelled.points, metres(problem["scenes"][scene]["points"]))
    with pytest.raises(GroundTruthMissing, match=r"scannetpp/1f7cbbdde1: no points .*semantics/1f7cbbdde1.pth"):
        points_of("scannetpp", tmp_path, "1f7cbbdde1")


def test_hm3d_objects_are_read_in_order_also_with_the_long_scene_name(tmp_path: Path) -> None:
    scene = of_dataset("hm3d")["scenes"]["00824"]
    for folder in ("hm3d/00824", "hm3dsem_walks/val/00824-Dd4bFSTQ8gi"):
        write_objects(tmp_path / folder, scene)
        labelled = points_of("hm3d", tmp_path, "00824")
        assert labelled.object_of_point.tolist() == scene["owner"]
        np.testing.assert_array_equal(labelled.points, metres(scene["points"]))
        shutil.rmtree(tmp_path / folder)
    with pytest.raises(GroundTruthMissing, match=r"hm3d/00824: no points .*00824/scene_info.json"):
        points_of("hm3d", tmp_path, "00824")


def test_without_visible_cloud_all_points_count_except_for_replica(tmp_path: Path) -> None:
    problem = of_dataset("hm3d")
    write_labels(tmp_path / "lex", problem)
    for name, scene in problem["scenes"].items():
        write_objects(tmp_path / "data/hm3d" / name, scene)
    release = OpenLexRelease(tmp_path / "lex", tmp_path / "data", "hm3d")
    truth = release.truth("00824", TOPN.ground_truth)
    assert len(truth.points) == len(problem["scenes"]["00824"]["points"])
    assert truth.source.startswith("all points, gt_categories.json")
    labelled = LabelledPoints(truth.points, truth.object_of_point, "made")
    shutil.copytree(tmp_path / "lex/hm3d", tmp_path / "lex/replica")
    with pytest.raises(GroundTruthMissing, match=r"replica/00824: gt_visible_cloud\.pcd: is missing"):
        categories_truth(OpenLexFiles(tmp_path / "lex", "replica", "00824"), labelled)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ("[]", "expected an object"),
        ('{"objects": []}', "objects: List should have at least 1 item"),
        ('{"objects": [{"id": "7"}]}', "objects.0.id: Input should be a valid integer"),
        ('{"objects": [{"id": 1}, {"id": 1}]}', "an object is listed twice"),
    ],
)
def test_damaged_object_list_is_one_line(info: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "hm3d/00824").mkdir(parents=True)
    (tmp_path / "hm3d/00824/scene_info.json").write_text(info)
    with pytest.raises(DataError, match=f"^hm3d/00824: .*{message}"):
        points_of("hm3d", tmp_path, "00824")


def test_other_torch_archive_is_not_a_sampled_point_file(tmp_path: Path) -> None:
    (tmp_path / "prepared_semantics").mkdir()
    shutil.copy(CASES / "online_maps/ovo_map.ckpt", tmp_path / "prepared_semantics/a.pth")
    with pytest.raises(DataError):
        points_of("scannetpp", tmp_path, "a")
    shutil.copy(next((CASES / "torch_files").glob("*.pt*")), tmp_path / "prepared_semantics/b.pth")
    with pytest.raises(DataError):
        points_of("scannetpp", tmp_path, "b")
