"""A room in every layout, read through the adapter that reads others' data: the same frames, the same truth."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scanned_stage import write_scene

from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Frame
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.rooms.classes import CLASSES
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.datasets.scannet.recordings import open_cpp_export, open_python_export
from su3d_bench.datasets.scannet.sens.read import SensFile
from su3d_bench.datasets.scannet.writing.categories import categories, room_of, scan_name
from su3d_bench.datasets.scannet.writing.truth import segment_of_vertex
from su3d_bench.datasets.scannetpp.dataset import ScanNetPP
from su3d_bench.datasets.scannetpp.writing import categories as scannetpp_categories
from su3d_bench.datasets.scannetpp.writing.categories import benchmark_names
from su3d_bench.formats.ply import read_ply

ROOM, SCAN, N_FRAMES, SIZE = "bathroom0", "scene9400_00", 12, (80, 60)
SCANNET = ("scannet", "scannet-python", "scannet-cpp")
SCANNETPP_SCENE = "0000000400"
ADDRESS = dict.fromkeys(SCANNET, SCAN) | {"replica": ROOM, "tum": ROOM, "scannetpp": SCANNETPP_SCENE}
ADDRESS["arkitscenes"] = SCANNETPP_SCENE[2:]
ADDRESS["hm3dsem"] = "00000-bathroom000"
SAME_CAMERA = [name for name in LAYOUTS if name != "hm3dsem"]  # whose images are wider
UNITS_PER_METRE = dict.fromkeys((*SCANNET, "scannetpp", "arkitscenes"), 1000.0) | {"replica": 6553.5, "tum": 5000.0}
FRAMES_PER_SECOND = dict.fromkeys(LAYOUTS, 30) | {"scannetpp": 60}  # the iPhone's video


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    options = Rooms.Options(width=SIZE[0], height=SIZE[1], n_frames=N_FRAMES, mesh_spacing_m=0.06)
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


def scan_folder(made: dict[str, Path], name: str) -> Path:
    return made[name] / "scans" / SCAN


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_adapter_finds_the_room_and_knows_that_it_is_rendered(made: dict[str, Path], name: str) -> None:
    dataset = reader(made, name)
    assert list(dataset.scenes()) == [ADDRESS[name]]
    info = dataset.info(ADDRESS[name], 1)
    assert (info.n_frames, info.image_domain) == (N_FRAMES, "rendered-rooms")


@pytest.mark.parametrize("name", SAME_CAMERA)
def test_depth_is_that_of_the_room_rounded_to_the_unit_of_the_layout(
    made: dict[str, Path], rooms: Rooms, name: str
) -> None:
    units = UNITS_PER_METRE[name]
    for ours, theirs in zip(rooms.frames(ROOM, 1), frames(made, name), strict=True):
        expected = np.rint(ours.depth_m.astype(np.float64) * units)
        np.testing.assert_array_equal(np.rint(theirs.depth_m.astype(np.float64) * units), expected)
        np.testing.assert_allclose(theirs.depth_m, expected / units, rtol=1e-6)


def test_the_layouts_of_scannet_give_the_same_frames_to_the_last_bit(made: dict[str, Path]) -> None:
    first, *others = (frames(made, name) for name in SCANNET)
    for other in others:
        for ours, theirs in zip(first, other, strict=True):
            np.testing.assert_array_equal(ours.rgb, theirs.rgb)
            np.testing.assert_array_equal(ours.depth_m, theirs.depth_m)


def test_the_layouts_of_scannet_hold_the_same_jpeg_bytes_and_depth_values(made: dict[str, Path]) -> None:
    recording = SensFile(scan_folder(made, "scannet") / f"{SCAN}.sens", "here")
    python, cpp = (scan_folder(made, name) for name in SCANNET[1:])
    for i in range(N_FRAMES):
        jpeg, depth = recording.colour_bytes(i), recording.depth(i)
        assert jpeg == (python / f"color/{i}.jpg").read_bytes() == (cpp / f"frame-{i:06d}.color.jpg").read_bytes()
        png = cv2.imread(str(python / f"depth/{i}.png"), cv2.IMREAD_UNCHANGED)
        pgm = cv2.imread(str(cpp / f"frame-{i:06d}.depth.pgm"), cv2.IMREAD_UNCHANGED)
        assert png is not None and pgm is not None and depth.any()
        np.testing.assert_array_equal(depth, png)
        np.testing.assert_array_equal(depth, pgm)


def test_colour_is_equal_where_the_codec_loses_nothing_and_near_elsewhere(made: dict[str, Path], rooms: Rooms) -> None:
    for name in SAME_CAMERA:
        for ours, theirs in zip(rooms.frames(ROOM, 1), frames(made, name), strict=True):
            if name in {"tum", "arkitscenes"}:
                np.testing.assert_array_equal(ours.rgb, theirs.rgb)
            else:
                assert np.abs(ours.rgb.astype(int) - theirs.rgb).mean() < 6


@pytest.mark.parametrize(
    ("name", "tolerance"),
    # float32; six decimals of a float32; six digits of a value below 10; nine decimals of a quaternion
    [
        ("replica", 0.0),
        ("scannet", 5e-7),
        ("scannet-python", 1e-6),
        ("scannet-cpp", 6e-6),
        ("scannetpp", 1e-12),
        ("tum", 5e-9),
        ("arkitscenes", 1e-12),
    ],
)
def test_poses_times_and_camera_are_within_what_the_format_prints(
    made: dict[str, Path], rooms: Rooms, name: str, tolerance: float
) -> None:
    for ours, theirs in zip(rooms.frames(ROOM, 1), frames(made, name), strict=True):
        assert ours.index == theirs.index
        time_s = theirs.timestamp_s * FRAMES_PER_SECOND[name] / 30
        if name == "arkitscenes":  # times that begin at 1000 s, in milliseconds
            assert abs(ours.timestamp_s - (time_s - 1000)) < 6e-4
        else:
            assert abs(ours.timestamp_s - time_s) < 1e-6
        np.testing.assert_allclose(theirs.camera_to_world, ours.camera_to_world, rtol=0, atol=tolerance)
        np.testing.assert_allclose(theirs.intrinsics, ours.intrinsics, rtol=1e-5)


@pytest.mark.parametrize("name", SCANNET)
@pytest.mark.parametrize("variant", ["nyu40-vertices", "scannet200-vertices"])
def test_truth_of_a_scan_is_that_of_the_room_in_scannets_classes(
    made: dict[str, Path], rooms: Rooms, name: str, variant: str
) -> None:
    ours, theirs = rooms.ground_truth(ROOM, "mesh-vertices"), reader(made, name).ground_truth(SCAN, variant)
    by_class = {c.id: categories()[c.name] for c in CLASSES}
    class_of = {i: one.nyu40id if variant == "nyu40-vertices" else one.id for i, one in by_class.items()}
    np.testing.assert_array_equal(theirs.points, ours.points)
    np.testing.assert_array_equal(theirs.instance, ours.instance)
    assert theirs.semantic.tolist() == [class_of[i] for i in ours.semantic.tolist()]
    assert len(set(theirs.semantic.tolist())) > 8


def test_the_mesh_of_a_scan_has_the_triangles_of_the_room(made: dict[str, Path], rooms: Rooms) -> None:
    mesh, scan = reader(made, "scannet").instance_mesh(SCAN), rooms.scan(ROOM)
    assert mesh.triangles[:2].tolist() == [scan.faces[0, [0, 1, 2]].tolist(), scan.faces[0, [0, 2, 3]].tolist()]
    assert len(mesh.triangles) == 2 * len(scan.faces)
    np.testing.assert_array_equal(mesh.instance_of_triangle[::2], scan.object_id)


def test_segments_cut_objects_into_pieces_and_never_cross_one(made: dict[str, Path], rooms: Rooms) -> None:
    scan = rooms.scan(ROOM)
    segments, owner = segment_of_vertex(scan), scan.object_of_vertex()
    named = json.loads((scan_folder(made, "scannet") / f"{SCAN}_vh_clean_2.0.010000.segs.json").read_text())
    assert named["segIndices"] == segments.tolist()
    assert all(len(set(owner[segments == one].tolist())) == 1 for one in np.unique(segments))
    pieces = [len(np.unique(segments[owner == one])) for one in np.unique(owner)]
    assert np.median(pieces) >= 3
    floor = next(one.id for one in rooms.objects(ROOM) if one.class_name == "floor")
    sizes = np.unique(segments[owner == floor], return_counts=True)[1]
    assert sizes.max() > 0.5 * sizes.sum()  # a plane stays in one piece


def test_truth_of_a_scene_of_scannetpp_is_that_of_the_room_in_the_benchmarks_classes(
    made: dict[str, Path], rooms: Rooms
) -> None:
    ours = rooms.ground_truth(ROOM, "mesh-vertices")
    theirs = reader(made, "scannetpp").ground_truth(SCANNETPP_SCENE, "scannetpp")
    np.testing.assert_array_equal(theirs.points, ours.points)
    row_of = {name: row for row, name in enumerate(benchmark_names(), 1)}
    rows = [line.split(",") for line in scannetpp_categories.list_texts()["map_benchmark.csv"].splitlines()[1:]]
    class_of_word = {word: row_of.get(target or word, 0) for word, _, target, _ in rows}
    class_of = {0: 0} | {known.id: class_of_word[scannetpp_categories.words()[known.name]] for known in CLASSES}
    expected = np.array([class_of[i] for i in ours.semantic.tolist()])
    assert theirs.semantic.tolist() == expected.tolist() and len(set(expected.tolist())) > 8
    assert theirs.every_semantic is not None and not theirs.every_semantic[:, 1:].any()
    without = [0, *(row_of[name] for name in scannetpp_categories.without_instances())]
    np.testing.assert_array_equal(theirs.instance > 0, ~np.isin(expected, without) & (ours.instance > 0))
    pairs = {(a, b) for a, b in zip(theirs.instance.tolist(), ours.instance.tolist(), strict=True) if a > 0}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs}) > 5


def test_the_lists_of_scannetpp_have_100_and_84_classes_and_a_row_a_word_of_the_rooms() -> None:
    texts = scannetpp_categories.list_texts()
    names, instances = (texts[name].splitlines() for name in ("top100.txt", "top100_instance.txt"))
    assert (len(names), len(instances)) == (100, 84) and set(instances) < set(names)
    header, *rows = (line.split(",") for line in texts["map_benchmark.csv"].splitlines())
    assert header == ["class", "count", "semantic_map_to", "instance_map_to"]
    assert {row[0] for row in rows} == set(scannetpp_categories.words().values()) and len(rows) == len(
        set(map(str, rows))
    )
    assert all((row[2] or row[0]) in {*names, "None"} for row in rows)
    assert set(scannetpp_categories.words()) == {known.name for known in CLASSES}


def test_a_scene_of_scannetpp_has_the_files_and_keys_of_the_release(made: dict[str, Path]) -> None:
    folder = made["scannetpp"] / "data" / SCANNETPP_SCENE
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.suffix != ".jpg"}
    assert files == {
        "iphone/colmap/cameras.txt", "iphone/colmap/images.txt", "iphone/depth.bin", "iphone/pose_intrinsic_imu.json",
        "scans/mesh_aligned_0.05.ply", "scans/mesh_aligned_0.05_mask.txt", "scans/segments.json",
        "scans/segments_anno.json",
    }  # fmt: skip
    tracked = json.loads((folder / "iphone/pose_intrinsic_imu.json").read_text())
    assert list(tracked)[:2] == ["frame_000000", "frame_000001"]
    assert {"pose", "aligned_pose", "intrinsic", "timestamp"} == set(tracked["frame_000000"])
    group = json.loads((folder / "scans/segments_anno.json").read_text())["segGroups"][1]
    assert set(group) == {"id", "objectId", "index", "label", "segments", "obb"}
    assert set(group["obb"]) == {"centroid", "axesLengths", "normalizedAxes"}
    colmap, tracking = (
        ScanNetPP(made["scannetpp"], ScanNetPP.Options(poses=kind)).frames(SCANNETPP_SCENE, 1)
        for kind in ("colmap", "tracking")
    )
    for ours, theirs in zip(colmap, tracking, strict=True):
        np.testing.assert_allclose(ours.camera_to_world, theirs.camera_to_world, atol=1e-12)
        np.testing.assert_array_equal(ours.intrinsics, theirs.intrinsics)


def test_every_room_has_a_scene_name_of_scannetpp_of_its_own() -> None:
    kinds = ("living", "bedroom", "kitchen", "office", "bathroom", "studio")
    names = {scannetpp_categories.scene_name(f"{k}{n}"): f"{k}{n}" for k in kinds for n in range(100)}
    assert len(names) == 600 and all(len(name) == 10 for name in names)
    assert all(scannetpp_categories.room_of(name) == room for name, room in names.items())
    assert scannetpp_categories.room_of("036bce3393") is None
    with pytest.raises(DataError, match=r"^rooms/living100: has no scene name"):
        scannetpp_categories.scene_name("living100")


def test_a_room_of_arkitscenes_has_the_files_of_the_challenge_and_the_objects_of_its_query(
    made: dict[str, Path], rooms: Rooms
) -> None:
    scene, root = ADDRESS["arkitscenes"], made["arkitscenes"]
    folder = root / "ChallengeDevelopmentSet" / scene
    names = {path.name for path in folder.iterdir()}
    images = {"lowres_wide", "lowres_depth", "lowres_wide_intrinsics", "confidence"}
    assert names == {*images, "lowres_wide.traj", f"{scene}_3dod_mesh.ply"}
    assert sorted((folder / "lowres_depth").iterdir())[1].name == f"{scene}_1000.033.png"
    assert all(len(list((folder / name).iterdir())) == N_FRAMES for name in images)
    lists = root / "challenge_track_1/benchmark_file_lists"
    assert (lists / "queries_development_scenes.csv").read_text() == f"video_id,visit_id,query\n{scene},000000,cup\n"
    dataset = reader(made, "arkitscenes")
    truth, ours = dataset.ground_truth(scene, "query-vertices"), rooms.ground_truth(ROOM, "mesh-vertices")
    cups = [known.id for known in rooms.objects(ROOM) if known.class_name == "cup"]
    np.testing.assert_array_equal(truth.points, ours.points)
    for number, object_id in enumerate(cups, 1):
        np.testing.assert_array_equal(truth.instance == number, ours.instance == object_id)
    assert [(query.text, query.answers) for query in dataset.queries(scene)] == [("cup", (1, 2))] and len(cups) == 2
    assert dataset.groups() == {"opensun3d-development": (scene,)}


def test_a_walk_of_hm3dsem_shows_the_room_in_the_middle_of_90_degrees_and_stands_upright(
    made: dict[str, Path], rooms: Rooms
) -> None:
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for ours, theirs in zip(rooms.frames(ROOM, 1), frames(made, "hm3dsem"), strict=True):
        assert theirs.rgb.shape == (60, 100, 3) and theirs.intrinsics[:2].tolist() == [[50.0, 0, 50], [0, 50, 30]]
        np.testing.assert_array_equal(theirs.rgb[:, 10:90], ours.rgb)
        expected = np.rint(ours.depth_m.astype(np.float64) * 1000)
        np.testing.assert_allclose(theirs.depth_m[:, 10:90], expected / 1000, rtol=1e-6)
        assert not theirs.depth_m[:, :10].any() and not theirs.depth_m[:, 90:].any()
        np.testing.assert_allclose(theirs.camera_to_world[:3], turn @ ours.camera_to_world[:3], atol=1e-15)
    truth, scan = reader(made, "hm3dsem").ground_truth(ADDRESS["hm3dsem"], "hovsg-objects"), rooms.scan(ROOM)
    assert set(np.unique(truth.instance)) == set(range(1, truth.instance.max() + 1))
    np.testing.assert_allclose(truth.points.max(axis=0), (scan.vertices @ turn.T).max(axis=0), atol=0.02)
    assert len(truth.points) > 0.9 * len(np.unique(np.floor(scan.vertices / 0.02), axis=0)) - 100
    names = {truth.labels.name_of(one) for one in np.unique(truth.semantic).tolist()}
    assert {"wall", "floor", "ceiling", "toilet", "sink"} <= names


def test_a_room_of_tum_is_not_scored(made: dict[str, Path]) -> None:
    with pytest.raises(DataError, match="no ground truth"):
        reader(made, "tum").ground_truth(ROOM, "mesh-vertices")


def records(content: bytes) -> Iterator[tuple[tuple[float, ...], int, int, bytes, bytes]]:
    """The frames of a ``.sens`` file, by the table of the format alone."""
    (n_name,) = struct.unpack_from("<Q", content, 4)
    at = 4 + 8 + n_name + 4 * 64 + 8 + 16 + 4
    (n_frames,) = struct.unpack_from("<Q", content, at)
    at += 8
    for _ in range(n_frames):
        *fields, n_colour, n_depth = struct.unpack_from("<16f4Q", content, at)
        at += 96
        yield (
            tuple(fields[:16]),
            fields[16],
            fields[17],
            content[at : at + n_colour],
            content[at + n_colour :][:n_depth],
        )
        at += n_colour + n_depth
    assert content[at:] == struct.pack("<Q", 0)  # the block of motion data, empty


def test_a_sens_file_is_that_of_the_format_byte_by_byte(made: dict[str, Path], rooms: Rooms) -> None:
    content = (scan_folder(made, "scannet") / f"{SCAN}.sens").read_bytes()
    version, n_name = struct.unpack_from("<IQ", content)
    assert (version, content[12 : 12 + n_name]) == (4, b"StructureSensor")
    *matrices, colour, depth, width, height, depth_width, depth_height, shift = struct.unpack_from(
        "<64f2i4If", content, 12 + n_name
    )
    k = rooms.intrinsics.astype(np.float32)
    camera = [k[0, 0], 0, k[0, 2], 0, 0, k[1, 1], k[1, 2], 0, 0, 0, 1, 0, 0, 0, 0, 1]
    assert matrices == [*camera, *np.eye(4).reshape(-1), *camera, *np.eye(4).reshape(-1)]
    assert (colour, depth, width, height, depth_width, depth_height, shift) == (2, 1, 80, 60, 80, 60, 1000.0)
    read = list(records(content))
    assert len(read) == N_FRAMES
    for frame, (pose, colour_time, depth_time, jpeg, deflated) in zip(rooms.frames(ROOM, 1), read, strict=True):
        assert pose == tuple(frame.camera_to_world.astype(np.float32).reshape(-1).tolist())
        assert colour_time == depth_time == round(frame.index * 1e6 / 30)
        assert jpeg[:2] == b"\xff\xd8" and jpeg[-2:] == b"\xff\xd9"
        assert zlib.decompress(deflated) == np.rint(frame.depth_m.astype(np.float64) * 1000).astype("<u2").tobytes()


def test_exports_have_the_names_and_digits_of_scannets_readers(made: dict[str, Path], rooms: Rooms) -> None:
    python, cpp = (scan_folder(made, name) for name in SCANNET[1:])
    value = rooms.trajectory(ROOM)[3].astype(np.float32)
    assert (python / "pose/3.txt").read_text().splitlines()[0] == " ".join(f"{v:f}" for v in value[0])
    assert (cpp / "frame-000003.pose.txt").read_text().splitlines()[1] == " ".join(f"{v:g}" for v in value[1])
    assert sorted(path.name for path in (python / "intrinsic").iterdir()) == [
        "extrinsic_color.txt", "extrinsic_depth.txt", "intrinsic_color.txt", "intrinsic_depth.txt",
    ]  # fmt: skip
    assert (python / "intrinsic/extrinsic_depth.txt").read_text().splitlines()[
        2
    ] == "0.000000 0.000000 1.000000 0.000000"
    assert (cpp / "frame-000000.depth.pgm").read_bytes().startswith(b"P5\n80 60\n65535\n")
    info = (cpp / "_info.txt").read_text().splitlines()
    assert [line.partition(" = ")[0] for line in info] == [
        "m_versionNumber", "m_sensorName", "m_colorWidth", "m_colorHeight", "m_depthWidth", "m_depthHeight",
        "m_depthShift", "m_calibrationColorIntrinsic", "m_calibrationColorExtrinsic", "m_calibrationDepthIntrinsic",
        "m_calibrationDepthExtrinsic", "m_frames.size",
    ]  # fmt: skip
    assert (info[2], info[6], info[-1]) == ("m_colorWidth = 80", "m_depthShift = 1000", "m_frames.size = 12")
    for export in (open_python_export(python, "here"), open_cpp_export(cpp, "here")):
        assert len(export) == N_FRAMES


def test_the_files_beside_a_recording_have_the_columns_and_keys_of_the_release(made: dict[str, Path]) -> None:
    folder = scan_folder(made, "scannet")
    vertex = [*(f"property float {name}" for name in "xyz"),
              *(f"property uchar {name}" for name in ("red", "green", "blue", "alpha"))]  # fmt: skip
    for name, more in (("", []), (".labels", ["property ushort label"])):
        header = (folder / f"{SCAN}_vh_clean_2{name}.ply").read_bytes().partition(b"end_header")[0].decode()
        lines = [line for line in header.splitlines() if not line.startswith("element")]
        faces = ["property list uchar int vertex_indices"]
        assert lines == ["ply", "format binary_little_endian 1.0", *vertex, *more, *faces]
    facts = dict(line.split(" = ") for line in (folder / f"{SCAN}.txt").read_text().splitlines())
    assert list(facts) == [
        "axisAlignment", "colorHeight", "colorToDepthExtrinsics", "colorWidth", "depthHeight", "depthWidth",
        "fx_color", "fx_depth", "fy_color", "fy_depth", "mx_color", "mx_depth", "my_color", "my_depth",
        "numColorFrames", "numDepthFrames", "numIMUmeasurements", "sceneType",
    ]  # fmt: skip
    assert (facts["numDepthFrames"], facts["sceneType"]) == ("12", "Bathroom")
    assert np.array_equal(np.array(facts["axisAlignment"].split(), float).reshape(4, 4), np.eye(4))
    groups = json.loads((folder / f"{SCAN}.aggregation.json").read_text())["segGroups"]
    assert {"wall", "floor", "ceiling", "toilet", "sink"} <= {group["label"] for group in groups}
    labels = read_ply(folder / f"{SCAN}_vh_clean_2.labels.ply").element("vertex")
    assert labels is not None
    is_wall = np.asarray(labels.columns["label"]) == 1
    assert np.asarray(labels.columns["green"])[is_wall].tolist() == [199] * int(is_wall.sum())


def test_the_three_layouts_of_scannet_have_the_same_truth_files(made: dict[str, Path]) -> None:
    first, *others = (scan_folder(made, name) for name in SCANNET)
    names = {path.name for path in first.iterdir()} - {f"{SCAN}.sens"}
    assert len(names) == 5
    for other in others:
        assert all((other / name).read_bytes() == (first / name).read_bytes() for name in names)


def test_the_label_table_has_the_columns_of_the_release_and_a_row_a_category(made: dict[str, Path]) -> None:
    header, *rows = (made["scannet"] / "scannetv2-labels.combined.tsv").read_text().splitlines()
    assert header.split("\t")[:8] == [
        "id", "raw_category", "category", "count", "nyu40id", "eigen13id", "nyuClass", "nyu40class",
    ]  # fmt: skip
    cells = [row.split("\t") for row in rows]
    assert {len(row) for row in cells} == {len(header.split("\t"))} == {17}
    assert len({row[1] for row in cells}) == len(cells) == len(set(categories().values()))
    refrigerator = next(row for row in cells if row[1] == "refrigerator")
    assert refrigerator[0] == "27" and refrigerator[4] == "24" and refrigerator[7] == "refridgerator"


def test_the_marker_names_scans_and_rooms(made: dict[str, Path]) -> None:
    marker = json.loads((made["scannet"] / "scans/rooms.json").read_text())
    assert list(marker) == ["generator", "version", "scenes", "rooms"]
    assert marker["rooms"] == {SCAN: ROOM} and list(marker["scenes"]) == [SCAN]


def test_every_class_of_the_rooms_has_a_category() -> None:
    assert set(categories()) == {known.name for known in CLASSES}


def test_every_room_has_a_scan_name_of_its_own_outside_scannets() -> None:
    kinds = ("living", "bedroom", "kitchen", "office", "bathroom", "studio")
    names = {scan_name(f"{kind}{number}"): f"{kind}{number}" for kind in kinds for number in range(100)}
    assert len(names) == 600 and min(names) > "scene0806_00"
    assert all(room_of(scan) == room for scan, room in names.items())
    assert room_of("scene0000_00") is None
    with pytest.raises(DataError, match=r"^rooms/living100: has no scan name; choose a room from 0 to 99 of its kind"):
        scan_name("living100")


def test_tum_lists_name_every_image_by_its_time(made: dict[str, Path]) -> None:
    folder = made["tum"] / "tum" / ROOM
    lines = (folder / "associate.txt").read_text().splitlines()
    assert len(lines) == N_FRAMES and lines[1] == "0.033333 rgb/0.033333.png 0.033333 depth/0.033333.png"
    poses = [line for line in (folder / "groundtruth.txt").read_text().splitlines() if not line.startswith("#")]
    assert [line.split()[0] for line in poses] == [line.split()[0] for line in lines]
    depth = cv2.imread(str(folder / "depth/0.033333.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None and depth.dtype == np.uint16


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_verb_makes_each_layout_and_the_same_command_again_does_nothing(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "cache"))
    small = ["n_frames=2", "width=32", "height=24", "mesh_spacing_m=0.15"]
    words = ["datasets", "make", "rooms", "--scenes", ROOM, "--set", *small, "--layout", name, "--jobs", "1"]
    words += ["--out", str(tmp_path / "made")]
    assert main(words) == 0
    said = capsys.readouterr()
    address = f"{LAYOUTS[name].reader}/{ADDRESS[name]}"
    assert said.out.split() == [ROOM, "made", address]
    assert f"run --scenes '{LAYOUTS[name].reader}/*'" in said.err
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == [
        {"scene": ROOM, "status": "was there already", "address": address}
    ]
    assert main([*words, "--set", "n_frames=3"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert f"holds another '{ADDRESS[name]}', made elsewhere or with other options" in said.err
