"""The ScanNet dataset on small scans in common layouts: places, splits, frames, options, and a scored run."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scannet_scan as made
from recording_files import HEIGHT_M, LEFT, RIGHT, floor_image, pose
from scannet_scan import SCAN, WHERE, positions, write_python_export, write_scan

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.scannet.dataset import ScanNet
from su3d_bench.datasets.scannet.folders import PAPER_SCENES, split_scenes
from su3d_bench.datasets.scannet.recordings import read_walk
from su3d_bench.datasets.scannet.truth import TABLE_NAME


@pytest.mark.parametrize("place", [".", "scannet/scans", "ScanNet/scans_test", "scans/val"])
def test_scans_are_found_in_every_common_layout(tmp_path: Path, place: str) -> None:
    write_scan(tmp_path, place=place)
    found = ScanNet(tmp_path)
    assert list(found.scenes()) == [SCAN]
    assert list(found.places()) == [tmp_path / place]
    assert len(found.frames(SCAN, 1)) == 5
    assert "scannet200-vertices" in found.ground_truth(SCAN, "scannet200-vertices").variant


def test_recording_and_ground_truth_may_be_in_two_places(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    (tmp_path / "scannet" / SCAN).mkdir(parents=True)
    (folder / f"{SCAN}.sens").rename(tmp_path / "scannet" / SCAN / f"{SCAN}.sens")
    scannet = ScanNet(tmp_path)
    assert len(scannet.frames(SCAN, 1)) == 5
    assert scannet.ground_truth(SCAN, "nyu40-vertices").instance.max() == 2
    assert scannet.status(SCAN) == "5 frames, ground truth"


def test_frames_match_the_recording_on_the_depth_grid(tmp_path: Path) -> None:
    write_scan(tmp_path)
    frames = ScanNet(tmp_path).frames(SCAN, 2)
    assert [frames[i].index for i in range(len(frames))] == [0, 2, 4]
    frame = frames[-1]
    assert frame.timestamp_s == pytest.approx(1 + 4 * 0.033333)
    np.testing.assert_array_equal(frame.camera_to_world, pose(positions(5)[4]))
    assert frame.depth_m.shape == made.DEPTH_SIZE[::-1]
    assert (frame.depth_m == HEIGHT_M).all()
    assert frame.intrinsics.tolist() == [[32, 0, 15.5], [0, 32, 11.5], [0, 0, 1]]
    # twice as many colour pixels: the edge between the halves lies between two depth pixels
    np.testing.assert_array_equal(frames[1].rgb, floor_image(made.DEPTH_SIZE, 2.0))
    assert frames[1].rgb[0, [15, 16]].tolist() == [list(LEFT), list(RIGHT)]
    with pytest.raises(IndexError):
        frames[3]


def test_colour_grid_keeps_colour_and_thins_depth(tmp_path: Path) -> None:
    write_scan(tmp_path)
    frame = made.dataset(tmp_path, grid="colour").frames(SCAN, 1)[0]
    np.testing.assert_array_equal(frame.rgb, floor_image(made.COLOUR_SIZE, 1.0))
    assert np.count_nonzero(frame.depth_m) == made.DEPTH_SIZE[0] * made.DEPTH_SIZE[1]
    assert frame.intrinsics.tolist() == [[64, 0, 31.5], [0, 64, 23.5], [0, 0, 1]]


def test_axis_align_transforms_poses_and_mesh_alike(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    plain, turned = made.dataset(tmp_path), made.dataset(tmp_path, axis_align=True)
    motion = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    before, after = plain.frames(SCAN, 1)[3], turned.frames(SCAN, 1)[3]
    np.testing.assert_allclose(after.camera_to_world, motion @ before.camera_to_world)
    points = [one.ground_truth(SCAN, "nyu40-vertices").points for one in (plain, turned)]
    np.testing.assert_allclose(points[1], points[0] @ motion[:3, :3].T + motion[:3, 3], atol=1e-5)
    np.testing.assert_array_equal(turned.instance_mesh(SCAN).vertices, points[1])
    assert plain.digest(SCAN) != turned.digest(SCAN)
    (folder / f"{SCAN}.txt").unlink()
    assert len(made.dataset(tmp_path).frames(SCAN, 1)) == 5
    with pytest.raises(DataError, match=rf"^{WHERE}: {SCAN}\.txt is missing; it is needed for wall alignment"):
        made.dataset(tmp_path, axis_align=True).frames(SCAN, 1)


def test_source_option_selects_recording_or_export(tmp_path: Path) -> None:
    write_python_export(write_scan(tmp_path))
    depths = {
        kind: made.dataset(tmp_path, source=kind).frames(SCAN, 1)[0].depth_m.max()
        for kind in ("auto", "sens", "python")
    }
    assert depths["auto"] == depths["sens"] == 2.0 != depths["python"]
    assert made.dataset(tmp_path, source="python").status(SCAN) == "4 exported frames, ground truth"
    assert [frame.index for frame in made.dataset(tmp_path, source="python").frames(SCAN, 1)] == [0, 1, 3]
    assert made.dataset(tmp_path, source="cpp").status(SCAN) == "no recording, ground truth"
    with pytest.raises(DataError, match=rf"^{WHERE}: no recording in .*; looked for _info\.txt"):
        made.dataset(tmp_path, source="cpp").frames(SCAN, 1)


def poses_alone(poses: Sequence[np.ndarray], step: int = 1) -> Any:
    """A recording of poses only."""
    return SimpleNamespace(where=WHERE, poses=lambda: np.array(poses), numbers=np.arange(len(poses)) * step)


def turned(angle: float) -> Float64Array:
    return np.array(
        [[math.cos(angle), -math.sin(angle), 0, 0], [math.sin(angle), math.cos(angle), 0, 0], *np.eye(4)[2:]]
    )


def test_which_poses_are_lost() -> None:
    quarter = np.array([[0.0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]])
    nan, one_inf, zero = turned(0.1), turned(0.2), np.zeros((4, 4))
    nan[2, 3], one_inf[0, 1] = np.nan, np.inf
    walk = read_walk(poses_alone([turned(0.3), made.LOST, nan, one_inf, zero, quarter]))
    assert walk.is_usable.tolist() == [True, False, False, False, False, True]


def test_stride_counts_at_full_rate_even_if_an_export_skips_frames() -> None:
    every_second = read_walk(poses_alone([turned(0.01 * i) for i in range(40)], step=2))
    assert every_second.numbers[every_second.every(10)].tolist() == [0, 10, 20, 30, 40, 50, 60, 70]
    every_fourth = read_walk(poses_alone([turned(0.01 * i) for i in range(10)], step=4))
    assert every_fourth.numbers[every_fourth.every(10)].tolist() == [0, 12, 20, 32]
    assert every_fourth.every(1).tolist() == list(range(10))


def test_official_splits_are_complete_and_disjoint() -> None:
    lists = {split: split_scenes(split) for split in ("train", "val", "test")}
    assert [len(scans) for scans in lists.values()] == [1201, 312, 100]
    assert len({scan for scans in lists.values() for scan in scans}) == 1613
    assert set(PAPER_SCENES) <= {*lists["train"], *lists["val"]}


def test_scan_without_ground_truth_has_frames_and_a_reason(tmp_path: Path) -> None:
    for scan in (SCAN, "scene0707_00"):
        made.write_recording(tmp_path / scan / f"{scan}.sens")
    scannet = ScanNet(tmp_path)
    assert (
        scannet.status(SCAN)
        == f"5 frames, no ground truth, {SCAN}_vh_clean_2.ply is missing; expected in {tmp_path / SCAN}"
    )
    with pytest.raises(
        GroundTruthMissing, match=r"scene0707_00_vh_clean_2\.ply is missing; it is not published for test scans"
    ):
        scannet.instance_mesh("scene0707_00")
    made.write_floor_truth(tmp_path / SCAN)
    (tmp_path / SCAN / f"{SCAN}.aggregation.json").unlink()
    with pytest.raises(
        GroundTruthMissing, match=r"no ground truth, scene0000_00\.aggregation\.json is missing; expected"
    ):
        scannet.ground_truth(SCAN, "nyu40-vertices")
    with pytest.raises(GroundTruthMissing, match=r"no ground truth 'nyu20-vertices'; did you mean 'nyu40-vertices'\?"):
        scannet.ground_truth(SCAN, "nyu20-vertices")


@pytest.mark.parametrize("profile", ["oracle", "embedded"])
def test_run_on_a_scan_is_scored_under_the_benchmark_protocols(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, profile: str
) -> None:
    """A chair and a couch of 2 x 2 m, seen from above: with true masks the map has exactly these two."""
    folder = write_scan(tmp_path / "data")
    made.write_recording(folder / f"{SCAN}.sens", 9, (4,), made.header((256, 192), (128, 96)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    protocols = ["scannet-instance", "scannet-semantic", "scannet200-instance"]
    words = ["run", "--scenes", WHERE, "--methods", "opensu3d", "--profile", profile, "--set", "opensu3d.stride=2"]
    assert main([*words, "--protocols", *protocols, "--out", "out", "--jobs", "1", "--no-pictures", "--quiet"]) == 0
    rows = {row["protocol"]: row for row in json.loads(Path("out/metrics.json").read_text())["results"]}
    assert list(rows) == protocols
    for row in rows.values():
        assert row["unscored"] == [] and row["result"]["n_predictions"] == {WHERE: 2}
        assert all(math.isfinite(row["result"]["metrics"][name]) for name in row["headline"])
    assert rows["scannet-instance"]["ceiling"]["AP"] == rows["scannet200-instance"]["ceiling"]["AP"] == 1
    assert rows["scannet-semantic"]["ceiling"]["mIoU"] == 1
    if profile == "oracle":
        assert rows["scannet-instance"]["result"]["metrics"]["AP25"] == 1
        assert rows["scannet200-instance"]["result"]["metrics"]["AP25"] == 1
    log = Path(f"out/scenes/scannet.{SCAN}/opensu3d/log.txt").read_text()
    assert f"{WHERE}: frames without a pose, excluded: 1 of 9 (the first: 4)" in log


def test_all_faults_of_a_scan_are_named_at_once(tmp_path: Path) -> None:
    folder = write_scan(tmp_path, lost=(1,))
    assert list(ScanNet(tmp_path).problems(SCAN)) == []
    content = (folder / f"{SCAN}.sens").read_bytes()
    for x_m in (positions(5)[2], positions(5)[4]):  # stretched along the view
        content = content.replace(
            pose(x_m).astype("<f4").tobytes(), (pose(x_m) @ np.diag([1, 1, 2, 1])).astype("<f4").tobytes()
        )
    (folder / f"{SCAN}.sens").write_bytes(content)
    (folder / f"{SCAN}.txt").write_text("axisAlignment = 1 2 3\n")
    (folder / f"{SCAN}.aggregation.json").write_text("{")
    (folder / f"{SCAN}_vh_clean_2.labels.ply").write_text("ply")
    (tmp_path / TABLE_NAME).write_text("id\n")
    lines = list(ScanNet(tmp_path).problems(SCAN))
    assert lines[:2] == [
        f"{WHERE}: frame {i}: the pose is not a rigid motion; copy the recording again" for i in (2, 4)
    ]
    assert [line.split(": ")[1] for line in lines[2:]] == [
        TABLE_NAME,
        f"{SCAN}.txt",
        f"{SCAN}.aggregation.json",
        f"{SCAN}_vh_clean_2.labels.ply",
    ]
    (folder / f"{SCAN}.aggregation.json").unlink()
    os.truncate(folder / f"{SCAN}.sens", 1000)
    lines = list(ScanNet(tmp_path).problems(SCAN))
    assert lines[0].startswith(f"{WHERE}: {SCAN}.sens: frame ") and len(lines) == 4
