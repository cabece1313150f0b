"""Exported predictions survive a round trip, with remarks on what a format does not support."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_room import ENCODER, ID, room

from su3d_bench.core.errors import PredictionError, StoreError
from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.metrics.matching.transfer import masks_of, transfer_masks
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions import export
from su3d_bench.predictions.base import VertexLabels, VertexMasks, vertex_masks
from su3d_bench.predictions.formats import READERS

RULES = load_protocol("rooms-instance")
RNG = np.random.default_rng(0)


def a_map(members: list[list[int]], n_points: int = 8, dim: int = 4, **more: Any) -> Instances:
    k, points = len(members), RNG.normal(size=(n_points, 3)).astype(np.float32)
    made = Instances.of(points, members, np.linspace(0.1, 0.9, k), RNG.normal(size=(k, dim)).astype(np.float32))
    return replace(made, **more)


def read_openlex(folder: Path) -> Partition:
    content = READERS["openlex3d"].read(folder, folder.name).content
    assert isinstance(content, Partition)
    return content


def read_text(folder: Path, scene: str) -> VertexMasks:
    content = READERS["scannet-text"].read(folder, scene).content
    assert isinstance(content, VertexMasks)
    return content


# ---- OpenLex3D


def test_map_without_overlaps_survives_a_round_trip(tmp_path: Path) -> None:
    made = a_map([[0, 2], [1, 3, 4], [5, 6, 7]])
    assert export.write_openlex(made, tmp_path / "s") == ()
    found = read_openlex(tmp_path / "s")
    np.testing.assert_array_equal(found.points, made.points)
    assert found.instance.tolist() == [0, 1, 0, 1, 1, 2, 2, 2]
    np.testing.assert_array_equal(found.features, made.features)
    assert export.write_openlex(found, tmp_path / "t") == ()
    for file in ("point_cloud.pcd", "index.npy", "embeddings.npy"):
        assert (tmp_path / "s" / file).read_bytes() == (tmp_path / "t" / file).read_bytes()


def test_shared_points_are_assigned_to_the_first_object_and_unassigned_ones_omitted(tmp_path: Path) -> None:
    made = a_map([[0, 1, 2], [1, 2, 4], [2]])
    remarks = export.write_openlex(made, tmp_path / "s")
    assert remarks == (
        "2 points are in several objects and were assigned to the first",
        "4 of 8 points are in no object and were omitted",
        "1 of 3 objects have no points",
    )
    found = read_openlex(tmp_path / "s")
    np.testing.assert_array_equal(found.points, made.points[[0, 1, 2, 4]])
    assert found.instance.tolist() == [0, 0, 0, 1] and len(found.features) == 3


@given(members=st.lists(st.sets(st.integers(0, 11)), min_size=1, max_size=5).filter(any))
@settings(max_examples=60, deadline=None)
def test_every_point_of_an_object_is_exported_once_to_one_of_its_objects(members: list[set[int]]) -> None:
    made = a_map([sorted(one) for one in members], n_points=12)
    parts = export.openlex_parts(made)
    kept = sorted(set().union(*members))
    np.testing.assert_array_equal(parts.points, made.points[kept])
    assert [min(k for k, one in enumerate(members) if point in one) for point in kept] == parts.index.tolist()


def test_partitions_and_dense_maps_omit_points_without_object(tmp_path: Path) -> None:
    points, features = RNG.normal(size=(4, 3)).astype(np.float32), RNG.normal(size=(2, 3)).astype(np.float32)
    remarks = export.write_openlex(Partition(points, np.array([1, -1, 0, 1], np.int32), features), tmp_path / "p")
    assert remarks == ("1 of 4 points are in no object and were omitted",)
    assert read_openlex(tmp_path / "p").instance.tolist() == [1, 0, 1]
    rows = np.array([[1, 2], [0, 0], [3, 4], [0, -1]], np.float16)
    remarks = export.write_openlex(DenseFeatures(points, rows), tmp_path / "d")
    assert remarks[1] == "1 of 4 points have no feature and were omitted"
    found = read_openlex(tmp_path / "d")
    np.testing.assert_array_equal(found.points, points[[0, 2, 3]])
    assert found.instance.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(found.features, rows[[0, 2, 3]].astype(np.float32))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (a_map([[0]], features=None), "has no features, and OpenLex3D needs one for each object"),
        (a_map([[], []]), "has no points in any object; there is nothing to export"),
        (a_map([[0]], points=np.full((8, 3), np.nan, np.float32)), "has points that are NaN or infinite"),
        (
            Partition(np.zeros((1, 3), np.float32), np.array([2], np.int32), np.ones((2, 2), np.float32)),
            "needs one of its 2 rows of features per point",
        ),
        (VertexLabels(np.zeros(3, np.int32)), "is over the points of the ground truth and has no points"),
    ],
)
def test_maps_unsupported_by_openlex3d_are_refused(content: Any, message: str) -> None:
    with pytest.raises(PredictionError, match=message):
        export.openlex_parts(content)


# ---- ScanNet


def test_masks_labels_and_scores_survive_a_round_trip_in_every_bit(tmp_path: Path) -> None:
    scores = np.array([0.1 + 0.2, 1 / 3, 1e-17, 0.30000000000000004 + 1e-16])
    members = [np.array(one, np.int32) for one in ([0, 3], [1], [0, 1, 2, 3], [2, 4])]
    made = vertex_masks("x", members, 5, scores=scores, class_numbers=np.arange(1, 5, dtype=np.int32))
    assert export.write_scannet(export.masks_as_they_are(made), "scene0011_00", tmp_path) == ()
    found = read_text(tmp_path, "scene0011_00")
    assert found.n_points == 5
    assert [one.tolist() for one in found.sets()] == [one.tolist() for one in members]
    assert found.scores.tolist() == scores.tolist()
    assert found.class_numbers is not None and found.class_numbers.tolist() == [1, 2, 3, 4]
    assert (tmp_path / "pred_mask/scene0011_00_000.txt").read_text() == "1\n0\n0\n1\n0\n"
    first = (tmp_path / "scene0011_00.txt").read_text().splitlines()[0]
    assert first == "pred_mask/scene0011_00_000.txt 1 0.30000000000000004"


def labelled_room() -> Instances:
    """The ground truth of a room as a map on other points, with its own labels and scores."""
    truth = room()
    ids = np.unique(truth.instance[truth.instance > 0])
    name_of = {value: name for name, value in ID.items()}
    labels = tuple(name_of[int(truth.semantic[truth.instance == one][0])] for one in ids)
    members = [np.flatnonzero(truth.instance == one).tolist() for one in ids]
    points = truth.points + np.random.default_rng(3).normal(size=truth.points.shape).astype(np.float32) * 0.02
    return a_map(members, len(points), points=points.astype(np.float32), labels=labels, features=None)


def test_map_on_other_points_is_transferred_to_vertices_and_scores_equally(tmp_path: Path) -> None:
    truth, made = room(), labelled_room()
    export.write_scannet(export.masks_on_truth(made, RULES, truth, None), "living0", tmp_path)
    found = read_text(tmp_path, "living0")
    moved = transfer_masks(
        made.points, masks_of(made), truth.points, RULES.transfer.cap_m, RULES.transfer.evaluation_voxel_m
    )
    np.testing.assert_array_equal(found.indptr, moved.indptr)
    np.testing.assert_array_equal(found.indices, moved.indices)
    assert found.class_numbers is not None and made.labels is not None
    assert found.class_numbers.tolist() == [ID[label] for label in made.labels]
    back = replace(made, points=truth.points, indptr=found.indptr, indices=found.indices, scores=found.scores)
    before, after = (combine(RULES, {"s": score_scene(RULES, truth, one, None)}).metrics for one in (made, back))
    assert before == after and 0 < before["AP"] < 1


def test_features_are_classified_by_the_encoder_among_the_protocols_classes() -> None:
    made = labelled_room()
    assert made.labels is not None
    featured = replace(made, labels=None, features=ENCODER.encode_texts(made.labels))
    labelled = export.masks_on_truth(featured, RULES, room(), ENCODER)
    assert labelled.class_ids.tolist() == [ID[label] for label in made.labels]
    assert labelled.remarks == ()
    other = export.masks_on_truth(featured, load_protocol("replica-openmask3d"), room(), ENCODER)
    assert other.remarks == ("labels come from the encoder 'one-hot', the protocol's is 'ViT-L-14-336/openai'",)


def test_a_partition_is_exported_with_scores_of_one_and_a_remark(tmp_path: Path) -> None:
    truth, made = room(), labelled_room()
    assert made.labels is not None
    owner = np.full(len(truth.points), -1, np.int32)
    owner[made.indices] = np.repeat(np.arange(len(made), dtype=np.int32), np.diff(made.indptr))
    partition = Partition(truth.points, owner, ENCODER.encode_texts(made.labels))
    labelled = export.masks_on_truth(partition, RULES, truth, ENCODER)
    assert labelled.remarks[0] == "a partition has no scores: 1 for every mask"
    export.write_scannet(labelled, "living0", tmp_path)
    found = read_text(tmp_path, "living0")
    assert found.scores.tolist() == [1.0] * len(made)
    np.testing.assert_array_equal(found.indices, made.indices)
    with pytest.raises(PredictionError, match="per point, -1 for none"):
        export.masks_on_truth(replace(partition, instance=owner + 100), RULES, truth, ENCODER)


def test_class_list_indices_become_class_ids() -> None:
    n = len(room().points)
    members = [np.array([0, 1], np.int32)] * 3
    made = vertex_masks("x", members, n, class_numbers=np.array([0, 2, 10_000], np.int32), numbering="index")
    labelled = export.masks_on_truth(made, RULES, room(), None)
    assert labelled.class_ids.tolist() == [RULES.scored[0].id, RULES.scored[2].id, 0]


def test_predictions_unsupported_by_scannets_list_are_refused() -> None:
    dense = DenseFeatures(np.zeros((1, 3), np.float32), np.ones((1, 2), np.float16))
    for content in (dense, VertexLabels(np.zeros(3, np.int32))):
        with pytest.raises(PredictionError, match="has no masks"):
            export.masks_on_truth(content, RULES, room(), None)
    with pytest.raises(PredictionError, match=r"is of 9 points, the scene of \d+; both need one mesh"):
        export.masks_on_truth(vertex_masks("x", [np.array([1], np.int32)], 9), RULES, room(), None)
    with pytest.raises(PredictionError, match="NaN or infinite"):
        export.masks_on_truth(replace(labelled_room(), scores=np.full(8, np.nan)), RULES, room(), None)


@pytest.mark.parametrize("scene", ["", "..", "a/b", "a\nb", "-x", "/etc"])
def test_scene_name_outside_the_folder_is_refused(scene: str, tmp_path: Path) -> None:
    with pytest.raises(PredictionError, match="is not a valid file name"):
        export.file_name(scene)


def test_export_folder_is_written_atomically(tmp_path: Path) -> None:
    with export.whole_folder(tmp_path / "deep/out") as folder:
        (folder / "x").write_text("1")
        assert not (tmp_path / "deep/out").exists()
    assert (tmp_path / "deep/out/x").read_text() == "1"
    with pytest.raises(PredictionError), export.whole_folder(tmp_path / "other") as folder:
        export.write_openlex(a_map([[]]), folder / "s")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["deep"]
    with pytest.raises(StoreError, match="choose another folder with --out"), export.whole_folder(tmp_path / "deep"):
        pass
    (tmp_path / "empty").mkdir()
    with export.whole_folder(tmp_path / "empty") as folder:
        (folder / "y").write_text("2")
    assert (tmp_path / "empty/y").read_text() == "2"
