"""What reads the files of datasets: a small valid sample of each and the call that reads it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from fuzzing import Make, Read, Target, every_one_of
from places import CASES


def _whole_dataset(make: Callable[[], Any], scene: str) -> Read:
    """All that is ever asked of a dataset, each question whatever became of the one before."""

    def asked() -> Iterator[Read]:
        dataset = make()
        yield dataset.scenes
        yield lambda: dataset.files(scene)
        yield lambda: dataset.info(scene, 1)
        yield lambda: dataset.digest(scene)
        yield lambda: list(dataset.frames(scene, 1))
        for variant in dataset.variants:
            yield partial(dataset.ground_truth, scene, variant)
        yield lambda: dataset.instance_mesh(scene)
        for name in ("surface", "problems", "queries", "object_boxes", "status"):
            if hasattr(dataset, name):
                yield partial(_used_up, getattr(dataset, name), scene)

    return lambda: every_one_of(asked())


def _used_up(ask: Callable[[str], Any], scene: str) -> object:
    found = ask(scene)
    return list(found) if isinstance(found, Iterator) else found


def _replica(folder: Path) -> Read:
    from replica_clouds import write_clouds
    from replica_scene import CHAIR, QUADS, TABLE, TWO_OBJECTS, WALL, write_original, write_render, write_scene_graphs
    from scannet_scan import grid, write_mesh
    from test_replica_problems import box
    from test_replica_truths import write_labels

    from su3d_bench.datasets.replica.dataset import Replica

    write_render(folder, n_frames=2)
    habitat = write_original(folder, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    table = habitat / "info_semantic.json"
    boxes = f', "oriented_bbox": {box()}'.replace("'", '"').replace("(", "[").replace(")", "]")
    table.write_text(table.read_text().replace(f'"class_id": {CHAIR}}}', f'"class_id": {CHAIR}{boxes}}}'))
    points = np.random.default_rng(0).random((5, 3))
    write_clouds(folder, points, np.array([CHAIR, 0, WALL, 101, TABLE]), np.array([[1.0, 2, 3], [4, 5, 6]]))
    write_mesh(folder / "Replica/room0_mesh.ply", *grid(4, 2))
    write_labels(folder, "Replica/ground_truth/room0.txt", [20066, 80066, 30, 256003, 20000, 0, 20066, 0])
    write_labels(folder, "Replica/semantic_gt/room0.txt", [CHAIR, WALL, TABLE, CHAIR, CHAIR, WALL, WALL, TABLE])
    write_scene_graphs(folder, [(0, "chair"), (5, "table")], [(0, 5, "near")])
    (folder / "Replica/rooms.json").write_text('{"scenes": {"room0": "abc", "other": "def"}}')
    return _whole_dataset(lambda: Replica(folder), "room0")


def _scannet(folder: Path) -> Read:
    from scannet_scan import write_floor_truth
    from scannet_scans import write_scan

    from su3d_bench.datasets.scannet.dataset import ScanNet, ScannetOptions

    write_floor_truth(write_scan(folder, n_frames=2), spacing_m=0.5)
    return _whole_dataset(lambda: ScanNet(folder, ScannetOptions()), "scene0000_00")


def _openscan(folder: Path) -> Read:
    from test_openscan import RECORD, write

    from su3d_bench.datasets.openscan import KEYS, RAW_NAME, attribute_ids, read_attributes

    path = write(folder / RAW_NAME, [RECORD, RECORD | {"object_id": "7", "type": ""}])
    return lambda: [
        attribute_ids(words, variant, path.name) for words in read_attributes(path).values() for variant in KEYS
    ]


def _beacon3d(kind: str) -> Make:
    def make(folder: Path) -> Read:
        from test_beacon3d import GROUNDING, QA, written

        from su3d_bench.questions.beacon3d import answered_file

        answers = [{"correct": 1}, {"object_id": 3}] * 2 if kind == "grounding" else [{"pred": "red", "score": 2}] * 3
        paths = written(folder, GROUNDING if kind == "grounding" else QA, answers)
        return lambda: answered_file(*paths)

    return make


def _aligned_scannet(folder: Path) -> Read:
    from scannet_scan import write_floor_truth
    from scannet_scans import write_scan

    from su3d_bench.datasets.scannet.dataset import ScanNet, ScannetOptions

    write_floor_truth(write_scan(folder, n_frames=2, lost=[1]), spacing_m=0.5)
    return _whole_dataset(lambda: ScanNet(folder, ScannetOptions(axis_align=True)), "scene0000_00")


def _sens(name: str) -> Make:
    def make(folder: Path) -> Read:
        from test_sens import WHERE, read_whole

        from su3d_bench.datasets.scannet.sens import SensFile

        path = folder / "a.sens"
        path.write_bytes((CASES / name).read_bytes())
        return lambda: read_whole(SensFile(path, WHERE))

    return make


def _scannet_export(form: str) -> Make:
    def make(folder: Path) -> Read:
        from scannet_scan import table_text, write_floor_truth
        from scannet_toy import write_cpp_export, write_python_export

        from su3d_bench.datasets.scannet.dataset import ScanNet, ScannetOptions

        scan = folder / "scans" / "scene0000_00"
        (write_python_export if form == "python" else write_cpp_export)(scan)
        write_floor_truth(scan, spacing_m=0.5)
        (folder / "scannetv2-labels.combined.tsv").write_text(table_text())
        return _whole_dataset(lambda: ScanNet(folder, ScannetOptions()), "scene0000_00")

    return make


def _scannetpp(poses: Literal["colmap", "tracking"], *, packed: bool = False) -> Make:
    def make(folder: Path) -> Read:
        from scannetpp_scene import SCENE, write_scene

        from su3d_bench.datasets.scannetpp.dataset import ScanNetPP

        write_scene(folder, packed=packed, spacing_m=0.5)
        options = ScanNetPP.Options(poses=poses)
        return _whole_dataset(lambda: ScanNetPP(folder, options), SCENE)

    return make


def _arkitscenes(images: Literal["lowres", "wide"] = "lowres", *, is_3dod: bool = False) -> Make:
    def make(folder: Path) -> Read:
        from arkitscenes_scene import SCENE, write_images, write_scene

        from su3d_bench.datasets.arkitscenes.dataset import ArkitScenes

        place = write_scene(folder, is_3dod=is_3dod)
        if images == "wide":
            write_images(place, "wide", "highres_depth", (32, 24), (32, 24))
        options = ArkitScenes.Options(images=images, least_confidence=0 if images == "wide" else 2)
        return _whole_dataset(lambda: ArkitScenes(folder, options), SCENE)

    return make


def _hm3dsem(folder: Path) -> Read:
    from hm3dsem_walk import SCENE, write_walk

    from su3d_bench.datasets.hm3dsem.dataset import Hm3dSem

    write_walk(folder)
    return _whole_dataset(lambda: Hm3dSem(folder), SCENE)


def _depth_stream(folder: Path) -> Read:
    import zlib

    from scannetpp_scene import depth_values

    from su3d_bench.datasets.scannetpp.iphone.depth_file import DepthFile

    pack, path = zlib.compressobj(wbits=-zlib.MAX_WBITS), folder / "depth.bin"
    metres = b"".join((depth_values(k) / np.float32(1000)).astype("<f4").tobytes() for k in range(2))
    path.write_bytes(pack.compress(metres) + pack.flush())
    return lambda: DepthFile(path, "here", frozenset((0, 1))).values(1)


def _depth_blocks(folder: Path) -> Read:
    import base64
    import json

    from su3d_bench.datasets.scannetpp.iphone.depth_file import DepthFile

    block = base64.b64decode(json.loads((CASES / "scannetpp_lz4.json").read_text())["image"][0])
    (folder / "depth.bin").write_bytes(len(block).to_bytes(4, "little") + block)
    return lambda: DepthFile(folder / "depth.bin", "here", frozenset((0,))).values(0)


def _rgbd(**changes: Any) -> Make:
    def make(folder: Path) -> Read:
        from rgbd_scene import write_scene
        from scannet_scan import grid, write_mesh

        from su3d_bench.datasets.rgbd.dataset import Rgbd

        write_mesh(write_scene(folder, n_frames=2, mesh="mesh.ply", **changes) / "data/mesh.ply", *grid(3, 2))
        return _whole_dataset(lambda: Rgbd(folder), "desk")

    return make


def _tum(folder: Path) -> Read:
    from test_tum import SCENE, write_sequence

    from su3d_bench.datasets.tum.dataset import Tum

    sequence = write_sequence(folder, n_frames=2)
    pairs = [f"100.{k} rgb/100.{k}00000.png 100.{k} depth/100.{k}04000.png\n" for k in range(2)]
    (sequence / "associate.txt").write_text("".join(pairs))
    return _whole_dataset(lambda: Tum(folder), SCENE)


def _rooms(folder: Path) -> Read:
    from su3d_bench.datasets.rooms.kept import kept_scan
    from su3d_bench.datasets.rooms.scan import RoomScan

    points = np.zeros((5, 3), np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    whole = RoomScan(points, points, np.zeros((5, 3), np.uint8), faces, np.zeros(5, np.int32))
    kept_scan(folder / "a.npz", lambda: whole)
    return lambda: kept_scan(folder / "a.npz", lambda: whole)


def _rooms_mesh(folder: Path) -> Read:
    from test_rooms import made_mesh

    from su3d_bench.datasets.rooms.kept import kept_mesh

    whole = made_mesh()
    kept_mesh(folder / "a.npz", lambda: whole)
    return lambda: kept_mesh(folder / "a.npz", lambda: whole)


def _openlex3d(folder: Path) -> Read:
    from test_openlex3d_files import corners, written
    from test_openlex3d_original import write_visible

    from su3d_bench.datasets.openlex3d.release import categories_truth, queries_truth

    files, mesh = written(folder), corners()
    write_visible(folder / "replica/room0", mesh.points[::5])
    return lambda: every_one_of(
        iter((files.prompts, lambda: categories_truth(files, mesh), lambda: queries_truth(files, mesh, "all")))
    )


def _openlex3d_points(dataset: str, scene: str) -> Make:
    def make(folder: Path) -> Read:
        from test_openlex3d_original import SAMPLED, of_dataset, write_objects

        from su3d_bench.datasets.openlex3d.points import points_of

        if dataset == "hm3d":
            write_objects(folder / "hm3d" / scene, of_dataset(dataset)["scenes"][scene])
        else:
            place = folder / "scannetpp/prepared_semantics" / SAMPLED.name
            place.parent.mkdir(parents=True)
            place.write_bytes(SAMPLED.read_bytes())
        return lambda: points_of(dataset, folder, scene)

    return make


def _ply(form: str) -> Make:
    def make(folder: Path) -> Read:
        from test_ply import MIXED, mesh_bytes

        from su3d_bench.formats.ply import read_ply

        (folder / "made").mkdir()
        (folder / "a.ply").write_bytes(mesh_bytes(folder / "made", form, MIXED))
        return lambda: read_ply(folder / "a.ply")

    return make


def _pcd(form: str) -> Make:
    def make(folder: Path) -> Read:
        from test_pcd import forms

        from su3d_bench.formats.pcd import read_pcd_points

        (folder / "a.pcd").write_bytes(forms()[form])
        return lambda: read_pcd_points(folder / "a.pcd", "map: a.pcd")

    return make


def _hdf5(**options: Any) -> Make:
    def make(folder: Path) -> Read:
        from test_hdf5 import write

        from su3d_bench.formats.hdf5 import largest_column, n_columns_of, read_rows

        path = write(folder, **options)
        asked = (lambda: n_columns_of(path, "a"), lambda: read_rows(path, 3, "a"), lambda: largest_column(path, 3, "a"))
        return lambda: every_one_of(iter(asked))

    return make


def _image(suffix: str) -> Make:
    def make(folder: Path) -> Read:
        import cv2
        from bombs import jpeg_of_scans

        from su3d_bench.formats.images import decode_colour, decode_depth, image_size, read_bytes

        values = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 80
        path, is_depth = folder / f"a{suffix}", suffix in (".depth.png", ".pgm")
        if suffix == ".pgm":
            path.write_bytes(b"P5\n# made\n32 24\n65535\n" + values.astype(">u2").tobytes())
        elif suffix == ".scans.jpg":
            path.write_bytes(jpeg_of_scans(64, 48, 3))
        else:
            cv2.imwrite(str(path), values if is_depth else np.repeat((values >> 8).astype(np.uint8)[..., None], 3, 2))
        decode = decode_depth if is_depth else decode_colour

        def asked() -> Iterator[Read]:
            content = read_bytes(path, "a")
            yield lambda: image_size(content)
            yield lambda: decode(content, "a")

        return lambda: every_one_of(asked())

    return make


def _queries(suffix: str) -> Make:
    def make(folder: Path) -> Read:
        from test_query_files import CSV, TOML

        from su3d_bench.questions.query_files import read_query_file

        path = folder / f"q{suffix}"
        path.write_text(CSV if suffix == ".csv" else TOML)
        return lambda: read_query_file(path)

    return make


def _questions(name: str, text_of: Callable[[Any], str]) -> Make:
    def make(folder: Path) -> Read:
        import test_question_files

        from su3d_bench.questions.question_files import is_foreign, read_foreign_queries, read_questions

        path = folder / name
        path.write_text(text_of(test_question_files))
        if name.startswith("v1"):
            answers = folder / "v1_balanced_sqa_annotations_val_scannetv2.json"
            answers.write_text(test_question_files.SQA3D_ANSWERS)
        asked: list[Read] = [partial(read_questions, path)]
        if name in ("q.json", "q.csv") and is_foreign(path):  # sentences to ground
            asked.append(partial(read_foreign_queries, path))
        return lambda: every_one_of(iter(asked))

    return make


SCAN = "scans/scene0000_00"
LOGGED: dict[str, Any] = {"pose": None, "trajectory": "trajectory.log"}
FILED: dict[str, Any] = {"intrinsics": None, "intrinsics_file": "camera.json"}
LISTED: dict[str, Any] = {"intrinsics": None, "intrinsics_file": "intrinsics.txt"}
TARGETS = (
    Target("replica camera", _replica, ("Replica/cam_params.json",), 0.15),
    Target("replica trajectory", _replica, ("Replica/room0/traj.txt",), 0.15),
    Target("replica images", _replica, ("Replica/room0/results/*",), 0.15),
    Target("replica marker", _replica, ("Replica/rooms.json",), 0.15),
    Target("replica mesh", _replica, ("replica_v1/room_0/habitat/*.ply", "Replica/room0_mesh.ply"), 0.15),
    Target("replica objects", _replica, ("replica_v1/room_0/habitat/*.json",), 0.15),
    Target("replica scene graphs", _replica, ("ReplicaSSG/*.json",), 0.15),
    Target("replica clouds", _replica, ("Replica-semantic/**/*.h5", "Replica/**/*.h5"), 0.15),
    Target("replica first pose", _replica, ("Replica-semantic/**/traj_w_c.txt",), 0.15),
    Target("replica labels", _replica, ("Replica/ground_truth/*.txt", "Replica/semantic_gt/*.txt"), 0.15),
    Target("scannet recording", _scannet, (f"{SCAN}/*.sens",), 0.15),
    Target("scannet meshes", _scannet, (f"{SCAN}/*.ply",), 0.15),
    Target("scannet segments", _scannet, (f"{SCAN}/*.segs.json",), 0.15),
    Target("scannet aggregation", _scannet, (f"{SCAN}/*.aggregation.json",), 0.15),
    Target("scannet table", _scannet, ("*.tsv",), 0.15),
    Target("scannet facts", _aligned_scannet, (f"{SCAN}/scene0000_00.txt",), 0.15),
    Target("openscan attributes", _openscan, ("*.json",)),
    *(Target(f"beacon3d {kind}", _beacon3d(kind), ("*.json",)) for kind in ("grounding", "qa")),
    Target("sens", _sens("sens01_toy.sens"), ("a.sens",)),
    Target("sens raw", _sens("sens02_toy_raw.sens"), ("a.sens",)),
    Target("scannet python export", _scannet_export("python"), (f"{SCAN}/*/*",), 0.15),
    Target("scannet c++ export", _scannet_export("c++"), (f"{SCAN}/frame*", f"{SCAN}/_info.txt"), 0.15),
    Target("scannetpp colmap", _scannetpp("colmap"), ("data/*/iphone/colmap/*",), 0.15),
    Target("scannetpp tracking", _scannetpp("tracking"), ("data/*/iphone/*.json",), 0.15),
    Target("scannetpp images", _scannetpp("colmap"), ("data/*/iphone/rgb/*", "data/*/iphone/depth/*"), 0.15),
    Target("scannetpp video", _scannetpp("tracking", packed=True), ("data/*/iphone/rgb.mkv",), 0.15),
    Target("scannetpp depth", _scannetpp("colmap", packed=True), ("data/*/iphone/depth.bin",), 0.15),
    Target("scannetpp depth stream", _depth_stream, ("depth.bin",), 0.15),
    Target("scannetpp depth blocks", _depth_blocks, ("depth.bin",), 0.15),
    Target("scannetpp mesh", _scannetpp("colmap"), ("data/*/scans/*.ply",), 0.15),
    Target("scannetpp annotation", _scannetpp("colmap"), ("data/*/scans/*.json", "data/*/scans/*.txt"), 0.15),
    Target("scannetpp lists", _scannetpp("colmap"), ("metadata/*/*", "splits/*"), 0.15),
    Target("arkitscenes images", _arkitscenes(), ("*/*/lowres_*/*.png", "*/*/confidence/*.png"), 0.15),
    Target("arkitscenes wide images", _arkitscenes("wide"), ("*/*/wide/*", "*/*/highres_depth/*"), 0.15),
    Target("arkitscenes cameras", _arkitscenes(is_3dod=True), ("3dod/*/*/*/*/*.pincam",), 0.15),
    Target("arkitscenes trajectory", _arkitscenes(), ("*/*/*.traj",), 0.15),
    Target("arkitscenes mesh", _arkitscenes(), ("*/*/*.ply",), 0.15),
    Target("opensun3d lists", _arkitscenes(), ("challenge_track_1/benchmark_file_lists/*",), 0.15),
    Target("opensun3d truth", _arkitscenes(), ("challenge_track_1/benchmark_data/*/*",), 0.15),
    Target("hm3dsem frames", _hm3dsem, ("hm3dsem_walks/*/*/rgb/*", "hm3dsem_walks/*/*/depth/*"), 0.3),
    Target("hm3dsem poses", _hm3dsem, ("hm3dsem_walks/*/*/pose/*",), 0.3),
    Target("hm3dsem truth", _hm3dsem, ("hm3dsem_walks/*/*/scene_info.json",), 0.5),
    Target("hm3dsem clouds", _hm3dsem, ("hm3dsem_walks/*/*/objects/*",), 0.3),
    Target("hm3dsem annotation", _hm3dsem, ("hm3d/*/*/*.txt",), 0.3),
    Target("rgbd description", _rgbd(camera_axes="opengl", depth_invalid=[3]), ("rgbd/desk/rgbd.toml",)),
    Target("rgbd frames", _rgbd(), ("rgbd/desk/data/colour/*", "rgbd/desk/data/depth/*")),
    Target("rgbd poses", _rgbd(), ("rgbd/desk/data/*.pose.txt",)),
    Target("rgbd log", _rgbd(**LOGGED), ("rgbd/desk/data/trajectory.log",)),
    Target("rgbd camera", _rgbd(**FILED), ("rgbd/desk/data/camera.json",)),
    Target("rgbd intrinsics", _rgbd(**LISTED), ("rgbd/desk/data/intrinsics.txt",)),
    Target("rgbd mesh", _rgbd(), ("rgbd/desk/data/mesh.ply",)),
    Target("tum lists", _tum, ("*/rgb.txt", "*/depth.txt", "*/associate.txt")),
    Target("tum trajectory", _tum, ("*/groundtruth.txt",)),
    Target("tum camera", _tum, ("*/camera.txt",)),
    Target("tum images", _tum, ("*/rgb/*", "*/depth/*")),
    Target("rooms cache", _rooms, ("a.npz",)),
    Target("rooms mesh", _rooms_mesh, ("a.npz",)),
    Target("openlex3d labels", _openlex3d, ("replica/room0/gt_categories.json",)),
    Target("openlex3d queries", _openlex3d, ("replica/room0/*_all.json",)),
    Target("openlex3d prompts", _openlex3d, ("replica/prompt_list.txt",)),
    Target("openlex3d cloud", _openlex3d, ("replica/room0/*.pcd",)),
    Target("openlex3d points of scannetpp", _openlex3d_points("scannetpp", "0a76e06478"), ("scannetpp/*/*.pth",)),
    Target("openlex3d objects of hm3d", _openlex3d_points("hm3d", "00824"), ("hm3d/00824/scene_info.json",)),
    Target("openlex3d clouds of hm3d", _openlex3d_points("hm3d", "00824"), ("hm3d/00824/objects/*.ply",)),
    *(Target(f"ply {form}", _ply(form), ("a.ply",)) for form in ("ascii", "binary_little_endian", "binary_big_endian")),
    *(Target(f"pcd {form}", _pcd(form), ("a.pcd",)) for form in ("ascii", "binary", "binary_compressed")),
    Target("hdf5 contiguous", _hdf5(), ("*.h5",)),
    Target("hdf5 chunked", _hdf5(chunks=(16, 3), compression="gzip", shuffle=True), ("*.h5",)),
    *(
        Target(f"image{suffix}", _image(suffix), ("a*",))
        for suffix in (".jpg", ".scans.jpg", ".png", ".depth.png", ".pgm", ".ppm")
    ),
    *(Target(f"queries{suffix}", _queries(suffix), ("q.*",)) for suffix in (".toml", ".csv")),
    Target("questions own", _questions("q.toml", lambda test: test.toml_text(test.SET[:2])), ("q.toml",)),
    Target("questions scanrefer", _questions("q.json", lambda test: test.SCANREFER), ("q.json",)),
    Target("questions nr3d", _questions("q.csv", lambda test: test.NR3D), ("q.csv",)),
    Target("questions sqa3d", _questions("v1_balanced_questions_val_scannetv2.json", lambda test: test.SQA3D), ("*",)),
)
