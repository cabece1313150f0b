"""A room in each layout, read through the dataset of that layout: the same frames, the same ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from written_scenes import write_scene

from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Frame
from su3d_bench.datasets.homes.dataset import DEFAULT_SCENES
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.rooms.classes import CLASSES
from su3d_bench.datasets.rooms.dataset import SCENES, Rooms
from su3d_bench.datasets.scannet.writing import categories, scan_name, segment_of_vertex

ROOM, SCAN, N_FRAMES = "bathroom0", "scene9400_00", 6
ADDRESS = {"replica": ROOM, "scannet": SCAN}
UNITS_PER_METRE = {"replica": 6553.5, "scannet": 1000.0}


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    options = Rooms.Options(width=80, height=60, n_frames=N_FRAMES, mesh_spacing_m=0.06)
    return Rooms(tmp_path_factory.mktemp("cache"), options)


@pytest.fixture(scope="module")
def made(rooms: Rooms, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every layout with the room in it, by name."""
    folder = tmp_path_factory.mktemp("made")
    for name, layout in LAYOUTS.items():
        write_scene(layout, rooms, ROOM, folder / name)
    return {name: folder / name for name in LAYOUTS}


def reader(made: dict[str, Path], name: str) -> Any:
    dataset_class = registry.load("dataset", LAYOUTS[name].reader)
    return dataset_class(made[name], dataset_class.Options())


def frames(made: dict[str, Path], name: str) -> list[Frame]:
    return list(reader(made, name).frames(ADDRESS[name], 1))


@pytest.mark.parametrize("name", LAYOUTS)
def test_dataset_finds_the_room_and_marks_it_as_rendered(made: dict[str, Path], name: str) -> None:
    dataset = reader(made, name)
    assert list(dataset.scenes()) == [ADDRESS[name]]
    info = dataset.info(ADDRESS[name], 1)
    assert (info.n_frames, info.image_domain) == (N_FRAMES, "rendered-rooms")


@pytest.mark.parametrize(("name", "tolerance"), [("replica", 0.0), ("scannet", 5e-7)])
def test_frames_match_the_room_within_format_precision(
    made: dict[str, Path], rooms: Rooms, name: str, tolerance: float
) -> None:
    units = UNITS_PER_METRE[name]
    for ours, theirs in zip(rooms.frames(ROOM, 1), frames(made, name), strict=True):
        assert ours.index == theirs.index and abs(ours.timestamp_s - theirs.timestamp_s) < 1e-6
        np.testing.assert_allclose(theirs.camera_to_world, ours.camera_to_world, rtol=0, atol=tolerance)
        np.testing.assert_allclose(theirs.intrinsics, ours.intrinsics, rtol=1e-5)
        expected = np.rint(ours.depth_m.astype(np.float64) * units)
        np.testing.assert_array_equal(np.rint(theirs.depth_m.astype(np.float64) * units), expected)
        np.testing.assert_allclose(theirs.depth_m, expected / units, rtol=1e-6)
        assert np.abs(ours.rgb.astype(int) - theirs.rgb).mean() < 6


@pytest.mark.parametrize("variant", ["mesh-vertices", "face-corners"])
def test_replica_layout_has_the_ground_truth_of_the_room(made: dict[str, Path], rooms: Rooms, variant: str) -> None:
    ours, theirs = rooms.ground_truth(ROOM, variant), reader(made, "replica").ground_truth(ROOM, variant)
    np.testing.assert_array_equal(ours.points, theirs.points)
    np.testing.assert_array_equal(ours.semantic, theirs.semantic)
    np.testing.assert_array_equal(ours.instance + (ours.instance > 0), theirs.instance)


@pytest.mark.parametrize("variant", ["nyu40-vertices", "scannet200-vertices"])
def test_scannet_layout_has_the_ground_truth_of_the_room_in_scannet_classes(
    made: dict[str, Path], rooms: Rooms, variant: str
) -> None:
    ours, theirs = rooms.ground_truth(ROOM, "mesh-vertices"), reader(made, "scannet").ground_truth(SCAN, variant)
    by_class = {c.id: categories()[c.name] for c in CLASSES}
    class_of = {i: one.nyu40id if variant == "nyu40-vertices" else one.id for i, one in by_class.items()}
    np.testing.assert_array_equal(theirs.points, ours.points)
    np.testing.assert_array_equal(theirs.instance, ours.instance)
    assert theirs.semantic.tolist() == [class_of[i] for i in ours.semantic.tolist()]
    assert len(set(theirs.semantic.tolist())) > 8


def test_segments_split_objects_and_never_cross_them(made: dict[str, Path], rooms: Rooms) -> None:
    scan = rooms.scan(ROOM)
    segments, owner = segment_of_vertex(scan), scan.object_of_vertex()
    path = made["scannet"] / "scans" / SCAN / f"{SCAN}_vh_clean_2.0.010000.segs.json"
    assert json.loads(path.read_text())["segIndices"] == segments.tolist()
    assert all(len(set(owner[segments == one].tolist())) == 1 for one in np.unique(segments))
    assert np.median([len(np.unique(segments[owner == one])) for one in np.unique(owner)]) >= 3


def test_every_room_and_home_has_a_unique_scan_name_outside_scannets() -> None:
    names = [scan_name(scene) for scene in (*SCENES, *DEFAULT_SCENES)]
    assert len(set(names)) == len(names) and min(names) > "scene0806_00"
    with pytest.raises(DataError, match=r"^seed100: "):
        scan_name("seed100")


@pytest.mark.parametrize("name", LAYOUTS)
def test_command_makes_each_layout_and_repeating_it_does_nothing(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "cache"))
    small = ["n_frames=2", "width=32", "height=24", "mesh_spacing_m=0.15"]
    words = ["datasets", "make", "rooms", "--scenes", ROOM, "--set", *small, "--layout", name, "--jobs", "1"]
    words += ["--out", str(tmp_path / "made")]
    assert main(words) == 0
    address = f"{LAYOUTS[name].reader}/{ADDRESS[name]}"
    assert capsys.readouterr().out.split() == [ROOM, "generated", address]
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == [
        {"scene": ROOM, "status": "already present", "address": address}
    ]
    assert main([*words, "--set", "n_frames=3"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
