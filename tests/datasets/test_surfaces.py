"""The unlabelled mesh of each dataset, and the keys that depend on its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_files import grid, write_mesh
from replica_scene import QUADS, TWO_OBJECTS, write_original, write_render
from rgbd_scene import write_scene
from scannet_scan import SCAN, dataset, write_recording
from scannet_scan import write_truth as write_scan_truth

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.rgbd.dataset import Rgbd
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    return Rooms(tmp_path_factory.mktemp("data"), RoomOptions(width=32, height=24, n_frames=2, mesh_spacing_m=0.2))


def test_room_surface_is_its_scan_in_triangles_with_ground_truth_vertices(rooms: Rooms) -> None:
    surface, truth = rooms.surface("bathroom0"), rooms.ground_truth("bathroom0", "mesh-vertices")
    assert np.array_equal(surface.vertices, truth.points) and surface.segments is None
    faces = rooms.scan("bathroom0").faces
    assert surface.triangles.dtype == np.int32 and len(surface.triangles) == 2 * len(faces)
    assert surface.triangles[:2].tolist() == [faces[0, [0, 1, 2]].tolist(), faces[0, [0, 2, 3]].tolist()]
    assert (truth.instance[surface.triangles] == truth.instance[surface.triangles[:, :1]]).all()


def test_replica_surface_is_the_render_mesh_in_fans_without_labels(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    dataset = Replica(tmp_path)
    with pytest.raises(DataError, match=r"replica/room0: no mesh; room0_mesh\.ply is missing in .*Replica$"):
        dataset.surface("room0")
    original = tmp_path / "replica_v1/room_0/habitat/mesh_semantic.ply"
    (tmp_path / "Replica/room0_mesh.ply").write_bytes(original.read_bytes())
    surface = dataset.surface("room0")
    assert surface.vertices.shape == (9, 3) and surface.segments is None
    assert surface.triangles[:4].tolist() == [[0, 1, 4], [0, 4, 3], [3, 4, 7], [3, 7, 6]]
    assert tmp_path / "Replica" / "room0_mesh.ply" in dataset.files("room0")


def write_scan(root: Path, segments: list[int]) -> Path:
    folder = root / "scans" / SCAN
    folder.mkdir(parents=True)
    write_recording(folder / f"{SCAN}.sens", 2)
    write_scan_truth(folder, segments, [(0, "chair", [7])], [5] * 24)
    return folder


def test_scannet_surface_has_the_published_segments(tmp_path: Path) -> None:
    write_scan(tmp_path, [7] * 10 + [4_000_000_000] * 14)
    surface = dataset(tmp_path).surface(SCAN)
    assert np.array_equal(surface.vertices, grid()[0]) and np.array_equal(surface.triangles, grid()[1])
    assert surface.segments is not None and surface.segments.tolist() == [0] * 10 + [1] * 14


def test_scan_without_annotation_has_a_surface_even_without_segments(tmp_path: Path) -> None:
    folder = write_scan(tmp_path, [7] * 24)
    scans = dataset(tmp_path)
    before = scans.digest(SCAN)
    (folder / f"{SCAN}.aggregation.json").unlink()
    (folder / f"{SCAN}_vh_clean_2.labels.ply").unlink()
    assert scans.surface(SCAN).segments is not None
    (folder / f"{SCAN}_vh_clean_2.0.010000.segs.json").unlink()
    assert scans.surface(SCAN).segments is None
    assert scans.digest(SCAN) != before
    (folder / f"{SCAN}_vh_clean_2.ply").unlink()
    with pytest.raises(DataError, match=rf"scannet/{SCAN}: no mesh; {SCAN}_vh_clean_2\.ply is missing, copy it into"):
        scans.surface(SCAN)


def test_described_folder_may_have_a_mesh(tmp_path: Path) -> None:
    folder = write_scene(tmp_path)
    with pytest.raises(DataError, match=r'rgbd\.toml has no mesh; add one in the world of the poses: mesh = "mesh'):
        Rgbd(tmp_path).surface(folder.name)
    write_scene(tmp_path / "with", mesh="mesh.ply")
    data = tmp_path / "with" / "rgbd" / folder.name / "data"
    write_mesh(data / "mesh.ply", *grid(3, 2))
    assert Rgbd(tmp_path / "with").surface(folder.name).triangles.tolist() == grid(3, 2)[1].tolist()
    before = Rgbd(tmp_path / "with").digest(folder.name)
    write_mesh(data / "mesh.ply", *grid(3, 3))
    assert Rgbd(tmp_path / "with").digest(folder.name) != before
