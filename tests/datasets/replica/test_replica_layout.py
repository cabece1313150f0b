"""Writing the Replica layout: what is read back is what was written, and no half scene ever looks whole."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from scanned_stage import CHAIR, N_FRAMES, WALL, Stage, Surface, files_below
from scanned_stage import write_scene as write_scene_in

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.datasets.openlex3d.labels import LEVELS
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.replica.mesh_truth import INFO_NAME, MESH_NAME
from su3d_bench.datasets.replica.writing import DEPTH_SCALE, ReplicaLayout
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.datasets.writing import ScannedDataset, finish_scene, plan_scenes, write_frames
from su3d_bench.formats.ply import ListColumn, read_ply

LAYOUT = ReplicaLayout()


def write_scene(dataset: ScannedDataset, scene: str, out: Path) -> None:
    write_scene_in(LAYOUT, dataset, scene, out)


def test_the_tree_is_that_of_replica_and_nothing_else(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    images = {
        f"Replica/room7/results/{kind}" for i in range(N_FRAMES) for kind in (f"frame{i:06d}.jpg", f"depth{i:06d}.png")
    }
    assert files_below(tmp_path) == images | {
        "Replica/cam_params.json",
        "Replica/rooms.json",
        "Replica/room7_mesh.ply",
        "Replica/room7/traj.txt",
        f"replica_v1/room_7/{MESH_NAME}",
        f"replica_v1/room_7/{INFO_NAME}",
        *(f"ReplicaSSG/{name}" for name in ("objects.json", "relationships.json", "replica_to_visual_genome.json")),
        "gt_openlex3d/replica/prompt_list.txt",
        "gt_openlex3d/replica/room7/gt_categories.json",
        "gt_openlex3d/replica/room7/gt_visible_cloud.pcd",
        *(f"gt_openlex3d/replica/room7/gt_categories_query_to_object_mapping_{level}.json" for level in LEVELS),
    }
    assert Replica(tmp_path).scenes() == ("room7",)


def test_a_folder_of_somebody_else_in_the_place_of_the_truth_is_refused_and_left_alone(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path / "made")
    theirs = next((tmp_path / "made").rglob(MESH_NAME)).relative_to(tmp_path / "made")
    place = tmp_path / "out" / theirs
    place.parent.mkdir(parents=True)
    place.write_bytes(b"theirs")
    with pytest.raises(StoreError, match="is there already and was made elsewhere; choose another folder with --out"):
        write_scene(Stage(), "room7", tmp_path / "out")
    assert place.read_bytes() == b"theirs"


def test_frames_come_back_with_equal_poses_depth_within_half_a_step_and_near_colours(tmp_path: Path) -> None:
    stage = Stage()
    write_scene(stage, "room7", tmp_path)
    for ours, theirs in zip(stage.frames("room7", 1), Replica(tmp_path).frames("room7", 1), strict=True):
        assert (ours.index, ours.timestamp_s) == (theirs.index, theirs.timestamp_s)
        np.testing.assert_array_equal(ours.camera_to_world, theirs.camera_to_world)
        np.testing.assert_array_equal(ours.intrinsics, theirs.intrinsics)
        is_held = ours.depth_m <= 65535 / DEPTH_SCALE
        step = 1 / DEPTH_SCALE
        assert np.abs(ours.depth_m.astype(np.float64) - theirs.depth_m)[is_held].max() <= 0.5 * step + 1e-6
        assert not theirs.depth_m[~is_held].any()  # beyond 10 m there is no reading
        assert theirs.depth_m[0, 0] == 0
        assert np.abs(ours.rgb.astype(int) - theirs.rgb).max() < 12


def test_truth_comes_back_equal(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    truth = Replica(tmp_path).ground_truth("room7", "face-corners")
    surface = Surface()
    np.testing.assert_array_equal(truth.points, surface.vertices[surface.faces.reshape(-1)])
    assert truth.semantic.tolist() == [WALL] * 8 + [CHAIR] * 4
    assert truth.instance.tolist() == [2] * 8 + [5] * 4
    mesh = Replica(tmp_path).instance_mesh("room7")
    assert mesh.triangles.tolist()[:2] == [[0, 1, 5], [0, 5, 4]]
    assert mesh.class_of_instance == {2: WALL, 5: CHAIR}


def test_the_annotated_mesh_has_the_types_of_the_release(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    header = (tmp_path / "replica_v1/room_7" / MESH_NAME).read_bytes().partition(b"end_header")[0].decode()
    assert header.splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 8",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "element face 3",
        "property list uchar int vertex_indices",
        "property ushort object_id",
    ]
    face = read_ply(tmp_path / "Replica/room7_mesh.ply").element("face")
    assert face is not None
    corners = face.columns["vertex_indices"]
    assert isinstance(corners, ListColumn) and set(corners.lengths.tolist()) == {3} and face.n_rows == 6


def test_the_table_of_objects_passes_the_checks_known_of_the_release(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    info = json.loads((tmp_path / "replica_v1/room_7" / INFO_NAME).read_text())
    assert [row["id"] for row in info["classes"]] == list(range(1, 102))
    assert info["id_to_label"] == [-1, WALL, -1, -1, CHAIR]
    assert info["gravity_dir"] == [0, 0, -1]
    surface = Surface()
    centres = surface.vertices[surface.faces].mean(axis=1)
    boxes = {row["id"]: row["oriented_bbox"] for row in info["objects"]}
    for centre, one in zip(centres, surface.object_id.tolist(), strict=True):
        box = boxes[one]["abb"]  # every face centre lies in the box of its object, with 5 cm to spare
        assert (np.abs(centre - box["center"]) <= np.array(box["sizes"]) / 2 + 0.05).all()
        assert boxes[one]["orientation"] == {"rotation": [0, 0, 0, 1], "translation": [0, 0, 0]}


@pytest.mark.parametrize("dies_at", range(N_FRAMES))
def test_a_killed_make_leaves_no_scene_and_the_next_takes_up_its_frames(tmp_path: Path, dies_at: int) -> None:
    stage = Stage(dies_at=dies_at)
    with pytest.raises(KeyboardInterrupt):
        write_scene(stage, "room7", tmp_path)
    assert not (tmp_path / "Replica/room7").exists()
    with pytest.raises(DataError, match="no scene in"):
        Replica(tmp_path).scenes()
    stray = next(iter((tmp_path / "Replica").glob(".room7.*.partial/results")), None)
    if stray is not None:
        (stray / ".frame000004.jpg.0123456789ab.unfinished").write_bytes(b"half")
    again = Stage()
    write_scene(again, "room7", tmp_path)
    assert sorted(set(again.rendered) - {0}) == list(range(max(dies_at, 1), N_FRAMES))
    write_scene(Stage(), "room7", tmp_path / "undisturbed")
    assert files_below(tmp_path / "undisturbed") <= files_below(tmp_path)
    for name in files_below(tmp_path / "undisturbed"):
        assert (tmp_path / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes(), name
    assert not list((tmp_path / "Replica").rglob(".*"))


@pytest.mark.parametrize("n_moves", [0, 1, 2])
def test_a_make_killed_between_two_moves_is_finished_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_moves: int
) -> None:
    moved: list[Path] = []
    replace = os.replace

    def dying_replace(source: Path, target: Path) -> None:
        if not Path(source).name.endswith(".unfinished"):
            if len(moved) == n_moves:
                raise KeyboardInterrupt
            moved.append(target)
        replace(source, target)

    monkeypatch.setattr(os, "replace", dying_replace)
    with pytest.raises(KeyboardInterrupt):
        write_scene(Stage(), "room7", tmp_path)
    monkeypatch.undo()
    with pytest.raises(DataError, match="no scene in" if n_moves == 0 else "room7: no frames"):
        Replica(tmp_path).frames("room7", 1)
    again = Stage()
    write_scene(again, "room7", tmp_path)
    assert set(again.rendered) <= {0}
    assert len(Replica(tmp_path).frames("room7", 1)) == N_FRAMES
    assert len(Replica(tmp_path).ground_truth("room7", "mesh-vertices").points) == 8


def test_a_whole_scene_is_left_alone(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in files_below(tmp_path)}
    stage = Stage(dies_at=0)
    write_scene(stage, "room7", tmp_path)
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in files_below(tmp_path)} == before


def test_lost_truth_is_made_again_without_the_frames(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    (tmp_path / "replica_v1/room_7" / MESH_NAME).unlink()
    stage = Stage()
    write_scene(stage, "room7", tmp_path)
    assert set(stage.rendered) <= {0}
    assert len(Replica(tmp_path).ground_truth("room7", "mesh-vertices").points) == 8
    assert not list((tmp_path / "Replica").rglob(".*"))


def test_frames_of_another_making_are_not_taken_over(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_scene(Stage(dies_at=3), "room7", tmp_path)
    other = Stage(kind="other")
    write_scene(other, "room7", tmp_path)
    assert set(other.rendered) == set(range(N_FRAMES))
    assert not list((tmp_path / "Replica").rglob(".*"))


def test_a_scene_from_elsewhere_is_never_overwritten(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    with pytest.raises(StoreError, match="room7: holds another 'room7', made elsewhere or with other options; delete"):
        write_scene(Stage(kind="other"), "room7", tmp_path)
    (tmp_path / "Replica/room0").mkdir()
    with pytest.raises(StoreError, match="holds another 'room0'"):
        write_scene(Stage(), "room0", tmp_path)


def test_another_camera_in_one_folder_is_refused(tmp_path: Path) -> None:
    write_scene(Stage(), "room7", tmp_path)
    with pytest.raises(StoreError, match=r"cam_params\.json: is another camera than that of stage \(20x12\)"):
        write_scene(Stage(width=20), "room8", tmp_path)


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    targets = plan_scenes(LAYOUT, Stage(), ["room7"], tmp_path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match=r"cannot write .*frame000000\.jpg: the disk is full; free some space"):
        write_frames(LAYOUT, Stage(), targets[0], range(N_FRAMES))
    assert not [name for name in files_below(tmp_path) if name.endswith(".unfinished")]


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"cannot write .*: a file stands where a folder should be"):
        write_scene(Stage(), "room7", tmp_path / "file")


def test_a_move_that_fails_is_one_line(tmp_path: Path) -> None:
    target = plan_scenes(LAYOUT, Stage(), ["room7"], tmp_path)[0]
    with pytest.raises(StoreError, match=r"cannot write .*room7: No such file"):
        finish_scene(LAYOUT, Stage(), target)


def test_object_ids_beyond_sixteen_bits_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage()
    monkeypatch.setattr(stage, "scan", lambda scene: Surface(object_id=np.array([1, 1, 70_000], np.int32)))
    with pytest.raises(DataError, match="object ids go to 70000; the layout has 16 bits"):
        write_scene(stage, "room7", tmp_path)


def test_a_room_read_back_from_the_layout_is_the_room(tmp_path: Path) -> None:
    rooms = Rooms(tmp_path / "cache", Rooms.Options(width=64, height=48, n_frames=3, mesh_spacing_m=0.1))
    write_scene(rooms, "bathroom0", tmp_path / "out")
    replica = Replica(tmp_path / "out")
    assert replica.info("bathroom0", 1).image_domain == "rendered-rooms"
    for ours, theirs in zip(rooms.frames("bathroom0", 1), replica.frames("bathroom0", 1), strict=True):
        np.testing.assert_array_equal(ours.camera_to_world, theirs.camera_to_world)
        np.testing.assert_array_equal(ours.intrinsics, theirs.intrinsics)
        assert np.abs(ours.depth_m.astype(np.float64) - theirs.depth_m).max() <= 0.5 / DEPTH_SCALE + 1e-6
        assert np.abs(ours.rgb.astype(int) - theirs.rgb).mean() < 6
    for variant in rooms.variants:
        ours_truth, theirs_truth = rooms.ground_truth("bathroom0", variant), replica.ground_truth("bathroom0", variant)
        np.testing.assert_array_equal(ours_truth.points, theirs_truth.points)
        np.testing.assert_array_equal(ours_truth.semantic, theirs_truth.semantic)
        np.testing.assert_array_equal(ours_truth.instance + (ours_truth.instance > 0), theirs_truth.instance)
