"""What holds for every corruption of calibration, depth, poses and time, whatever it does."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from recordings import N_FRAMES, SCENES, recording
from severity_measures import PLACES, apply_to_frame, apply_to_order, apply_to_poses, damage, result_bytes

from su3d_bench.corruptions import calibration, depth, poses, time
from su3d_bench.corruptions.model import MAX_SEVERITY, Corruption, Recording, generator

ROWS = (*calibration.ROWS, *depth.ROWS, *poses.ROWS, *time.ROWS)
FRAME_ROWS = [row for row in ROWS if row.stage == "frame"]
WITHOUT_DRAWS = {
    f"{family}/{name}"
    for family, names in {
        "depth": ("quantisation", "edge-loss", "dark-holes", "range"),
        "time": ("depth-lag", "colour-lag"),
    }.items()
    for name in names
}
CHANGED = {"focal": "intrinsics", "principal-point": "intrinsics", "colour-lag": "rgb"}  # others change depth
NESTED = [row for row in ROWS if row.name in ("edge-loss", "holes", "dark-holes", "range", "lost-bursts")]
OTHER_SCENES = tuple(f"scene{k}" for k in range(8))


def by_address(row: Corruption) -> str:
    return row.address


every_row = pytest.mark.parametrize("row", ROWS, ids=by_address)
every_frame_row = pytest.mark.parametrize("row", FRAME_ROWS, ids=by_address)


def test_addresses_are_unique_and_every_value_has_a_source() -> None:
    assert len({row.address for row in ROWS}) == len(ROWS) == 24
    assert [row.address for row in ROWS if not row.source.endswith(".") or not row.unit] == []


@every_row
@pytest.mark.parametrize("scene", SCENES)
def test_each_severity_is_worse_than_the_one_below(row: Corruption, scene: str) -> None:
    found = [damage(row, row.value_at(severity), scene) for severity in range(MAX_SEVERITY + 1)]
    assert found[0] == pytest.approx(0, abs=1e-6)
    assert np.diff(found).min() > 0, found


@every_row
def test_the_neutral_value_changes_nothing(row: Corruption) -> None:
    clean = replace(row, function=lambda value, *rest: value)
    assert result_bytes(row, row.neutral) == result_bytes(clean, row.neutral)


@every_row
def test_the_same_seed_gives_the_same_bytes_and_other_seeds_and_scenes_differ(row: Corruption) -> None:
    value = row.values[2]
    assert result_bytes(row, value) == result_bytes(row, value)
    per_seed = {result_bytes(row, value, seed=seed) for seed in range(8)}
    per_scene = {result_bytes(row, value, scene) for scene in OTHER_SCENES}
    assert (len(per_seed) > 1) == (len(per_scene) > 1) == (row.address not in WITHOUT_DRAWS)


@every_frame_row
def test_frames_share_their_random_numbers_only_in_corruptions_per_scene(row: Corruption) -> None:
    clean = recording()
    found = {apply_to_frame(row, row.values[2], index=k, clean=clean).depth_m.tobytes() for k in range(6)}
    assert (len(found) == 1) == (row.per_scene or row.address in WITHOUT_DRAWS)
    assert row.per_scene == (row.family == "calibration" or row.name == "scale")


@every_frame_row
@pytest.mark.parametrize("scene", SCENES)
def test_one_part_of_a_frame_changes_and_depth_stays_valid(row: Corruption, scene: str) -> None:
    clean = recording(scene).frames[N_FRAMES - 1]
    found = apply_to_frame(row, row.values[-1], scene, N_FRAMES - 1)
    assert found.depth_m.dtype == np.float32 and found.depth_m.shape == clean.depth_m.shape
    assert np.isfinite(found.depth_m).all() and found.depth_m.min() >= 0
    assert found.depth_m[found.depth_m > 0].min() > 0 and found.depth_m.max() < 12
    changed = [f.name for f in fields(found) if not np.array_equal(getattr(found, f.name), getattr(clean, f.name))]
    assert changed == [CHANGED.get(row.name, "depth_m")]


@pytest.mark.parametrize("row", depth.ROWS, ids=by_address)
@pytest.mark.parametrize("severity", [0.02, 1.0, 5.0])
def test_a_missing_pixel_never_gains_depth(row: Corruption, severity: float) -> None:
    missing = recording().frames[0].depth_m == 0
    found = apply_to_frame(row, row.value_at(severity))
    assert missing.sum() > 1000 and not found.depth_m[missing].any()


@every_frame_row
@pytest.mark.parametrize("n_valid", [0, 1])
def test_a_frame_with_almost_no_depth_is_no_special_case(row: Corruption, n_valid: int) -> None:
    depth_m = np.zeros_like(recording().frames[0].depth_m)
    depth_m.flat[:n_valid] = 2.0
    frame = replace(recording().frames[0], depth_m=depth_m)
    found = apply_to_frame(row, row.values[-1], clean=Recording((frame,), recording().poses[:1], 0))
    assert np.isfinite(found.depth_m).all() and np.count_nonzero(found.depth_m) <= 4 * n_valid


@pytest.mark.parametrize("row", NESTED, ids=by_address)
def test_what_a_severity_loses_is_lost_at_the_next_too(row: Corruption) -> None:
    if row.stage == "order":
        losses = [~np.isin(PLACES, apply_to_order(row, value)) for value in row.values]
    else:
        losses = [apply_to_frame(row, value).depth_m == 0 for value in row.values]
    for less, more in pairwise(losses):
        assert less.sum() < more.sum() and not (less & ~more).any()


@pytest.mark.parametrize("row", poses.ROWS, ids=by_address)
def test_poses_stay_rigid(row: Corruption) -> None:
    found = apply_to_poses(row, row.values[-1])
    rotation = found[:, :3, :3]
    assert found.shape == (N_FRAMES, 4, 4) and found.dtype == np.float64 and (found[:, 3] == [0, 0, 0, 1]).all()
    assert np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(rotation).min() > 0


@pytest.mark.parametrize("row", [row for row in ROWS if row.stage == "order"], ids=by_address)
@pytest.mark.parametrize("n_updates", [1, 2, 23])
def test_an_order_contains_only_places_of_the_recording_and_at_least_one(row: Corruption, n_updates: int) -> None:
    places = np.arange(n_updates) * 3 + 1
    for value in (*row.values, 1.0):
        found = row.function(places, value, generator(row, 0, "scene"))
        assert isinstance(found, np.ndarray) and found.dtype == np.int64
        assert len(found) > 0 and np.isin(found, places).all()
