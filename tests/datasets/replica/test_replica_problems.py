"""The boxes of Replica's objects, and every fault of a scene, one line each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from replica_scene import QUADS, TWO_OBJECTS, box, info_table, write_original, write_render

from su3d_bench.datasets.replica.dataset import Replica


def write_boxes(root: Path, boxes: dict[int, Any], *, mesh: bool = True) -> Path:
    habitat = write_original(root, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    table = info_table(TWO_OBJECTS)
    for row in table["objects"]:
        if row["id"] in boxes:
            row["oriented_bbox"] = boxes[row["id"]]
    (habitat / "info_semantic.json").write_text(json.dumps(table))
    if not mesh:
        (habitat / "mesh_semantic.ply").unlink()
    return habitat


def test_box_is_rotated_then_translated_without_the_mesh(tmp_path: Path) -> None:
    write_render(tmp_path)
    half = 0.5**0.5  # a quarter turn about z: x becomes y
    write_boxes(tmp_path, {5: box((1, 2, 3), (4, 2, 1), (0, 0, half, half), (10, 20, 30))}, mesh=False)
    replica = Replica(tmp_path)
    boxes = replica.object_boxes("room0")
    assert list(boxes) == [5]
    np.testing.assert_allclose(boxes[5].centre, [8, 21, 33])
    np.testing.assert_allclose(boxes[5].rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    corners = boxes[5].corners
    assert corners.shape == (8, 3)
    np.testing.assert_allclose(corners.min(axis=0), [7, 19, 32.5])
    np.testing.assert_allclose(corners.max(axis=0), [9, 23, 33.5])
    outside = boxes[5].distance_outside(np.array([[8, 21, 33], [9, 23, 33.5], [9.5, 23.25, 33]]))
    np.testing.assert_allclose(outside, [0, 0, 0.5], atol=1e-12)
    assert replica.status("room0").startswith("3 frames, 1 boxes of objects, no mesh (")


# --- faults of a scene


FITTING = {0: box((0.5, 1, 0), (1, 2, 0)), 5: box((1.5, 1, 0), (1, 2, 0))}


def test_face_centres_over_5_cm_outside_a_box_are_named(tmp_path: Path) -> None:
    write_render(tmp_path)
    # face centres of object 0 are at y = 0.5 and 1.5; the box ends at 1.46 and at 1.44
    write_boxes(tmp_path, FITTING | {0: box((0.5, 0.96, 0), (1, 1, 0))})
    assert list(Replica(tmp_path).problems("room0")) == []
    info = tmp_path / "replica_v1/room_0/habitat/info_semantic.json"
    info.write_text(info.read_text().replace("0.96", "0.44"))
    assert list(Replica(tmp_path).problems("room0")) == [
        "replica/room0: habitat/info_semantic.json: object 0 has faces 0.51 m beyond its box and the slack of 0.05 m; "
        "the boxes belong to another mesh"
    ]


def test_each_problem_of_a_scene_is_one_line(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_boxes(tmp_path, FITTING)
    path = tmp_path / "Replica/room0/traj.txt"
    path.write_text("\n".join(["nan " * 16, *path.read_text().splitlines()[1:], "1 2 3"]) + "\n")
    (tmp_path / "replica_v1/room_0/habitat/info_semantic.json").unlink()
    found = list(Replica(tmp_path).problems("room0"))
    messages = "line 1: the pose has 'nan'", "line 4 has 3 values", "has 4 poses but", "info_semantic.json is missing"
    for message, line in zip(messages, found, strict=True):
        assert message in line and line.startswith("replica/room0: ")
