"""What a check of ScanNet's scans names, and what their digest follows."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from recording_files import pose
from scannet_scan import SCAN, WHERE, positions, write_scan

from su3d_bench.datasets.scannet.dataset import ScanNet
from su3d_bench.datasets.scannet.truth import TABLE_NAME


def test_every_fault_of_a_scan_is_named_at_once(tmp_path: Path) -> None:
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
