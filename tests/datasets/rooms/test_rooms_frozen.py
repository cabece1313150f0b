"""The frozen rooms are what they were: objects and trajectories by digest, images and scans within a tolerance.

Positions are compared in tenths of a millimetre: another CPU changes their last bits, not these digits. The case was
written by ``write_case`` below and changes only with ``Rooms.version``.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.rooms.dataset import DEFAULT_SCENES, RoomOptions, Rooms

CASE = Path(__file__).parents[2] / "cases" / "rooms_frozen.json"
SMALL = RoomOptions(width=64, height=48, n_frames=40)
SCANNED = "bathroom0"  # the smallest, since a scan takes seconds


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()


def _rounded(values: Float64Array) -> list[Any]:
    rounded: list[Any] = np.round(np.asarray(values) * 10_000).astype(np.int64).tolist()
    return rounded


def _facts(rooms: Rooms, scene: str) -> dict[str, Any]:
    objects = [
        [known.id, known.class_id, known.colour, known.material, known.size_word, known.support, known.model,
         _rounded(np.array([known.box_min, known.box_max]))]
        for known in rooms.objects(scene)
    ]  # fmt: skip
    frames = [rooms.frame(scene, index) for index in (0, 13, 29)]
    return {
        "objects": _digest(objects),
        "trajectory": _digest(_rounded(rooms.trajectory(scene))),
        "colour": [frame.rgb.mean(axis=(0, 1)).round(3).tolist() for frame in frames],
        "depth_m": [round(float(frame.depth_m.mean()), 5) for frame in frames],
        "n_vertices": len(rooms.scan(scene).vertices) if scene == SCANNED else None,
    }


def write_case(folder: Path) -> None:
    rooms = Rooms(folder, SMALL)
    CASE.write_text(json.dumps({scene: _facts(rooms, scene) for scene in DEFAULT_SCENES}, indent=1) + "\n")


@pytest.mark.parametrize("scene", DEFAULT_SCENES)
def test_rooms_have_not_changed(scene: str, rooms_data: Path) -> None:
    wanted, facts = json.loads(CASE.read_text())[scene], _facts(Rooms(rooms_data, SMALL), scene)
    assert facts["objects"] == wanted["objects"]
    assert facts["trajectory"] == wanted["trajectory"]
    assert np.allclose(facts["colour"], wanted["colour"], atol=0.1)
    assert np.allclose(facts["depth_m"], wanted["depth_m"], atol=1e-3)
    assert wanted["n_vertices"] is None or abs(facts["n_vertices"] / wanted["n_vertices"] - 1) < 1e-3
