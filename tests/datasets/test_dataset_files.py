"""All file-based datasets: one line per fault of a file, a hint if data is missing, a digest of every file."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import arkitscenes_scene as ark
import hm3dsem_walk as hm
import numpy as np
import pytest
import replica_scene as rep
import scannetpp_scene as pp
from recording_files import grid, write_files, write_mesh
from rgbd_scene import CAMERA, NUMBERED, describe
from rgbd_scene import write_scene as write_rgbd
from scannet_scan import RECORDED, SCAN, pgm_bytes, table_text, write_cpp_export, write_python_export, write_scan
from test_openscan import RECORD
from test_tum import SCENE as SEQUENCE
from test_tum import write_sequence

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError, GroundTruthMissing, ScenesMissing

Content = Any  # of a file: None removes it, a function of the data root may change anything
RENDER, HABITAT = "Replica/room0", "replica_v1/room_0/habitat"
SCANS, IPHONE, WALK = f"scans/{SCAN}", f"data/{pp.SCENE}/iphone", f"hm3dsem_walks/val/{hm.SCENE}"
VIDEO, MESHES = f"ChallengeDevelopmentSet/{ark.SCENE}", f"data/{pp.SCENE}/scans"
TABLE, IDENTITY = "scannetv2-labels.combined.tsv", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def write_replica(root: Path) -> None:
    """A scene with every kind of ground truth."""
    rep.write_render(root)
    rep.write_original(root, rep.QUADS, [0, 0, 5, 5], rep.TWO_OBJECTS)
    rep.write_clouds(root, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    write_mesh(root / "Replica/room0_mesh.ply", *grid(3, 3))
    labels = {"ground_truth/room0.txt": "20001\n" * 9, "semantic_gt/room0.txt": "20\n" * 9}
    write_files(root / "Replica", labels)


def write_tracked(root: Path) -> None:
    shutil.rmtree(pp.write_scene(root) / "iphone/colmap")


MAKERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "replica": ("room0", write_replica),
    "scannet": (SCAN, lambda root: write_files(write_scan(root).parents[1], {"openscan_val_raw.json": [RECORD]})),
    "scannet python": (SCAN, lambda root: write_python_export(root / SCANS)),
    "scannet cpp": (SCAN, lambda root: write_cpp_export(root / SCANS)),
    "scannetpp": (pp.SCENE, pp.write_scene),
    "scannetpp tracking": (pp.SCENE, write_tracked),
    "hm3dsem": (hm.SCENE, hm.write_walk),
    "arkitscenes": (ark.SCENE, ark.write_scene),
    "rgbd": ("desk", write_rgbd),
    "tum": (SEQUENCE, write_sequence),
}


def opened(root: Path, name: str) -> Any:
    kind = registry.load("dataset", name.split()[0])
    return kind(root, kind.Options())


def change(root: Path, name: str, content: Content) -> None:
    if content is None:
        (root / name).unlink()
    elif callable(content):
        content(root)
    else:
        write_files(root, {name: content})


def faults(dataset: Any, scene: str) -> list[str]:
    """The message of everything that fails; missing ground truth is not a fault."""
    lines: list[str] = []
    variants = [*dataset.variants, *dict(getattr(dataset, "extra_ground_truths", {})).values()]
    asks: list[Callable[[], object]] = [lambda: lines.extend(dataset.problems(scene))]
    asks += [lambda: dataset.frames(scene, 1)[1], lambda: list(dataset.frames(scene, 1))]
    asks += [partial(dataset.ground_truth, scene, variant) for variant in variants]
    for ask in asks:
        try:
            ask()
        except GroundTruthMissing:
            pass
        except DataError as error:
            lines.append(str(error))
    return lines


def boxed(**changes: Any) -> dict[str, Any]:
    """The table of objects with a box, with ``changes`` to the first box."""
    table = rep.info_table(rep.TWO_OBJECTS)
    table["objects"][0]["oriented_bbox"] = rep.box(**changes)
    return table


def walk_info(place: str, number: int, **changes: Any) -> Any:
    table: Any = hm.info()
    table[place][number] |= changes
    return table


def of_other_scene(root: Path) -> None:
    path = root / SCANS / f"{SCAN}.aggregation.json"
    path.write_text(path.read_text().replace(f"scannet.{SCAN}", "scannet.scene0001_00"))


def described(**keys: Any) -> Callable[[Path], object]:
    return lambda root: describe(root / "rgbd/desk", {**NUMBERED, "check_convention": False, **keys})


def flip(name: str, at: int) -> Callable[[Path], object]:
    def edit(root: Path) -> None:
        content = bytearray((root / name).read_bytes())
        content[at] ^= 1
        (root / name).write_bytes(bytes(content))

    return edit


def link_away(name: str) -> Callable[[Path], object]:
    def edit(root: Path) -> None:
        (root / name).rename(root / "outside")
        (root / name).symlink_to(root / "outside")

    return edit


GREY, DEEP = np.zeros((20, 30, 3), np.uint8), np.zeros((20, 30), np.uint16)
TRACKING = f"{IPHONE}/pose_intrinsic_imu.json"
PINCAM = f"{VIDEO}/lowres_wide_intrinsics/{ark.SCENE}_100.000.pincam"
QUERIES = "video_id,visit_id,query\n"
ANNOTATION = f"hm3d/val/{hm.SCENE}/{hm.SHORT}.semantic.txt"
FAULTS: list[tuple[str, str, Content, str]] = [
    ("replica", f"{RENDER}/results/frame000001.jpg", None, "results/frame000001.jpg is missing; copy results/ again"),
    ("replica", f"{RENDER}/results/frame000001.jpg", GREY, "frame000001.jpg is 30x20, the camera file has 12x8"),
    ("replica", "", flip(f"{RENDER}/results/depth000001.png", 45), "depth000001.png: not a readable PNG image"),
    ("replica", f"{RENDER}/traj.txt", f"{IDENTITY}\nnan{IDENTITY[1:]}\n", "traj.txt line 2: the pose has 'nan'"),
    ("replica", "Replica/cam_params.json", {"camera": rep.CAMERA | {"fy": "600"}}, "camera.fy: Input should be"),
    ("replica", f"{HABITAT}/info_semantic.json", b"{", "info_semantic.json: not JSON"),
    ("replica", f"{HABITAT}/info_semantic.json", rep.info_table([(4, 20), (4, 21)]), "object 4 is listed twice"),
    ("replica", f"{HABITAT}/info_semantic.json", boxed(rotation=[0, 0, 0, 0]), "'rotation' has the length 0; expected"),
    ("replica", "", lambda root: write_mesh(root / HABITAT / "mesh_semantic.ply", *grid(3, 3)), "have no 'object_id'"),
    ("replica", f"{rep.CLOUDS}/pc_points.h5", np.full((3, 3), np.nan), "pc_points.h5: point 0 is at [nan, nan, nan]"),
    ("replica", f"{rep.CLOUDS}/pc_points.h5", np.zeros((2, 3)), "pc_embeddings.h5: has 3 rows, pc_points.h5 has 2"),
    ("replica", f"{rep.CLOUDS}/pc_embeddings.h5", np.zeros((3, 101)), "has the shape (3, 101); expected (N, 102)"),
    ("replica", f"{rep.SEQUENCE}/traj_w_c.txt", f"2{IDENTITY[1:]}", "traj_w_c.txt line 1: not a rigid"),
    ("replica", "Replica/ground_truth/room0.txt", "1\n" * 3, "has 3 labels, room0_mesh.ply 9 and habitat/mesh_sem"),
    ("replica", "Replica/ground_truth/room0.txt", "102005\n" * 9, "102005 is of class 102, Replica has 1 to 101"),
    ("replica", "Replica/ground_truth/room0.txt", "1\n\x1b[31m\n", r"line 2 is '\x1b[31m'; expected one whole number"),
    ("replica", "Replica/semantic_gt/room0.txt", "1\n" * 9, "has class 1, not one of the 51 Replica ids"),
    ("scannet", "", of_other_scene, "'sceneId' is 'scannet.scene0001_00', not 'scene00"),
    ("scannet", "", lambda root: write_mesh(root / SCANS / f"{SCAN}_vh_clean_2.ply", *grid()), "of different meshes"),
    ("scannet", TABLE, "id\tnyu40id\n1\t1\n", "has no column 'raw_category'"),
    ("scannet", TABLE, table_text([("chair", 2, 41, "")]), "line 2: 'nyu40id' is '41'; expected a whole number from 1"),
    ("scannet", TABLE, table_text() + "3\tla\x1bmp\t\t\t4\n", "line 8: has no raw_category, id, nyu40id"),
    ("scannet", f"{SCANS}/{SCAN}.txt", "colorHeight\n", "line 1: 'colorHeight' is not 'key = value'"),
    ("scannet", f"{SCANS}/{SCAN}.txt", f"axisAlignment = {IDENTITY[2:]}\n", "has 15 values; expected 16 finite"),
    ("scannet", f"{SCANS}/{SCAN}.txt", f"axisAlignment = 2{IDENTITY[1:]}\n", "'axisAlignment' is not a rigid motion"),
    ("scannet", "openscan_val_raw.json", [RECORD, RECORD], "record 2: object 0 of scene0000_00 has a record already"),
    ("scannet", "openscan_val_raw.json", [RECORD | {"affordance": "slep"}], "the affordance 'slep', which is not one"),
    ("scannet python", f"{SCANS}/color/2.jpg", None, "color/2.jpg is missing; export the recording again"),
    ("scannet python", f"{SCANS}/depth/0.jpg", b"", "depth/ holds '0.jpg', which belongs to no frame"),
    ("scannet python", f"{SCANS}/intrinsic/intrinsic_color.txt", None, "intrinsic/intrinsic_color.txt is missing"),
    ("scannet python", f"{SCANS}/intrinsic/intrinsic_depth.txt", "1 2 3\n", "has 3 values; expected 16, a 4x4"),
    ("scannet python", f"{SCANS}/depth/1.png", DEEP, "depth/1.png is 30x20; expected 32x24, as the first frame"),
    ("scannet cpp", f"{SCANS}/frame-000002.color.jpg", None, "frame-000002.color.jpg is missing; "),
    ("scannet cpp", f"{SCANS}/frame-000004.pose.txt", IDENTITY, "has 4 frames, but there is also frame-000004.pose"),
    ("scannet cpp", f"{SCANS}/frame-000001.depth.pgm", pgm_bytes(DEEP), "is 30x20; expected 32x24, as in _info.txt"),
    ("scannet cpp", f"{SCANS}/_info.txt", b"\xff\xfe", "_info.txt: not a text file"),
    *(
        ("scannet cpp", f"{SCANS}/_info.txt", RECORDED["info_cpp"].replace(old, new), message)
        for old, new, message in (
            ("m_frames.size = 4", "m_frames.size = 999999999", "color.jpg is missing, and 2999999984 more"),
            ("m_frames.size = 4", "m_frames.size = 1000000000000", "'m_frames.size' is '1000000000000'; expected"),
            ("m_colorWidth = 64", "m_colorWidth = 999999999", "colour images of 999999999x48; expected 1 to"),
            ("28.5812 0 15.975", "28.5812 0", "'m_calibrationDepthIntrinsic' has 15 values; expected 16"),
        )
    ),
    ("scannetpp", f"{IPHONE}/colmap/cameras.txt", "1 OPENCV_FISHEYE 64 48 1 2 3 4\n", "model is 'OPENCV_FISHEYE'"),
    ("scannetpp", f"{IPHONE}/colmap/cameras.txt", "1 OPENCV 64 48 64 64 32 24 0 99 0 0\n", "distortion is 0 99 0 0"),
    ("scannetpp", f"{IPHONE}/colmap/images.txt", "1 2 0 0 0 0 0 0 1 frame_000000.jpg\n", "expected a unit quaternion"),
    ("scannetpp", f"{IPHONE}/colmap/images.txt", "1 1 0 0 0 0 0 0 1 frame_000007.jpg\n", "frame_000007.jpg is missing"),
    ("scannetpp", f"{MESHES}/segments.json", {"segIndices": [1, 2]}, "has 2 vertices, mesh_aligned_0.05.ply has 861"),
    ("scannetpp", f"{MESHES}/segments_anno.json", {"segGroups": [{"segments": [1]}]}, "segGroups.0.label: Field requ"),
    ("scannetpp", f"{MESHES}/mesh_aligned_0.05_mask.txt", "861\n", "'861' is not a vertex of mesh_aligned_0.05.ply"),
    ("scannetpp", f"{pp.LISTS}/top100.txt", "wall\nwall\n", "top100.txt: has 'wall' twice"),
    ("scannetpp", f"{pp.LISTS}/top100_instance.txt", "piano\n", "has 'piano', which is missing in top100.txt"),
    ("scannetpp", f"{pp.LISTS}/map_benchmark.csv", f"{pp.MAP}sofa\n", "row 7: has 1 cells of 4"),
    ("scannetpp tracking", TRACKING, pp.tracking(aligned_pose=(2 * np.eye(4)).tolist()), "'aligned_pose' is not"),
    ("hm3dsem", f"{WALK}/scene_info.json", {}, "levels: Field required"),
    ("hm3dsem", f"{WALK}/scene_info.json", walk_info("regions", 0, floor_id=3), "a 'floor_id' does not match a level"),
    ("hm3dsem", f"{WALK}/scene_info.json", walk_info("objects", 1, id=3), "an object is listed twice"),
    ("hm3dsem", f"{WALK}/pose/{hm.SHORT}_000001.txt", None, "pose/..._000001.txt is missing"),
    ("hm3dsem", f"{WALK}/pose/{hm.SHORT}_000001.txt", " ".join(["2"] * 16), "not a rigid transform"),
    ("hm3dsem", f"{WALK}/depth/notes.txt", "x", "belongs to no frame"),
    ("hm3dsem", f"{WALK}/objects/7.ply", b"ply", "objects/7.ply"),
    ("hm3dsem", ANNOTATION, "HM3D Semantic Annotations\n3,0A0B0C,chair\n", ":2: is '3,0A0B0C,chair'"),
    ("hm3dsem", ANNOTATION, 'HM3D Semantic Annotations\n3,0A,"a",5\n3,0A,"b",5\n', ":3: object 3 is listed twice"),
    ("hm3dsem", ANNOTATION, 'HM3D Semantic Annotations\n3,0A,"sofa, old",5\n', "object 3 differs from the scene's"),
    ("arkitscenes", ark.TRUTH, "version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer, not the file"),
    ("arkitscenes", ark.TRUTH, "0\n1\n", "has 2 lines, the mesh has 8 vertices; both must belong to one scene"),
    ("arkitscenes", ark.QUERIES, f"{QUERIES}1,2,a\n", "row 2: expected video_id,visit_id,query, with an"),
    ("arkitscenes", ark.QUERIES, f"{QUERIES}{ark.SCENE},2,a\n{ark.SCENE},2,b\n", f"scene {ark.SCENE} has two queries"),
    ("arkitscenes", f"{VIDEO}/lowres_wide.traj", "1 2 3\n", "lowres_wide.traj line 1: has 3 values; expected time"),
    ("arkitscenes", f"{VIDEO}/lowres_wide.traj", "900 0 0 0 0 0 0\n", "3 images have no pose nearer than 0.3 s"),
    ("arkitscenes", PINCAM, "64 48 60\n", "3 values; expected one line"),
    ("arkitscenes", PINCAM, "32 24 60 60 1 1\n", "expected 32x24"),
    ("rgbd", "", described(depth=None, dept="a"), "rgbd.toml:7: unknown key 'dept'; did you mean 'depth'?"),
    ("rgbd", "", described(colour="**/*.png"), "expected a pattern with one {index}, or with * or ?"),
    ("rgbd", "", described(pose=None, trajectory="intrinsics.txt"), "has 3 lines; expected blocks of five"),
    ("rgbd", "", described(intrinsics=None, intrinsics_file="wide.json"), "the camera file has 640x8; intrinsics"),
    ("rgbd", "", link_away("rgbd/desk/data/colour/frame-0.png"), "'colour/frame-0.png' leads out of the folder"),
    ("rgbd", "", link_away("rgbd/desk/data/frame-1.pose.txt"), "'frame-1.pose.txt' leads out of the folder"),
    ("tum", f"{SEQUENCE}/groundtruth.txt", None, "groundtruth.txt is missing; copy the file again"),
    ("tum", f"{SEQUENCE}/groundtruth.txt", "100 0 0 0 nan 0 0 1\n", "line 1: the quaternion has the length nan"),
    ("tum", f"{SEQUENCE}/associate.txt", "1 /etc/passwd 1 b\n", "'/etc/passwd' leads out of the folder"),
    ("tum", f"{SEQUENCE}/depth/100.004000.png", DEEP, "is 30x20 and rgb/100.000000.png is 12x8; both must"),
    ("tum", "", link_away(f"{SEQUENCE}/rgb/100.000000.png"), "'rgb/100.000000.png' leads out of the folder"),
]


@pytest.mark.parametrize(("name", "file", "content", "message"), FAULTS)
def test_each_file_fault_is_one_line(tmp_path: Path, name: str, file: str, content: Content, message: str) -> None:
    scene, make = MAKERS[name]
    make(tmp_path)
    if name == "rgbd":
        write_files(tmp_path / "rgbd/desk/data", {"wide.json": CAMERA | {"width": 640}})
    assert faults(opened(tmp_path, name), scene) == []
    change(tmp_path, file, content)
    lines = [line for line in faults(opened(tmp_path, name), scene) if message in line]
    assert lines, faults(opened(tmp_path, name), scene)
    assert all(line.isprintable() and len(line) < 600 for line in lines)
    assert all(line.startswith((name.split()[0], "openscan")) for line in lines)


@pytest.mark.parametrize("name", [name for name in MAKERS if " " not in name])
def test_missing_data_hints_how_to_get_it_and_unknown_scene_suggests_another(tmp_path: Path, name: str) -> None:
    with pytest.raises(ScenesMissing, match=rf"^{name}: no scene in "):
        opened(tmp_path, name).scenes()
    with pytest.raises(ScenesMissing, match=r"nothere \(there is no such folder\)"):
        opened(tmp_path / "nothere", name).scenes()
    scene, make = MAKERS[name]
    make(tmp_path)
    for unknown, hint in ((f"{scene}x", f"; did you mean '{scene}'"), ("../tum", "")):
        with pytest.raises(DataError, match=f"^{name}: no scene '{unknown}'{hint}"):
            opened(tmp_path, name).info(unknown, 1)
    with pytest.raises(GroundTruthMissing, match=f"^{name}/{scene}: no ground truth 'other'"):
        opened(tmp_path, name).ground_truth(scene, "other")


@pytest.mark.parametrize(
    ("name", "file", "content"),
    [
        ("replica", f"{RENDER}/traj.txt", f"{IDENTITY}\n" * 3),
        ("replica", f"{HABITAT}/info_semantic.json", rep.info_table([(0, 20), (5, 81)])),
        ("replica", f"{RENDER}/results/depth000001.png", np.ones((8, 12), np.uint16)),
        ("replica", f"{RENDER}/results/depth000002.png", None),
        ("replica", "", flip(f"{rep.CLOUDS}/pc_embeddings.h5", 3000)),
        ("replica", "", flip(rep.REFERENCE, -1)),
        ("replica", "Replica/semantic_gt/room0.txt", "21\n" * 9),
        ("replica", "Replica/room0_mesh.ply", None),
        ("scannet", "", flip(f"{SCANS}/{SCAN}.sens", 30)),
        ("scannet", "", flip(f"{SCANS}/{SCAN}.sens", -1)),
        ("scannet", "", flip(f"{SCANS}/{SCAN}.aggregation.json", 40)),
        ("scannet", "", flip(TABLE, 90)),
        ("scannet python", f"{SCANS}/pose/1.txt", IDENTITY),
        ("scannetpp", f"{IPHONE}/colmap/cameras.txt", "1 PINHOLE 64 48 64 64 32 25\n"),
        ("scannetpp", f"{MESHES}/mesh_aligned_0.05_mask.txt", "0\n"),
        ("scannetpp", f"{pp.LISTS}/map_benchmark.csv", "class,count,semantic_map_to\n"),
        ("hm3dsem", "", flip(f"{WALK}/objects/7.ply", -1)),
        ("arkitscenes", ark.TRUTH, "1\n" * 8),
        ("rgbd", "rgbd/desk/data/frame-1.pose.txt", IDENTITY),
        ("tum", f"{SEQUENCE}/groundtruth.txt", "100 0 0 0 0 0 0 1\n100.1 9 0 0 0 0 0 1\n"),
    ],
)
def test_digest_changes_with_every_file_that_is_read(tmp_path: Path, name: str, file: str, content: Content) -> None:
    scene, make = MAKERS[name]
    make(tmp_path)
    before = opened(tmp_path, name).digest(scene)
    assert opened(tmp_path, name).digest(scene) == before
    change(tmp_path, file, content)
    assert opened(tmp_path, name).digest(scene) != before
