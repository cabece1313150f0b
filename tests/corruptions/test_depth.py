"""Corruptions of depth, on values computed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recordings import recording
from severity_measures import apply_to_frame

from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.corruptions.depth import ROWS, blobs
from su3d_bench.corruptions.model import Recording

NOISE, QUANTISATION, EDGE_LOSS, FLYING_PIXELS, HOLES, DARK_HOLES, RANGE, SCALE = ROWS
STEP = np.tile(np.repeat([1.0, 2.0], 10), (20, 1)).astype(np.float32)  # columns 0..9 are at 1 m, 10..19 at 2 m


def one_frame(depth_m: Float32Array, rgb: UInt8Array | None = None, focal_px: float = 140.0) -> Recording:
    black = np.zeros((*depth_m.shape, 3), np.uint8)
    camera = np.array([[focal_px, 0, depth_m.shape[1] / 2], [0, focal_px, depth_m.shape[0] / 2], [0, 0, 1]])
    frame = replace(recording().frames[0], depth_m=depth_m, rgb=black if rgb is None else rgb, intrinsics=camera)
    return Recording((frame,), recording().poses[:1], 0)


def row_of(*depths_m: float) -> Recording:
    return one_frame(np.array([depths_m], np.float32))


def test_noise_on_a_wall_has_the_published_deviation_and_grows_in_place() -> None:
    wall = one_frame(np.full((480, 640), 2.0, np.float32), focal_px=560.0)
    once = apply_to_frame(NOISE, 1.0, clean=wall).depth_m - 2
    assert once.std() == pytest.approx(0.0012 + 0.0019 * (2 - 0.4) ** 2, rel=0.05)
    # neighbouring windows of 9 pixels share 8 columns
    assert np.corrcoef(once[:, 1:].ravel(), once[:, :-1].ravel())[0, 1] == pytest.approx(8 / 9, abs=0.03)
    assert apply_to_frame(NOISE, 4.0, clean=wall).depth_m - 2 == pytest.approx(4 * once, abs=1e-5)


def test_noise_moves_outlines_sideways() -> None:
    found = apply_to_frame(NOISE, 4.0, clean=one_frame(np.tile(STEP, (4, 4)))).depth_m
    assert np.count_nonzero(np.abs(found - np.tile(STEP, (4, 4))) > 0.5) > 50


def test_disparity_is_a_multiple_of_the_step() -> None:
    # 585 px * 0.075 m = 43.875 px * m: a disparity of 21.94 px at 2 m becomes 22, and 14.6 px at 3 m becomes 14
    found = apply_to_frame(QUANTISATION, 2.0, clean=row_of(2.0, 3.0, 0.0)).depth_m
    assert found[0] == pytest.approx([43.875 / 22, 43.875 / 14, 0])


@pytest.mark.parametrize(("width_px", "lost"), [(1, range(9, 11)), (2, range(8, 12)), (6, range(4, 16))])
def test_pixels_up_to_the_width_from_an_edge_are_lost(width_px: int, lost: range) -> None:
    found = apply_to_frame(EDGE_LOSS, float(width_px), clean=one_frame(STEP)).depth_m
    kept = [column for column in range(20) if column not in lost]
    assert not found[:, list(lost)].any() and (found[:, kept] == STEP[:, kept]).all()


def test_flying_pixels_lie_between_the_surfaces_of_an_edge() -> None:
    found = apply_to_frame(FLYING_PIXELS, 1.0, clean=one_frame(STEP)).depth_m
    assert (np.delete(found, [9, 10], axis=1) == np.delete(STEP, [9, 10], axis=1)).all()
    assert 1 < found[:, 9:11].min() < 1.2 and 1.8 < found[:, 9:11].max() < 2
    fewer = apply_to_frame(FLYING_PIXELS, 0.25, clean=one_frame(STEP)).depth_m
    moved = fewer != STEP
    assert 2 <= moved.sum() <= 20 and (fewer[moved] == found[moved]).all()


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_holes_cover_exactly_their_share_in_connected_areas(share: float) -> None:
    from scipy.ndimage import label

    found = apply_to_frame(HOLES, share, clean=one_frame(np.full((120, 160), 2.0, np.float32))).depth_m
    assert np.count_nonzero(found == 0) == round(share * 120 * 160)
    assert label(found == 0)[1] < 60  # points would be more than a thousand areas


def test_a_share_of_nothing_loses_no_place() -> None:
    assert not blobs((7,), 0.0, 2.0, np.random.default_rng(0)).any()


def test_depth_is_lost_where_colour_is_dark() -> None:
    # linear light of grey 64 is ((64 / 255 + 0.055) / 1.055) ** 2.4 = 0.051; pure blue counts 0.072
    rgb = np.array([[[0, 0, 0], [64, 64, 64], [0, 0, 255], [255, 255, 255]]], np.uint8)
    clean = one_frame(np.array([[1.0, 2.0, 3.0, 4.0]], np.float32), rgb)
    found = [apply_to_frame(DARK_HOLES, value, clean=clean).depth_m[0].tolist() for value in (0.04, 0.06, 0.08)]
    assert found == [[0, 2, 3, 4], [0, 0, 3, 4], [0, 0, 0, 4]]


def test_depth_beyond_the_range_is_lost() -> None:
    found = [apply_to_frame(RANGE, value, clean=row_of(2.0, 2.5, 2.6, 4.0)).depth_m[0].tolist() for value in (0.3, 0.4)]
    assert found == pytest.approx(np.array([[2, 2.5, 2.6, 0], [2, 2.5, 0, 0]]))


def test_depth_is_too_far_or_too_near_for_a_whole_scene() -> None:
    found = [apply_to_frame(SCALE, 3.5, f"scene{k}", clean=row_of(2.0, 4.0)).depth_m[0] for k in range(8)]
    assert {tuple(round(float(depth_m), 4) for depth_m in one) for one in found} == {(2.07, 4.14), (1.93, 3.86)}
