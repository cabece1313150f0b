"""Replica's boxes as ground truth: scenes without mesh, without frames, or without both."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from box_room import CLASSES, SIZE, write_box_room
from replica_scene import box

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import LabelSet, ObjectBoxes, OrientedBox
from su3d_bench.datasets.replica import checks
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.perception.oracle import OracleConfig, OracleSegmenter

INFO = "replica_v1/room_0/habitat/info_semantic.json"
THICK_M = 0.1
THINGS = {7: "chair", 8: "lamp"}  # not visible in the frames


def side_box(side: int) -> dict[str, object]:
    """The flat box of one of the room's six sides, centred on the wall."""
    axis, is_high = divmod(side - 1, 2)
    centre, sizes = SIZE / 2, SIZE.copy()
    centre[axis], sizes[axis] = is_high * SIZE[axis], THICK_M
    return box(centre, sizes)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene with frames and boxes but no mesh."""
    write_box_room(tmp_path)
    info = tmp_path / INFO
    table = json.loads(info.read_text())
    for row in table["objects"]:
        row["oriented_bbox"] = side_box(row["id"])
    ids = {row["name"]: row["id"] for row in table["classes"]}
    for number, name in THINGS.items():
        small = box((0, 0, 0.25), (0.5, 0.5, 0.5), translation=(number - 6.5, 0.5, 0))
        table["objects"].append({"id": number, "class_id": ids[name], "oriented_bbox": small})
    info.write_text(json.dumps(table))
    info.with_name("mesh_semantic.ply").unlink()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    return tmp_path


def test_boxes_are_ground_truth_with_points_on_their_sides_and_classes(root: Path) -> None:
    truth = Replica(root).ground_truth("room0", "boxes")
    assert truth.boxes is not None and sorted(truth.boxes.boxes) == sorted(set(truth.instance)) == list(range(2, 10))
    names = {int(i): truth.labels.name_of(int(c)) for i, c in zip(truth.instance, truth.semantic, strict=True)}
    assert names == {number + 1: name for number, name in {**CLASSES, **THINGS}.items()}
    for instance, known in truth.boxes.boxes.items():
        points = truth.points[truth.instance == instance].astype(np.float64)
        np.testing.assert_allclose(np.ptp(points, axis=0), known.sizes, atol=1e-6)
        to_side = np.abs(np.abs((points - known.centre) @ known.rotation) - known.sizes / 2).min(axis=1)
        assert to_side.max() < 1e-6


def test_smallest_box_containing_a_point_gets_it() -> None:
    boxes = {
        7: OrientedBox(np.zeros(3), np.full(3, 4.0), np.eye(3)),
        3: OrientedBox(np.zeros(3), np.ones(3), np.eye(3)),
    }
    known = ObjectBoxes(boxes, {7: 1, 3: 2}, LabelSet("a", (1, 2), ("room", "chair")))
    points = np.array([[0.4, 0, 0], [0.54, 0, 0], [0.56, 0, 0], [2.04, 0, 0], [2.06, 0, 0]])
    assert known.instance_at(points, 0.05).tolist() == [3, 3, 7, 7, 0]


def test_boxes_give_perfect_masks(root: Path) -> None:
    replica = Replica(root)
    with pytest.raises(GroundTruthMissing):
        replica.instance_mesh("room0")
    boxes = replica.ground_truth("room0", "boxes").boxes
    assert boxes is not None
    frame = replica.frames("room0", 1)[0]
    regions = OracleSegmenter(boxes, OracleConfig(min_pixels=10)).segment(frame)
    assert regions.masks.sum() == frame.depth_m.size and not (regions.masks.sum(axis=0) > 1).any()
    assert regions.names is not None and set(regions.names) <= {"wall", "floor", "ceiling"} and len(regions.names) >= 3
    words = "run --scenes replica/room0 --profile oracle --stride 4 --no-pictures --jobs 1 --quiet --out out"
    assert main(words.split()) == 0


def test_scene_without_mesh_is_scored_by_its_boxes(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "--scenes", "replica/room0", "--methods", "oracle", "--no-pictures", "--jobs", "1"]
    assert main([*words, "--all-protocols", "--out", "every"]) == 0
    answer = capsys.readouterr()
    assert "the protocol replica-boxes scores it by the boxes of its objects" in answer.out + answer.err
    assert main([*words, "--protocols", "replica-boxes", "--out", "out"]) == 0
    assert "replica-boxes" in capsys.readouterr().out
    (result,) = json.loads(Path("out/metrics.json").read_text())["results"]
    assert (result["protocol"], result["kind"], result["n_planned"]) == ("replica-boxes", "boxes", 1)
    assert set(result["result"]["metrics"].values()) == {1.0} and set(result["ceiling"].values()) == {1.0}
    assert set(result["result"]["per_class"]["chair"].values()) == {1.0}
    assert main(["evaluate", "out", "--dataset", "replica", "--all-protocols"]) == 2
    assert "the protocol replica-boxes scores it by the boxes of its objects" in capsys.readouterr().err
    table = ["evaluate", "out", "--dataset", "replica", "--protocols", "replica-boxes", "--json", "a.json", "--quiet"]
    assert main([*table, "--per-class"]) == 0
    scored = json.loads(Path("a.json").read_text())["protocols"]["replica-boxes"]
    assert scored["metrics"] == {name.lower(): 1.0 for name in result["result"]["metrics"]} == scored["ceiling"]
    # a lamp of half a metre whose true box is shifted by a quarter: an IoU of a third
    info = Path(INFO)
    told_otherwise = json.loads(info.read_text())
    straight = next(row for row in told_otherwise["objects"] if row["id"] == 8)["oriented_bbox"]["orientation"]
    straight["translation"][0] += 0.25
    info.write_text(json.dumps(told_otherwise))
    assert main(table) == 0
    moved = json.loads(Path("a.json").read_text())["protocols"]["replica-boxes"]
    assert (moved["metrics"]["ap25"], moved["metrics"]["ap50"], moved["metrics"]["centroid"]) == (1.0, 0.5, 1.0)
    assert moved["per_class"]["lamp"]["ap50"] == 0.0
    for verb in ("tables", "html"):
        assert main(["report", verb, "out"]) == 0
    assert "| oracle | 100.0 | 100.0 | 100.0    | 100.0 |" in capsys.readouterr().out


def test_table_without_boxes_is_missing_ground_truth_and_too_many_are_rejected(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = root / INFO
    table = json.loads(info.read_text())
    with monkeypatch.context() as patch:
        patch.setattr(checks, "MAX_OBJECTS", 7)
        with pytest.raises(DataError, match="8 objects have a box; expected at most 7"):
            Replica(root).ground_truth("room0", "boxes")
    for row in table["objects"]:
        del row["oriented_bbox"]
    info.write_text(json.dumps(table))
    with pytest.raises(GroundTruthMissing, match="no object with a class has a box"):
        Replica(root).ground_truth("room0", "boxes")
