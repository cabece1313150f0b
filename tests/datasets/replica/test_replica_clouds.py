"""Replica's ground truth as ConceptGraphs' clouds, scored end to end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_files import write_files
from replica_scene import CHAIR, CLOUDS, TABLE, WALL, first_pose, write_clouds, write_render
from scored_room import instances

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.replica.truth import N_EMBEDDING
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

RUG, FLOOR, DOOR, PICTURE = 98, 40, 37, 59


def test_labelled_cloud_is_moved_by_the_first_pose_but_reference_cloud_is_not(tmp_path: Path) -> None:
    write_render(tmp_path)
    points = np.random.default_rng(0).random((5, 3))
    reference = np.array([[1.0, 2, 3], [4, 5, 6]])
    write_clouds(tmp_path, points, np.array([CHAIR, 0, WALL, 101, CHAIR]), reference)
    truth = Replica(tmp_path).ground_truth("room0", "conceptgraphs")
    expected = points @ first_pose()[:3, :3].T + first_pose()[:3, 3]
    np.testing.assert_allclose(truth.points, expected, atol=1e-6)
    assert truth.points.dtype == np.float32
    assert truth.semantic.tolist() == [CHAIR, 0, WALL, 101, CHAIR]
    assert truth.instance.tolist() == [0] * 5
    assert truth.evaluation_points is not None
    np.testing.assert_array_equal(truth.evaluation_points, reference)
    assert "Sequence_1/saved-maps-gt/pointclouds, moved by the first pose of traj_w_c.txt" in truth.source
    assert "room0/rgb_cloud/pointclouds/pc_points.h5" in truth.source


def test_labels_are_the_first_maximum_and_a_zero_row_is_other(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    table = np.zeros((3, N_EMBEDDING), np.float32)
    table[1, [TABLE, WALL]] = 0.5
    table[2, CHAIR] = 1
    write_files(tmp_path, {f"{CLOUDS}/pc_embeddings.h5": table})
    assert Replica(tmp_path).ground_truth("room0", "conceptgraphs").semantic.tolist() == [0, TABLE, CHAIR]


@dataclass
class TextDirections:
    """An encoder that gives each text a distinct direction, the same in every process."""

    name: str = "directions"
    digest: str = "directions"
    dim: int = 24

    def encode_images(self, images: Any) -> Float32Array:
        raise AssertionError("scoring uses no image")

    def encode_texts(self, texts: Any) -> Float32Array:
        rows = [np.random.default_rng(list(text.encode())).normal(size=self.dim) for text in texts]
        return np.stack([row / np.linalg.norm(row) for row in rows]).astype(np.float32)


# Classes in the labelled cloud of each scene: 'other', classes dropped by every exclusion, and classes that remain.
SCENE_CLASSES = {"room0": [0, WALL, FLOOR, DOOR, CHAIR, TABLE, RUG], "office1": [0, WALL, 97, TABLE, 47, 95]}


@dataclass
class CloudScene:
    """Inputs of one scene's evaluation: the labelled cloud in its camera, the reference cloud, and a map."""

    points: Float32Array
    labels: np.ndarray
    reference: Float32Array
    prediction: Instances


def cloud_scene(scene: str) -> CloudScene:
    rng = np.random.default_rng(list(scene.encode()))
    labels = rng.choice(SCENE_CLASSES[scene], 90)
    labels[-1] = PICTURE  # in a far corner, nearest to no reference point: a class of the clouds without points
    world = rng.random((90, 3)) * 2
    world[-1] = 30
    pose = first_pose()
    points = ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
    map_points = (rng.random((120, 3)) * 2).astype(np.float32)
    masks = [np.sort(rng.choice(120, rng.integers(5, 25), replace=False)) for _ in range(9)]
    features = rng.normal(size=(9, TextDirections.dim)).astype(np.float32)
    prediction = instances(map_points, [mask.astype(np.int32) for mask in masks], None, features)
    return CloudScene(points, labels, (rng.random((200, 3)) * 2).astype(np.float32), prediction)


def nearest_brute(candidates: np.ndarray, query: np.ndarray) -> int:
    return int(((candidates.astype(np.float64) - query.astype(np.float64)) ** 2).sum(axis=1).argmin())


def brute_confusion(scene: CloudScene, names: dict[int, str], excluded: set[str]) -> np.ndarray:
    """Steps 2 to 9 of the original evaluation, point by point; rows are ground truth, by native id."""
    pose = first_pose().astype(np.float32)
    truth_points = scene.points @ pose[:3, :3].T + pose[:3, 3]
    vocabulary = [one for one in names if one in scene.labels and names[one] not in excluded]
    text = TextDirections().encode_texts([f"an image of {names[one]}" for one in vocabulary]).astype(np.float64)
    features = np.asarray(scene.prediction.features, np.float64)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    class_of_object = [vocabulary[int((text @ feature).argmax())] for feature in features]
    object_points = np.concatenate([scene.prediction.points[scene.prediction.mask(k)] for k in range(len(features))])
    object_classes = [class_of_object[k] for k in range(len(features)) for _ in range(len(scene.prediction.mask(k)))]
    confusion = np.zeros((102, 102), np.int64)
    for query in scene.reference:
        true = int(scene.labels[nearest_brute(truth_points, query)])
        if true in vocabulary:
            confusion[true, object_classes[nearest_brute(object_points, query)]] += 1
    return confusion


def brute_metrics(confusion: np.ndarray) -> dict[str, float]:
    """The row `all`: classes with a reference point, with rows and columns reduced together."""
    keep = np.flatnonzero(confusion.sum(axis=1))
    cut = confusion[np.ix_(keep, keep)].astype(float)
    hits, rows, columns = np.diag(cut), cut.sum(axis=1), cut.sum(axis=0)
    iou = hits / np.maximum(1, rows + columns - hits)
    return {
        "mAcc": float(np.mean(hits / np.maximum(1, rows))),
        "mIoU": float(iou.mean()),
        "F-mIoU": float((rows / rows.sum() * iou).sum()),
    }


@pytest.mark.parametrize("n_exclude", [1, 4, 6])
def test_scores_match_a_brute_force_version_of_the_original_steps(tmp_path: Path, n_exclude: int) -> None:
    rules = load_protocol(f"replica-conceptgraphs-ex{n_exclude}")
    excluded = set(["other", "floor", "wall", "ceiling", "door", "window"][:n_exclude])
    names = {entry.id: entry.name for entry in rules.classes}
    scores, confusion = {}, np.zeros((102, 102), np.int64)
    for name in SCENE_CLASSES:
        scene = cloud_scene(name)
        write_render(tmp_path, name, 1)
        write_clouds(tmp_path, scene.points, scene.labels, scene.reference, name)
        truth = Replica(tmp_path).ground_truth(name, "conceptgraphs")
        scores[name] = score_scene(rules, truth, scene.prediction, TextDirections())
        of_scene = brute_confusion(scene, names, excluded)
        assert scores[name].n_scored == of_scene.sum() > 50
        confusion += of_scene
    expected = brute_metrics(confusion)
    found = combine(rules, scores).metrics
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=1e-12)
    assert 0.02 < expected["mAcc"] < 0.9
