"""The Replica adapter on small scenes in the exact layout: frames, truth on hand-worked meshes, each fault once."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recording_files import turn as pose
from replica_scene import (
    CAMERA,
    CHAIR,
    HEIGHT,
    QUADS,
    SCALE,
    TABLE,
    TWO_OBJECTS,
    WIDTH,
    depth_values,
    info_table,
    write_original,
    write_render,
)

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import Frame
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.replica.folders import original_name
from su3d_bench.datasets.replica.truth import object_of_vertex
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply

Change = Callable[[Path], object]


def first_line_of(change: Change, root: Path) -> str:
    """The message of the error that a scene with this change raises, from whatever step comes upon it."""
    write_render(root)
    change(root / "Replica")
    replica = Replica(root)
    with pytest.raises(DataError) as caught:
        list(replica.frames("room0", 1))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_frames_hold_what_the_files_hold(tmp_path: Path) -> None:
    write_render(tmp_path)
    frames = Replica(tmp_path).frames("room0", 2)
    assert len(frames) == 2
    last: Frame = frames[-1]
    assert (last.index, frames[0].index, last.timestamp_s) == (2, 0, 2 / 30)
    np.testing.assert_array_equal(last.camera_to_world, pose(2))
    np.testing.assert_array_equal(last.depth_m, (depth_values(2) / SCALE).astype(np.float32))
    np.testing.assert_array_equal(last.intrinsics, [[6, 0, 5.5], [0, 6.5, 3.5], [0, 0, 1]])
    assert np.abs(last.rgb.astype(int) - (200, 120, 30)).max() <= 3
    with pytest.raises(IndexError):
        frames[2]


def test_official_scenes_come_first_and_others_in_natural_order(tmp_path: Path) -> None:
    for scene in ("living10", "office1", "living2", "room2", "room0"):
        write_render(tmp_path, scene, 1)
    (tmp_path / "Replica" / ".living3.partial" / "results").mkdir(parents=True)
    assert Replica(tmp_path).scenes() == ("room0", "room2", "office1", "living2", "living10")


@pytest.mark.parametrize(
    ("scene", "name"),
    [("room0", "room_0"), ("office4", "office_4"), ("living12", "living_12"), ("frl_apartment_0", "frl_apartment_0")],
)
def test_scene_names_of_the_two_trees_pair_up(scene: str, name: str) -> None:
    assert original_name(scene) == name


def test_vertices_take_the_object_of_most_of_their_faces_and_the_lowest_id_on_ties(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_original(tmp_path, QUADS, [0, 5, 5, 5], TWO_OBJECTS)
    truth = Replica(tmp_path).ground_truth("room0", "mesh-vertices")
    # vertex 1 and 3 have one face of each object: the chair, id 0; vertex 4 has three faces of the table
    assert truth.semantic.tolist() == [CHAIR, CHAIR, TABLE, CHAIR, TABLE, TABLE, TABLE, TABLE, TABLE]
    assert truth.instance.tolist() == [1, 1, 6, 1, 6, 6, 6, 6, 6]
    assert truth.labels.name_of(CHAIR) == "chair"
    assert truth.points[5].tolist() == [2, 1, 0]


def test_a_vertex_without_faces_is_void_and_a_face_that_names_a_vertex_twice_counts_once() -> None:
    corners = ListColumn(np.array([0, 4, 7, 10]), np.array([0, 0, 0, 1, 0, 1, 2, 0, 2, 1]))
    face = object_of_vertex(4, corners, np.array([3, 9, 9]))
    assert np.array([3, 9, 9])[face[:3]].tolist() == [9, 9, 9]
    assert face[3] == -1


def test_face_corners_repeat_each_vertex_in_the_order_of_the_faces(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_original(tmp_path, [[0, 1, 4, 3], [1, 2, 4]], [5, 0], TWO_OBJECTS)
    truth = Replica(tmp_path).ground_truth("room0", "face-corners")
    assert truth.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]]
    assert truth.semantic.tolist() == [TABLE] * 4 + [CHAIR] * 3
    assert truth.instance.tolist() == [6] * 4 + [1] * 3


def test_polygons_become_fans_of_triangles(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_original(tmp_path, [[0, 1, 4, 3], [1, 2, 4], [4, 5, 8, 7, 6]], [5, 0, 5], TWO_OBJECTS)
    mesh = Replica(tmp_path).instance_mesh("room0")
    assert mesh.triangles.tolist() == [[0, 1, 4], [0, 4, 3], [1, 2, 4], [4, 5, 8], [4, 8, 7], [4, 7, 6]]
    assert mesh.instance_of_triangle.tolist() == [6, 6, 1, 6, 6, 6]
    assert mesh.class_of_instance == {1: CHAIR, 6: TABLE}


def test_objects_without_entry_are_void_counted_and_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_render(tmp_path)
    write_original(tmp_path, QUADS, [0, 7, 7, 300], TWO_OBJECTS)
    replica = Replica(tmp_path)
    with caplog.at_level(logging.WARNING):
        truth = replica.ground_truth("room0", "face-corners")
        replica.instance_mesh("room0")
    assert truth.semantic.tolist() == [CHAIR] * 4 + [0] * 12
    assert truth.instance.tolist() == [1] * 4 + [0] * 12
    assert [record.getMessage() for record in caplog.records] == [
        "replica/room0: object ids without entry in habitat/info_semantic.json: 2 (the first: 7); faces made void: 3"
    ]


def test_a_scene_without_original_has_frames_and_no_truth(tmp_path: Path) -> None:
    write_render(tmp_path)
    replica = Replica(tmp_path)
    assert len(replica.frames("room0", 1)) == 3
    with pytest.raises(GroundTruthMissing, match=r"replica/room0: no ground truth; expected room_0/habitat/mesh_sem"):
        replica.instance_mesh("room0")
    (write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS) / "info_semantic.json").unlink()
    with pytest.raises(GroundTruthMissing, match=r"info_semantic\.json is missing"):
        Replica(tmp_path).ground_truth("room0", "mesh-vertices")


def rewrite(name: str, change: Callable[[str], str]) -> Change:
    return lambda folder: (folder / name).write_text(change((folder / name).read_text()))


def replace_line(number: int, line: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        lines = text.splitlines()
        return "\n".join([*lines[: number - 1], line, *lines[number:]]) + "\n"

    return change


def camera_with(**values: object) -> Change:
    return lambda folder: (folder / "cam_params.json").write_text(json.dumps({"camera": CAMERA | values}))


def image(name: str, array: np.ndarray) -> Change:
    return lambda folder: cv2.imwrite(str(folder / name), array)


TRAJECTORY = "room0/traj.txt"
COLOUR, DEPTH = "room0/results/frame000001.jpg", "room0/results/depth000001.png"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / COLOUR).unlink(), "results/frame000001.jpg is missing; copy results/ again"),
        (rewrite(TRAJECTORY, replace_line(2, "nan" + IDENTITY[1:])), "traj.txt line 2: the pose holds 'nan'; mend"),
        (image(COLOUR, np.ones((8, 11, 3), np.uint8)), "frame000001.jpg is 11x8, the camera file says 12x8"),
        (camera_with(fy="600"), "cam_params.json: camera.fy: Input should be a valid number; found '600'"),
    ],
)
def test_each_fault_of_the_input_is_one_clear_line(tmp_path: Path, change: Change, message: str) -> None:
    line = first_line_of(change, tmp_path)
    assert line.startswith("replica/room0: ")
    assert message in line


def write_info(content: object) -> Change:
    text = content if isinstance(content, str) else json.dumps(content)
    return lambda habitat: (habitat / "info_semantic.json").write_text(text)


def write_mesh(**columns: np.ndarray | ListColumn | None) -> Change:
    def change(habitat: Path) -> None:
        points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
        vertex = {axis: points[:, i].copy() for i, axis in enumerate("xyz")}
        triangle = ListColumn(np.array([0, 3]), np.array([0, 1, 2], np.int32))
        face = {"vertex_indices": triangle, "object_id": np.zeros(1, np.uint16)}
        for name, column in columns.items():
            table: dict[str, Any] = vertex if name in vertex else face
            table.pop(name) if column is None else table.update({name: column})
        write_ply(
            habitat / "mesh_semantic.ply",
            [PlyElement("vertex", 3, vertex), PlyElement("face", 1, face)],  # type: ignore[arg-type]
        )

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (write_info("{"), "info_semantic.json: not JSON"),
        (write_info(info_table([(4, 20), (4, 21)])), "object 4 stands there twice, as class 20 and as class 21"),
        (write_mesh(object_id=None), "mesh_semantic.ply: faces have no 'object_id'; a program that drops it"),
        (
            write_mesh(vertex_indices=ListColumn(np.array([0, 3]), np.array([0, 1, 3], np.int32))),
            "mesh_semantic.ply: face 0 names vertex 3, the mesh has 3 (0..2)",
        ),
    ],
)
def test_each_fault_of_the_truth_is_one_clear_line(tmp_path: Path, change: Change, message: str) -> None:
    write_render(tmp_path)
    change(write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS))
    with pytest.raises(DataError) as caught:
        Replica(tmp_path).ground_truth("room0", "mesh-vertices")
    assert str(caught.value).startswith("replica/room0: habitat/")
    assert "\n" not in str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        rewrite("Replica/room0/traj.txt", replace_line(2, IDENTITY)),
        rewrite("replica_v1/room_0/habitat/info_semantic.json", lambda text: text.replace("80", "81")),
        image("Replica/room0/results/depth000001.png", np.ones((HEIGHT, WIDTH), np.uint16)),
        lambda root: (root / "Replica/room0/results/depth000002.png").unlink(),
    ],
)
def test_the_digest_moves_with_every_file(tmp_path: Path, change: Change) -> None:
    write_render(tmp_path)
    write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    before = Replica(tmp_path).digest("room0")
    assert Replica(tmp_path).digest("room0") == before
    change(tmp_path)
    assert Replica(tmp_path).digest("room0") != before


def test_scenes_of_the_marker_are_rendered_rooms_and_others_camera_images(tmp_path: Path) -> None:
    write_render(tmp_path, "living0")
    write_render(tmp_path, "room0")
    (tmp_path / "Replica" / "rooms.json").write_text(json.dumps({"scenes": {"living0": "key"}}))
    replica = Replica(tmp_path)
    assert replica.info("living0", 1).image_domain == "rendered-rooms"
    assert replica.info("room0", 1).image_domain == "camera"
    (tmp_path / "Replica" / "rooms.json").write_text("{}")
    with pytest.raises(DataError, match=r"rooms\.json: not the marker"):
        replica.info("room0", 1)


@pytest.mark.parametrize("position", [20, 45, 60])
def test_a_flipped_bit_in_a_depth_image_does_not_become_depth(tmp_path: Path, position: int) -> None:
    write_render(tmp_path)
    path = tmp_path / "Replica" / DEPTH
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(DataError, match=r"depth000001\.png: not a readable PNG image"):
        Replica(tmp_path).frames("room0", 1)[1]
