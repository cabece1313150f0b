"""Replica's other ground truths: ConceptGraphs' clouds, scored end to end, and released label files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from damage import damages, outcomes, truncations
from replica_scene import CHAIR, QUADS, TABLE, TWO_OBJECTS, WALL, write_original, write_render
from scored_room import instances

from su3d_bench.datasets.ply import PlyElement, write_ply
from su3d_bench.datasets.replica import Replica
from su3d_bench.datasets.replica_clouds import N_EMBEDDING, read_first_pose
from su3d_bench.datasets.replica_label_files import OVO_CLASSES, read_whole_numbers
from su3d_bench.errors import DataError, GroundTruthMissing
from su3d_bench.protocols import load_protocol
from su3d_bench.scoring import combine, score_scene
from su3d_bench.types import Float32Array, Instances

Change = Callable[[Path], object]
SEQUENCE = "Replica-semantic/room_0/Sequence_1"
CLOUDS = f"{SEQUENCE}/saved-maps-gt/pointclouds"
REFERENCE = "Replica/room0/rgb_cloud/pointclouds/pc_points.h5"
RUG, FLOOR, DOOR, PICTURE = 98, 40, 37, 59


def write_table(path: Path, table: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset(path.stem, data=table)


def one_hot(labels: np.ndarray) -> Float32Array:
    rows: Float32Array = np.eye(N_EMBEDDING, dtype=np.float32)[labels]
    return rows


def first_pose() -> np.ndarray:
    """A turn about x, then z, and a shift."""
    a, b = 0.7, -1.9
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = about_z @ about_x
    matrix[:3, 3] = 0.3, -1.25, 1.5
    return matrix


def write_clouds(
    root: Path, points: np.ndarray, labels: np.ndarray, reference: np.ndarray, scene: str = "room0"
) -> None:
    """The labelled cloud, whose ``points`` are in the first camera's frame, and the reference cloud in the world."""
    native = f"{scene[:-1]}_{scene[-1]}"
    sequence = root / SEQUENCE.replace("room_0", native)
    clouds = sequence / "saved-maps-gt/pointclouds"
    write_table(clouds / "pc_points.h5", points.astype(np.float32))
    write_table(clouds / "pc_embeddings.h5", one_hot(labels))
    poses = np.stack([first_pose(), np.eye(4)])
    lines = [" ".join(repr(float(value)) for value in one.reshape(-1)) for one in poses]
    (sequence / "traj_w_c.txt").write_text("\n".join(lines) + "\n")
    write_table(root / REFERENCE.replace("room0", scene), reference.astype(np.float32))


# --- ConceptGraphs' clouds


def test_the_labelled_cloud_is_moved_by_the_first_pose_and_the_reference_cloud_is_not(tmp_path: Path) -> None:
    write_render(tmp_path)
    points = np.random.default_rng(0).random((5, 3))
    reference = np.array([[1.0, 2, 3], [4, 5, 6]])
    write_clouds(tmp_path, points, np.array([CHAIR, 0, WALL, 101, CHAIR]), reference)
    truth = Replica(tmp_path).ground_truth("room0", "conceptgraphs")
    expected = points @ first_pose()[:3, :3].T + first_pose()[:3, 3]
    np.testing.assert_allclose(truth.points, expected, atol=1e-6)
    assert truth.points.dtype == np.float32
    assert truth.semantic.tolist() == [CHAIR, 0, WALL, 101, CHAIR]
    assert truth.instance.tolist() == [0] * 5
    assert truth.evaluation_points is not None
    np.testing.assert_array_equal(truth.evaluation_points, reference)
    assert "Sequence_1/saved-maps-gt/pointclouds, moved by the first pose of traj_w_c.txt" in truth.source
    assert "room0/rgb_cloud/pointclouds/pc_points.h5" in truth.source


def test_labels_are_the_first_maximum_and_a_row_of_zeros_is_other(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    table = np.zeros((3, N_EMBEDDING), np.float32)
    table[1, [TABLE, WALL]] = 0.5
    table[2, CHAIR] = 1
    write_table(tmp_path / CLOUDS / "pc_embeddings.h5", table)
    assert Replica(tmp_path).ground_truth("room0", "conceptgraphs").semantic.tolist() == [0, TABLE, CHAIR]


@pytest.mark.parametrize("folder", ["Replica_semantic", "replica_semantic", "Replica_Dataset", "Replica", "."])
def test_the_clouds_are_found_in_the_usual_places(tmp_path: Path, folder: str) -> None:
    write_render(tmp_path)
    write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    target = tmp_path / folder / "room_0"
    target.parent.mkdir(exist_ok=True)
    (tmp_path / "Replica-semantic/room_0").rename(target)
    assert len(Replica(tmp_path).ground_truth("room0", "conceptgraphs").points) == 3


def test_without_clouds_one_line_says_what_is_needed_and_how_to_get_it(tmp_path: Path) -> None:
    write_render(tmp_path)
    with pytest.raises(
        GroundTruthMissing, match=r"expected room_0/Sequence_1/saved-maps-gt/pointclouds of its authors"
    ):
        Replica(tmp_path).ground_truth("room0", "conceptgraphs")
    write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    (tmp_path / REFERENCE).unlink()
    with pytest.raises(GroundTruthMissing, match=r"rgb_cloud/pointclouds/pc_points\.h5, are missing in .*run_slam_rgb"):
        Replica(tmp_path).ground_truth("room0", "conceptgraphs")


def with_table(name: str, table: np.ndarray) -> Change:
    return lambda root: write_table(root / name, table)


def with_text(name: str, text: str | bytes) -> Change:
    return lambda root: (root / name).write_bytes(text if isinstance(text, bytes) else text.encode())


NAN_POINT = np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]], np.float32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_table(f"{CLOUDS}/pc_points.h5", NAN_POINT), "pointclouds/pc_points.h5: point 1 is at [0.0, nan, 0.0]"),
        (with_table(f"{CLOUDS}/pc_points.h5", np.full((3, 3), 1e300)), "pc_points.h5: point 0 is at [inf, inf, inf]"),
        (with_table(f"{CLOUDS}/pc_points.h5", np.zeros((0, 3))), "pointclouds/pc_points.h5: holds no point; make"),
        (with_table(f"{CLOUDS}/pc_points.h5", np.zeros((2, 3))), "pc_embeddings.h5: has 3 rows, pc_points.h5 has 2"),
        (with_table(f"{CLOUDS}/pc_embeddings.h5", np.zeros((3, 101))), "has the shape (3, 101); expected (N, 102)"),
        (with_table(REFERENCE, NAN_POINT), "rgb_cloud/pointclouds/pc_points.h5: point 1 is at"),
        (with_table(REFERENCE, np.zeros((0, 3))), "rgb_cloud/pointclouds/pc_points.h5: holds no point"),
        (lambda root: (root / SEQUENCE / "traj_w_c.txt").unlink(), "Sequence_1/traj_w_c.txt cannot be read: No such"),
        (with_text(f"{SEQUENCE}/traj_w_c.txt", ""), "Sequence_1/traj_w_c.txt line 1 has 0 values; expected 16"),
        (with_text(f"{SEQUENCE}/traj_w_c.txt", "1 " * 10**6), "traj_w_c.txt line 1 has 2048 values; expected 16"),
        (with_text(f"{SEQUENCE}/traj_w_c.txt", "2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), "traj_w_c.txt line 1: not a rigid"),
        (with_text(f"{SEQUENCE}/traj_w_c.txt", "nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), "line 1: the pose holds 'nan'"),
        (with_text(f"{SEQUENCE}/traj_w_c.txt", b"\xff\xfe" * 99), "Sequence_1/traj_w_c.txt: is not a text file"),
    ],
)  # fmt: skip
def test_each_fault_of_the_clouds_is_one_clear_line(tmp_path: Path, change: Change, message: str) -> None:
    write_render(tmp_path)
    write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    change(tmp_path)
    with pytest.raises(DataError) as caught:
        Replica(tmp_path).ground_truth("room0", "conceptgraphs")
    assert str(caught.value).startswith("replica/room0: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@dataclass
class TextDirections:
    """An encoder that gives each text a direction of its own, the same in every process."""

    name: str = "directions"
    digest: str = "directions"
    dim: int = 24

    def encode_images(self, images: Any) -> Float32Array:
        raise AssertionError("scoring looks at no image")

    def encode_texts(self, texts: Any) -> Float32Array:
        rows = [np.random.default_rng(list(text.encode())).normal(size=self.dim) for text in texts]
        return np.stack([row / np.linalg.norm(row) for row in rows]).astype(np.float32)


# Classes in the labelled cloud of each scene: 'other', classes that every exclusion drops, and classes that stay.
SCENE_CLASSES = {"room0": [0, WALL, FLOOR, DOOR, CHAIR, TABLE, RUG], "office1": [0, WALL, 97, TABLE, 47, 95]}


@dataclass
class CloudScene:
    """What one scene's evaluation takes: the labelled cloud in its camera, the reference cloud, and a map."""

    points: Float32Array
    labels: np.ndarray
    reference: Float32Array
    prediction: Instances


def cloud_scene(scene: str) -> CloudScene:
    rng = np.random.default_rng(list(scene.encode()))
    labels = rng.choice(SCENE_CLASSES[scene], 90)
    labels[-1] = PICTURE  # in a far corner, where no reference point is nearest: a class of the clouds without points
    world = rng.random((90, 3)) * 2
    world[-1] = 30
    pose = first_pose()
    points = ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
    map_points = (rng.random((120, 3)) * 2).astype(np.float32)
    masks = [np.sort(rng.choice(120, rng.integers(5, 25), replace=False)) for _ in range(9)]
    features = rng.normal(size=(9, TextDirections.dim)).astype(np.float32)
    prediction = instances(map_points, [mask.astype(np.int32) for mask in masks], None, features)
    return CloudScene(points, labels, (rng.random((200, 3)) * 2).astype(np.float32), prediction)


def nearest_brute(candidates: np.ndarray, query: np.ndarray) -> int:
    return int(((candidates.astype(np.float64) - query.astype(np.float64)) ** 2).sum(axis=1).argmin())


def brute_confusion(scene: CloudScene, names: dict[int, str], excluded: set[str]) -> np.ndarray:
    """Steps 2 to 9 of the original evaluation, one reference point after another; rows are truth, by native id."""
    pose = first_pose().astype(np.float32)
    truth_points = scene.points @ pose[:3, :3].T + pose[:3, 3]
    vocabulary = [one for one in names if one in scene.labels and names[one] not in excluded]
    text = TextDirections().encode_texts([f"an image of {names[one]}" for one in vocabulary]).astype(np.float64)
    features = np.asarray(scene.prediction.features, np.float64)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    class_of_object = [vocabulary[int((text @ feature).argmax())] for feature in features]
    object_points = np.concatenate([scene.prediction.points[scene.prediction.mask(k)] for k in range(len(features))])
    object_classes = [class_of_object[k] for k in range(len(features)) for _ in range(len(scene.prediction.mask(k)))]
    confusion = np.zeros((102, 102), np.int64)
    for query in scene.reference:
        true = int(scene.labels[nearest_brute(truth_points, query)])
        if true in vocabulary:
            confusion[true, object_classes[nearest_brute(object_points, query)]] += 1
    return confusion


def brute_metrics(confusion: np.ndarray) -> dict[str, float]:
    """The row `all`: classes with a reference point, rows and columns cut together."""
    keep = np.flatnonzero(confusion.sum(axis=1))
    cut = confusion[np.ix_(keep, keep)].astype(float)
    hits, rows, columns = np.diag(cut), cut.sum(axis=1), cut.sum(axis=0)
    iou = hits / np.maximum(1, rows + columns - hits)
    return {
        "mAcc": float(np.mean(hits / np.maximum(1, rows))),
        "mIoU": float(iou.mean()),
        "F-mIoU": float((rows / rows.sum() * iou).sum()),
    }


@pytest.mark.parametrize("n_exclude", [1, 4, 6])
def test_scores_from_files_are_those_of_the_original_steps_done_by_brute_force(tmp_path: Path, n_exclude: int) -> None:
    rules = load_protocol(f"replica-conceptgraphs-ex{n_exclude}")
    excluded = set(["other", "floor", "wall", "ceiling", "door", "window"][:n_exclude])
    names = {entry.id: entry.name for entry in rules.classes}
    scores, confusion = {}, np.zeros((102, 102), np.int64)
    for name in SCENE_CLASSES:
        scene = cloud_scene(name)
        write_render(tmp_path, name, 1)
        write_clouds(tmp_path, scene.points, scene.labels, scene.reference, name)
        truth = Replica(tmp_path).ground_truth(name, "conceptgraphs")
        scores[name] = score_scene(rules, truth, scene.prediction, TextDirections())
        of_scene = brute_confusion(scene, names, excluded)
        assert scores[name].n_scored == of_scene.sum() > 50
        confusion += of_scene
    expected = brute_metrics(confusion)
    found = combine(rules, scores).metrics
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=1e-12)
    assert 0.02 < expected["mAcc"] < 0.9


# --- released label files


def write_mesh(path: Path, n_vertices: int, at: float = 0.0) -> None:
    axis = np.arange(n_vertices, dtype=np.float32) + np.float32(at)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, [PlyElement("vertex", n_vertices, {"x": axis, "y": axis.copy(), "z": axis.copy()})])


def write_labels(root: Path, name: str, values: list[int]) -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{value}\n" for value in values))
    return path


def test_instances_of_the_file_stand_on_the_vertices_of_the_renders_mesh(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 7, at=100)
    write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS, n_vertices=9)
    write_labels(tmp_path, "Replica/ground_truth/room0.txt", [20066, 80066, 30, 256003, 20000, 0, 20066])
    truth = Replica(tmp_path).ground_truth("room0", "openmask3d")
    assert truth.semantic.tolist() == [CHAIR, TABLE, 0, 0, CHAIR, 0, CHAIR]
    assert truth.instance.tolist() == [2, 3, 0, 0, 1, 0, 2]  # in the order of the values
    assert truth.points[:, 0].tolist() == [100, 101, 102, 103, 104, 105, 106]
    assert truth.source == "ground_truth/room0.txt, class id * 1000 + instance of each vertex of room0_mesh.ply"


def test_labels_of_the_original_mesh_are_recognised_by_their_number(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 7)
    write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS, n_vertices=9)
    write_labels(tmp_path, "Replica/ground_truth/room_0.txt", [20001] * 9)
    truth = Replica(tmp_path).ground_truth("room0", "openmask3d")
    assert truth.points[5].tolist() == [2, 1, 0]
    assert truth.source.endswith("vertex of habitat/mesh_semantic.ply")


@pytest.mark.parametrize(
    ("variant", "name", "value"),
    [
        ("openmask3d", "Replica/ground_truth/room0.txt", 20001),
        ("openmask3d", "replica/ground_truth/room_0.txt", 20001),
        ("openmask3d", "replica_gt_instances/instance_labels_room0.txt", 20001),
        ("openmask3d", "instance_gt/validation/room0.txt", 20001),
        ("ovo-51", "Replica/semantic_gt/room0.txt", 20),
        ("ovo-51", "opennerf/datasets/replica_gt_semantics/semantic_labels_room0.txt", 20),
    ],
)
def test_label_files_are_found_in_the_usual_places(tmp_path: Path, variant: str, name: str, value: int) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 2)
    write_labels(tmp_path, name, [value] * 2)
    assert Replica(tmp_path).ground_truth("room0", variant).semantic.tolist() == [CHAIR] * 2


def test_classes_of_the_file_are_replicas_own_ids_and_undefined_ones_are_void(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 6)
    write_labels(tmp_path, "Replica/semantic_gt/room0.txt", [20, -1, 93, -2, 256, 3])
    truth = Replica(tmp_path).ground_truth("room0", "ovo-51")
    assert truth.semantic.tolist() == [20, 0, 93, 0, 0, 3]
    assert truth.instance.tolist() == [0] * 6
    assert truth.source == "semantic_gt/room0.txt, the class of each vertex of room0_mesh.ply"


def test_the_51_classes_are_those_of_the_conceptgraphs_list_without_other() -> None:
    listed = {entry.id for entry in load_protocol("replica-conceptgraphs-ex6").classes}
    assert set(OVO_CLASSES) == listed - {0}
    assert len(OVO_CLASSES) == 51


def test_missing_label_files_are_said_in_one_line_that_names_the_place_and_the_source(tmp_path: Path) -> None:
    write_render(tmp_path)
    for variant, place in (("openmask3d", "ground_truth/room0.txt"), ("ovo-51", "semantic_gt/room0.txt")):
        with pytest.raises(
            GroundTruthMissing, match=rf"no ground truth '{variant}'; expected {place}, one label a ver"
        ):
            Replica(tmp_path).ground_truth("room0", variant)


INSTANCES, CLASSES = "Replica/ground_truth/room0.txt", "Replica/semantic_gt/room0.txt"


@pytest.mark.parametrize(
    ("variant", "text", "message"),
    [
        ("openmask3d", b"20001\n" * 3, "room0.txt: has 3 labels, room0_mesh.ply 2 and habitat/mesh_semantic.ply 9"),
        ("openmask3d", b"", "room0.txt: has 0 labels, room0_mesh.ply 2 and habitat/mesh_semantic.ply 9 vertices"),
        ("openmask3d", b"20001\n-970\n", "room0.txt: holds -970; expected class id * 1000 + instance, 0 or more"),
        ("openmask3d", b"20001\n102005\n", "room0.txt: 102005 is of class 102, Replica has 1 to 101; an inst"),
        ("openmask3d", b"20001\n\n", "room0.txt: line 2 is ''; expected one whole number a line"),
        ("openmask3d", b"20001\n2.0e4\n", "room0.txt: line 2 is '2.0e4'; expected one whole number a line"),
        ("openmask3d", b"20001\n99999999999\n", "room0.txt: line 2 is '99999999999'; expected one whole number"),
        ("openmask3d", b"20001\n\x1b[31m\n", r"room0.txt: line 2 is '\x1b[31m'; expected one whole number"),
        ("openmask3d", b"2" * 3_000_000, "room0.txt: line 1 is '22222222222222222222'; expected one whole number"),
        ("ovo-51", b"0\n1\n", "room0.txt: holds the class 0, none of the 51 Replica ids of this evaluation"),
        ("ovo-51", b"20\n52\n20\n", "room0.txt: has 3 labels, room0_mesh.ply 2 and"),
        ("ovo-51", b"20\n1\n", "room0.txt: holds the class 1, none of the 51 Replica ids"),
    ],
)  # fmt: skip
def test_each_fault_of_a_label_file_is_one_clear_line(tmp_path: Path, variant: str, text: bytes, message: str) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 2)
    write_original(tmp_path, QUADS, [0, 0, 5, 5], TWO_OBJECTS)
    path = write_labels(tmp_path, INSTANCES if variant == "openmask3d" else CLASSES, [])
    path.write_bytes(text)
    with pytest.raises(DataError) as caught:
        Replica(tmp_path).ground_truth("room0", variant)
    assert str(caught.value).startswith("replica/room0: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_labels_without_any_mesh_are_refused(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_labels(tmp_path, INSTANCES, [20001])
    with pytest.raises(DataError, match="neither the mesh of the render nor that of the original release is here"):
        Replica(tmp_path).ground_truth("room0", "openmask3d")


def test_lines_beyond_the_mesh_are_counted_and_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "labels.txt"
    path.write_bytes(b"3001\r\n" * 10 + b" 3002")
    values, n_lines = read_whole_numbers(path, 4, "here")
    assert (values.tolist(), n_lines) == ([3001] * 4, 11)


def test_the_released_instances_as_a_prediction_score_exactly_one(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 360)
    write_labels(tmp_path, INSTANCES, [20001] * 120 + [80001] * 120 + [30] * 120)
    truth = Replica(tmp_path).ground_truth("room0", "openmask3d")
    masks = [np.arange(120, dtype=np.int32), np.arange(120, 240, dtype=np.int32)]
    rules = load_protocol("replica-openmask3d-released")
    score = score_scene(rules, truth, instances(truth.points, masks, ["chair", "table"]), None)
    metrics = combine(rules, {"room0": score}).metrics
    assert [metrics[name] for name in ("AP", "AP50", "AP25")] == [1.0, 1.0, 1.0]


def test_more_instances_than_the_format_has_are_refused(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 1000)
    write_labels(tmp_path, INSTANCES, [20001 + i for i in range(900)] + [80001 + i for i in range(100)])
    with pytest.raises(DataError, match=r"room0\.txt: holds 1000 instances; a scene of this format has at most 999"):
        Replica(tmp_path).ground_truth("room0", "openmask3d")


def test_damaged_label_files_are_read_or_refused_in_one_line(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 60)
    path = write_labels(tmp_path, INSTANCES, [20001, 93002, 30] * 20)
    content, replica = path.read_bytes(), Replica(tmp_path)

    def read(damaged: bytes) -> None:
        path.write_bytes(damaged)
        replica.ground_truth("room0", "openmask3d")

    n_read, n_refused = outcomes(read, truncations(content), must_name="replica/room0: room0.txt")
    assert n_read == 2  # the last number without its end of line, and with a digit less
    assert n_refused == len(content) - 2
    n_read, n_refused = outcomes(read, damages(content), must_name="replica/room0: room0.txt")
    assert min(n_read, n_refused) > 100
    assert n_read + n_refused == 2_000


def test_files_and_digest_cover_every_released_truth(tmp_path: Path) -> None:
    write_render(tmp_path)
    write_mesh(tmp_path / "Replica/room0_mesh.ply", 2)
    write_clouds(tmp_path, np.zeros((3, 3)), np.zeros(3, int), np.zeros((1, 3)))
    write_labels(tmp_path, INSTANCES, [20001] * 2)
    write_labels(tmp_path, CLASSES, [20] * 2)
    replica = Replica(tmp_path)
    assert replica.status("room0").endswith("; also conceptgraphs, openmask3d, ovo-51")
    assert set(replica.files("room0")) == {path for path in tmp_path.rglob("*") if path.is_file()}
    digests = {replica.digest("room0")}
    (tmp_path / REFERENCE).rename(tmp_path / "away")
    assert "; also conceptgraphs without its pc_points.h5, openmask3d" in replica.status("room0")
    (tmp_path / "away").rename(tmp_path / REFERENCE)
    for path in (f"{CLOUDS}/pc_embeddings.h5", f"{SEQUENCE}/traj_w_c.txt", REFERENCE, INSTANCES, CLASSES):
        content = bytearray((tmp_path / path).read_bytes())
        content[len(content) // 2] ^= 1
        (tmp_path / path).write_bytes(bytes(content))
        digests.add(replica.digest("room0"))
    assert len(digests) == 6


def test_the_first_pose_is_read_in_single_precision(tmp_path: Path) -> None:
    path = tmp_path / "traj_w_c.txt"
    path.write_text(f"1 0 0 {1 / 3!r} 0 1 0 0 0 0 1 0 0 0 0 1\nno pose\n")
    pose = read_first_pose(path, "here")
    assert pose.dtype == np.float32
    assert pose[0, 3] == np.float32(1 / 3)
