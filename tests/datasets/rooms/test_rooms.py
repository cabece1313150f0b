"""The built-in rooms as a dataset: determinism, agreement of images, scan and mesh, cache, options, noise."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import back_project
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Frame
from su3d_bench.datasets.openscan import label_set
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh
from su3d_bench.datasets.procedural.scan import SceneScan
from su3d_bench.datasets.procedural.truth import attribute_of_object
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

SMALL = Rooms.Options(width=96, height=72, n_frames=80, mesh_spacing_m=0.03)
SCENE = "bathroom7"


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    return Rooms(tmp_path_factory.mktemp("data"), SMALL)


def _same(first: SceneScan, second: SceneScan) -> bool:
    return all(
        getattr(first, field.name).tobytes() == getattr(second, field.name).tobytes() for field in fields(SceneScan)
    )


def test_same_name_gives_the_same_bytes(rooms: Rooms, tmp_path: Path) -> None:
    again = Rooms(tmp_path, SMALL)
    assert again.truth(SCENE) == rooms.truth(SCENE)
    assert again.trajectory(SCENE).tobytes() == rooms.trajectory(SCENE).tobytes()
    for index in (0, 33):
        first, second = rooms.render(SCENE, index), again.render(SCENE, index)
        assert first.rgb.tobytes() == second.rgb.tobytes()
        assert first.depth_m.tobytes() == second.depth_m.tobytes()
    assert _same(rooms.scan(SCENE), again.scan(SCENE))


def test_frames_are_rendered_once_and_kept_for_the_next_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rooms, rendered = Rooms(tmp_path, SMALL), list[int]()
    render = rooms.frame

    def counted(scene: str, index: int) -> Frame:
        rendered.append(index)
        return render(scene, index)

    monkeypatch.setattr(rooms, "frame", counted)
    first, again = ([rooms.frames(SCENE, 1)[k] for k in range(70)] for _ in range(2))
    assert rendered == [*range(70), *range(64, 70)]  # 64 of a scene are kept
    for one, other in zip(first, again, strict=True):
        assert one.rgb.tobytes() == other.rgb.tobytes()
        assert one.depth_m.tobytes() == other.depth_m.tobytes()
        assert one.camera_to_world.tobytes() == other.camera_to_world.tobytes()
        assert (one.index, one.timestamp_s) == (other.index, other.timestamp_s)
    rooms.frames("living0", 1)
    assert rooms.frames(SCENE, 1)[0].rgb.tobytes() == first[0].rgb.tobytes()
    assert rendered[-1] == 0


@pytest.mark.parametrize("name", ["kitchn0", "living2", "../scenes/living0"])
def test_other_scene_name_is_rejected_with_the_rooms_there_are(rooms: Rooms, name: str) -> None:
    with pytest.raises(DataError, match=r"no scene .*living0, .*bathroom7; .*homes/seed0"):
        rooms.frames(name, 40)


def test_depth_matches_the_scan(rooms: Rooms) -> None:
    tree = cKDTree(rooms.scan(SCENE).vertices)
    for frame in (rooms.frames(SCENE, 1)[k] for k in (0, 17, 60)):
        points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, frame.depth_m > 0)
        distance = tree.query(points)[0]
        assert np.median(distance) < 0.5 * SMALL.mesh_spacing_m
        assert np.percentile(distance, 98) < 0.02 + 0.71 * SMALL.mesh_spacing_m


def test_instance_images_match_the_instance_mesh(rooms: Rooms) -> None:
    import open3d as o3d

    mesh, image = rooms.instance_mesh(SCENE), rooms.render(SCENE, 25)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    world_to_camera = np.linalg.inv(rooms.trajectory(SCENE)[25])
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        # Open3D casts rays through pixel centres at +0.5
        rooms.intrinsics + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]),
        world_to_camera,
        SMALL.width,
        SMALL.height,
    )
    answer = scene.cast_rays(rays)
    found = mesh.instance_of_triangle[answer["primitive_ids"].numpy()]
    assert (found == image.instance).mean() > 0.995  # a ray on an edge may round either way
    assert np.median(np.abs(answer["t_hit"].numpy() - image.depth_m)) < 1e-5


@pytest.mark.proof
def test_every_object_is_visible_and_counts_at_default_scan_density(tmp_path: Path) -> None:
    dense = Rooms(tmp_path, Rooms.Options(n_frames=400))
    seen = np.bincount(dense.scan(SCENE).object_of_vertex(), minlength=len(dense.objects(SCENE)) + 1)[1:]
    assert seen.min() > 0
    assert np.mean(seen >= 100) >= 0.95


def test_scan_excludes_what_the_trajectory_cannot_see(rooms: Rooms) -> None:
    scan, mesh = rooms.scan(SCENE), rooms.instance_mesh(SCENE)
    cabinet = next(one for one in rooms.objects(SCENE) if one.class_name == "cabinet")
    underside = mesh.vertices[mesh.triangles[mesh.instance_of_triangle == cabinet.id]].reshape(-1, 3)[:, 2].min()
    assert underside < 0.01  # its feet stand on the floor
    faces = scan.vertices[scan.faces[scan.object_id == cabinet.id]].astype(np.float64)
    normals = np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    thin = int(np.argmin(np.subtract(cabinet.box_max, cabinet.box_min)[:2]))
    front, back = sorted([(normals[:, thin] > 0.9).sum(), (normals[:, thin] < -0.9).sum()], reverse=True)
    assert front > 300
    assert back < 0.05 * front  # the back faces the wall
    assert (normals[:, 2] < -0.9).sum() < 0.05 * front


def test_scan_normals_are_unit_and_face_thebuilt(rooms: Rooms) -> None:
    scan = rooms.scan(SCENE)
    assert np.allclose(np.linalg.norm(scan.normals, axis=1), 1.0, atol=1e-3)
    ceiling = scan.normals[np.unique(scan.faces[scan.object_id == 2])]
    assert (ceiling[:, 2] < -0.99).all()
    a, b, c, d = (scan.vertices[scan.faces[:, k]].astype(np.float64) for k in range(4))
    wound = (np.cross(c - a, d - b) * scan.normals[scan.faces].mean(axis=1)).sum(axis=1)
    assert (wound > 0).mean() > 0.99


def test_damaged_cache_file_is_recomputed(rooms: Rooms) -> None:
    good = rooms.scan(SCENE)
    (path,) = rooms.root.glob(f"rooms/*/{SCENE}.npz")
    content = path.read_bytes()
    middle = len(content) // 2
    path.write_bytes(content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :])
    assert _same(rooms.scan(SCENE), good)
    assert path.read_bytes() == content
    assert not list(path.parent.glob(".*"))


def test_cached_mesh_and_trajectory_equal_recomputed_ones(tmp_path: Path) -> None:
    first, second = Rooms(tmp_path, SMALL), Rooms(tmp_path, SMALL)
    nowhere = Rooms(tmp_path / "no-folder", SMALL)
    for rooms in (first, second, nowhere):
        rooms.frame(SCENE, 0)
    made, read, again = (one.built(SCENE) for one in (first, second, nowhere))
    assert "patches" not in read.__dict__, "the second room was furnished and baked although both files existed"
    for other in (read, again):
        for field in fields(SceneMesh):
            one, two = getattr(made.mesh, field.name), getattr(other.mesh, field.name)
            assert one.dtype == two.dtype and one.tobytes() == two.tobytes(), field.name
        assert made.trajectory.tobytes() == other.trajectory.tobytes()
    assert not (tmp_path / "no-folder").exists(), "reading a dataset creates no data root"


def test_image_size_and_noise_do_not_change_the_scan(rooms: Rooms) -> None:
    noisy = Rooms(rooms.root, SMALL.model_copy(update={"width": 64, "height": 48, "noise": 2}))
    rooms.scan(SCENE)
    before = sorted(rooms.root.rglob("*.npz"))
    noisy.scan(SCENE)
    assert sorted(rooms.root.rglob("*.npz")) == before


def test_noise_quantizes_depth_and_makes_holes_at_edges(rooms: Rooms) -> None:
    noisy = Rooms(rooms.root, SMALL.model_copy(update={"noise": 2}))
    clean, dirty = rooms.frame(SCENE, 10), noisy.frame(SCENE, 10)
    assert np.array_equal(dirty.depth_m, noisy.frame(SCENE, 10).depth_m)
    holes = dirty.depth_m == 0
    assert 0 < holes.mean() < 0.4
    error = np.abs(dirty.depth_m - clean.depth_m)[~holes]
    assert 0.0005 < np.median(error) < 0.02
    assert 2 < np.abs(dirty.rgb.astype(int) - clean.rgb).mean() < 8
    same_object = np.ones(holes.shape, bool)
    instance = rooms.render(SCENE, 10).instance
    for axis in (0, 1):
        for shift in (-2, -1, 1, 2):
            same_object &= instance == np.roll(instance, shift, axis)
    assert holes[same_object].mean() < 0.5 * holes[~same_object].mean()


def test_trajectory_is_smooth_and_keeps_clear(tmp_path: Path) -> None:
    full = Rooms(tmp_path, Rooms.Options(width=64, height=48))
    poses = full.trajectory("living0")
    rotations = poses[:, :3, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(rotations), 1.0)
    assert (rotations[:, 2, 1] < 0).all()  # image rows run downwards
    assert poses[:, 2, 3].min() > 1.2 and poses[:, 2, 3].max() < 1.85
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.05
    turn = np.rad2deg(np.arccos(np.clip((rotations[1:, :, 2] * rotations[:-1, :, 2]).sum(axis=1), -1, 1)))
    assert turn.max() < 6.0
    nearest = min(float(full.render("living0", k).depth_m.min()) for k in range(0, 1600, 80))
    assert nearest > 0.15


def test_room_is_scored_by_an_aspect_and_objects_without_attribute_are_void(rooms: Rooms) -> None:
    truth = rooms.ground_truth(SCENE, "openscan-type")
    of_object = attribute_of_object(rooms.objects(SCENE), "openscan-type")
    assert np.array_equal(truth.semantic, of_object[truth.instance])
    assert (truth.instance > 0).all() and not truth.semantic.all() and truth.semantic.any()
    rules = load_protocol("openscan-type")
    named = [number for number in np.unique(truth.instance) if of_object[number]]
    masks = [np.flatnonzero(truth.instance == number) for number in named]
    labels = [label_set("openscan-type").name_of(int(of_object[number])) for number in named]
    void = np.flatnonzero(truth.semantic == 0)
    right = Instances.of(truth.points, [*masks, void], labels=[*labels, labels[0]])
    wrong = Instances.of(truth.points, masks, labels=[labels[0]] * len(labels))
    found = [combine(rules, {"a": score_scene(rules, truth, one, None)}).metrics["AP50"] for one in (right, wrong)]
    assert found[0] == 1.0 and found[1] < 0.5
