"""Replica's ground truth from released label files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import replica_scene as rep
from scored_room import instances

from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.replica.truth import OVO_CLASSES
from su3d_bench.formats.ply import PlyElement, write_ply
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene


def write_mesh(path: Path, n_vertices: int, at: float = 0.0) -> None:
    axis = np.arange(n_vertices, dtype=np.float32) + np.float32(at)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, [PlyElement("vertex", n_vertices, {"x": axis, "y": axis.copy(), "z": axis.copy()})])


def write_labels(root: Path, name: str, values: list[int]) -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{value}\n" for value in values))
    return path


def test_instances_of_the_file_apply_to_the_render_mesh(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 7, at=100)
    rep.write_original(tmp_path, rep.QUADS, [0, 0, 5, 5], rep.TWO_OBJECTS)
    write_labels(tmp_path, "Replica/ground_truth/room0.txt", [20066, 80066, 30, 256003, 20000, 0, 20066])
    truth = Replica(tmp_path).ground_truth("room0", "openmask3d")
    assert truth.semantic.tolist() == [rep.CHAIR, rep.TABLE, 0, 0, rep.CHAIR, 0, rep.CHAIR]
    assert truth.instance.tolist() == [2, 3, 0, 0, 1, 0, 2]  # in ascending order of the values
    assert truth.points[:, 0].tolist() == [100, 101, 102, 103, 104, 105, 106]
    assert truth.source == "ground_truth/room0.txt, class id * 1000 + instance of each vertex of room0_mesh.ply"


def test_labels_of_the_original_mesh_are_recognized_by_their_count(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 7)
    rep.write_original(tmp_path, rep.QUADS, [0, 0, 5, 5], rep.TWO_OBJECTS)
    write_labels(tmp_path, "Replica/ground_truth/room_0.txt", [20001] * 9)
    truth = Replica(tmp_path).ground_truth("room0", "openmask3d")
    assert truth.points[5].tolist() == [2, 1, 0]
    assert truth.source.endswith("vertex of habitat/mesh_semantic.ply")


def test_class_file_uses_replica_ids_and_undefined_ones_are_void(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 6)
    write_labels(tmp_path, "Replica/semantic_gt/room0.txt", [20, -1, 93, -2, 256, 3])
    truth = Replica(tmp_path).ground_truth("room0", "ovo-51")
    assert truth.semantic.tolist() == [20, 0, 93, 0, 0, 3]
    assert truth.instance.tolist() == [0] * 6
    assert truth.source == "semantic_gt/room0.txt, the class of each vertex of room0_mesh.ply"


def test_51_classes_are_the_conceptgraphs_list_without_other() -> None:
    listed = {entry.id for entry in load_protocol("replica-conceptgraphs-ex6").classes}
    assert set(OVO_CLASSES) == listed - {0}
    assert len(OVO_CLASSES) == 51


INSTANCES, CLASSES = "Replica/ground_truth/room0.txt", "Replica/semantic_gt/room0.txt"


def test_released_instances_as_prediction_score_exactly_one(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 360)
    write_labels(tmp_path, INSTANCES, [20001] * 120 + [80001] * 120 + [30] * 120)
    truth = Replica(tmp_path).ground_truth("room0", "openmask3d")
    masks = [np.arange(120, dtype=np.int32), np.arange(120, 240, dtype=np.int32)]
    rules = load_protocol("replica-openmask3d-released")
    score = score_scene(rules, truth, instances(truth.points, masks, ["chair", "table"]), None)
    metrics = combine(rules, {"room0": score}).metrics
    assert [metrics[name] for name in ("AP", "AP50", "AP25")] == [1.0, 1.0, 1.0]


def test_files_and_status_cover_all_released_ground_truth(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 2)
    rep.write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    write_labels(tmp_path, INSTANCES, [20001] * 2)
    write_labels(tmp_path, CLASSES, [20] * 2)
    replica = Replica(tmp_path)
    assert replica.status("room0").endswith("; also conceptgraphs, openmask3d, ovo-51")
    assert set(replica.files("room0")) == {path for path in tmp_path.rglob("*") if path.is_file()}
    (tmp_path / rep.REFERENCE).unlink()
    assert "; also conceptgraphs without its pc_points.h5, openmask3d" in replica.status("room0")
