"""The Replica dataset on small scenes in the exact layout: frames, ground truth on hand-worked meshes, each fault."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest
import replica_scene as rep
from recording_files import depth_values
from recording_files import turn as pose

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import Frame
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.replica.folders import original_name
from su3d_bench.datasets.replica.truth import object_of_vertex
from su3d_bench.formats.ply import ListColumn


def test_frames_match_the_files(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    frames = Replica(tmp_path).frames("room0", 2)
    assert len(frames) == 2
    last: Frame = frames[-1]
    assert (last.index, frames[0].index, last.timestamp_s) == (2, 0, 2 / 30)
    np.testing.assert_array_equal(last.camera_to_world, pose(2))
    np.testing.assert_array_equal(last.depth_m, (depth_values(2) / rep.SCALE).astype(np.float32))
    np.testing.assert_array_equal(last.intrinsics, [[6, 0, 5.5], [0, 6.5, 3.5], [0, 0, 1]])
    assert np.abs(last.rgb.astype(int) - (200, 120, 30)).max() <= 3
    with pytest.raises(IndexError):
        frames[2]


def test_official_scenes_come_first_and_others_in_natural_order(tmp_path: Path) -> None:
    for scene in ("living10", "office1", "living2", "room2", "room0"):
        rep.write_render(tmp_path, scene, 1)
    (tmp_path / "Replica" / ".living3.partial" / "results").mkdir(parents=True)
    assert Replica(tmp_path).scenes() == ("room0", "room2", "office1", "living2", "living10")


@pytest.mark.parametrize(
    ("scene", "name"),
    [("room0", "room_0"), ("office4", "office_4"), ("living12", "living_12"), ("frl_apartment_0", "frl_apartment_0")],
)
def test_scene_names_of_the_two_trees_match(scene: str, name: str) -> None:
    assert original_name(scene) == name


def test_vertices_take_the_majority_object_of_their_faces_and_the_lowest_id_on_ties(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    rep.write_original(tmp_path, rep.QUADS, [0, 5, 5, 5], rep.TWO_OBJECTS)
    truth = Replica(tmp_path).ground_truth("room0", "mesh-vertices")
    # vertex 1 and 3 have one face of each object: the chair, id 0; vertex 4 has three faces of the table
    chair, table = rep.CHAIR, rep.TABLE
    assert truth.semantic.tolist() == [chair, chair, table, chair, table, table, table, table, table]
    assert truth.instance.tolist() == [1, 1, 6, 1, 6, 6, 6, 6, 6]
    assert truth.labels.name_of(rep.CHAIR) == "chair"
    assert truth.points[5].tolist() == [2, 1, 0]


def test_vertex_without_faces_is_void_and_a_face_counts_a_repeated_vertex_once() -> None:
    corners = ListColumn(np.array([0, 4, 7, 10]), np.array([0, 0, 0, 1, 0, 1, 2, 0, 2, 1]))
    face = object_of_vertex(4, corners, np.array([3, 9, 9]))
    assert np.array([3, 9, 9])[face[:3]].tolist() == [9, 9, 9]
    assert face[3] == -1


def test_face_corners_repeat_vertices_in_face_order(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    rep.write_original(tmp_path, [[0, 1, 4, 3], [1, 2, 4]], [5, 0], rep.TWO_OBJECTS)
    truth = Replica(tmp_path).ground_truth("room0", "face-corners")
    assert truth.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]]
    assert truth.semantic.tolist() == [rep.TABLE] * 4 + [rep.CHAIR] * 3
    assert truth.instance.tolist() == [6] * 4 + [1] * 3


def test_polygons_become_triangle_fans(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    rep.write_original(tmp_path, [[0, 1, 4, 3], [1, 2, 4], [4, 5, 8, 7, 6]], [5, 0, 5], rep.TWO_OBJECTS)
    mesh = Replica(tmp_path).instance_mesh("room0")
    assert mesh.triangles.tolist() == [[0, 1, 4], [0, 4, 3], [1, 2, 4], [4, 5, 8], [4, 8, 7], [4, 7, 6]]
    assert mesh.instance_of_triangle.tolist() == [6, 6, 1, 6, 6, 6]
    assert mesh.class_of_instance == {1: rep.CHAIR, 6: rep.TABLE}


def test_objects_without_entry_are_void_and_counted_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rep.write_render(tmp_path)
    rep.write_original(tmp_path, rep.QUADS, [0, 7, 7, 300], rep.TWO_OBJECTS)
    replica = Replica(tmp_path)
    with caplog.at_level(logging.WARNING):
        truth = replica.ground_truth("room0", "face-corners")
        replica.instance_mesh("room0")
    assert truth.semantic.tolist() == [rep.CHAIR] * 4 + [0] * 12
    assert truth.instance.tolist() == [1] * 4 + [0] * 12
    assert [record.getMessage() for record in caplog.records] == [
        "replica/room0: object ids without entry in habitat/info_semantic.json: 2 (the first: 7); faces made void: 3"
    ]


def test_scene_without_original_release_has_frames_but_no_ground_truth(tmp_path: Path) -> None:
    rep.write_render(tmp_path)
    replica = Replica(tmp_path)
    assert len(replica.frames("room0", 1)) == 3
    with pytest.raises(GroundTruthMissing, match=r"replica/room0: no ground truth; expected room_0/habitat/mesh_sem"):
        replica.instance_mesh("room0")
    (rep.write_original(tmp_path, rep.QUADS, [0, 0, 5, 5], rep.TWO_OBJECTS) / "info_semantic.json").unlink()
    with pytest.raises(GroundTruthMissing, match=r"info_semantic\.json is missing"):
        Replica(tmp_path).ground_truth("room0", "mesh-vertices")


def test_marker_scenes_are_rendered_rooms_and_others_camera_images(tmp_path: Path) -> None:
    rep.write_render(tmp_path, "living0")
    rep.write_render(tmp_path, "room0")
    (tmp_path / "Replica" / "rooms.json").write_text(json.dumps({"scenes": {"living0": "key"}}))
    replica = Replica(tmp_path)
    assert replica.info("living0", 1).image_domain == "rendered-rooms"
    assert replica.info("room0", 1).image_domain == "camera"
    (tmp_path / "Replica" / "rooms.json").write_text("{}")
    with pytest.raises(DataError, match=r"rooms\.json: not a marker"):
        replica.info("room0", 1)
