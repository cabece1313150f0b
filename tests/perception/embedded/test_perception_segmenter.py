"""The RGB-D segmenter on scenes of boxes and planes with known regions; its graph compared with SciPy and NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from perception_fakes import still_life
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, Int32Array, Regions, UInt8Array
from su3d_bench.perception.embedded.join_rules import SegmenterConfig
from su3d_bench.perception.embedded.kernels import connected
from su3d_bench.perception.embedded.segmenter import RgbdSegmenter

K: Float64Array = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
WIDTH, HEIGHT = 320, 240
TABLE, LEFT, RIGHT = 1, 2, 3

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def cast(boxes: dict[int, Box], camera_height_m: float = 0.9) -> tuple[Float32Array, Int32Array, Float64Array]:
    """Depth, ids and normals seen by a camera looking down at 45 degrees; id 1 is the ground z = 0."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    c = np.sqrt(0.5)
    to_world = np.array([[1, 0, 0], [0, -c, c], [0, -c, -c]])  # x right, y away, z up
    directions = rays @ to_world.T
    origin = np.array([0.0, 0.0, camera_height_m])
    depth = -origin[2] / directions[..., 2]
    ids = np.full(depth.shape, TABLE, np.int32)
    normals = np.broadcast_to(np.array([0.0, 0, 1]), (*depth.shape, 3)).copy()
    for key, (low, high) in boxes.items():
        with np.errstate(divide="ignore"):
            t0, t1 = (np.array(low) - origin) / directions, (np.array(high) - origin) / directions
        near, far = np.minimum(t0, t1), np.maximum(t0, t1)
        enter, leave = near.max(axis=-1), far.min(axis=-1)
        hit = (enter < leave) & (enter > 0) & (enter < depth)
        depth[hit], ids[hit] = enter[hit], key
        axis = near.argmax(axis=-1)
        normals[hit] = (-np.sign(directions) * np.eye(3)[axis])[hit]
    return depth.astype(np.float32), ids, normals


def view(boxes: dict[int, Box], colours: dict[int, tuple[int, int, int]], noise: int = 4) -> tuple[Frame, Int32Array]:
    """A lit frame of ``boxes`` on the ground, with slight colour noise, and its ids."""
    depth_m, ids, normals = cast(boxes)
    light = 0.75 + 0.25 * np.abs(normals @ np.array([0.3, 0.5, 0.81]))
    table = np.array([colours[key] for key in sorted(colours)], np.float64)
    rgb = table[np.searchsorted(sorted(colours), ids)] * light[..., None]
    rgb += np.random.default_rng(0).integers(-noise, noise + 1, rgb.shape)
    return Frame(0, 0.0, np.clip(rgb, 0, 255).astype(np.uint8), depth_m, np.eye(4), K), ids


def best_iou(regions: Regions, truth: BoolArray) -> float:
    return max((float((m & truth).sum() / (m | truth).sum()) for m in regions.masks), default=0.0)


def objects(frame: Frame, **values: float) -> Regions:
    return RgbdSegmenter(SegmenterConfig.model_validate(values), "objects").segment(frame)


TWO_BOXES: dict[int, Box] = {
    LEFT: ((-0.25, 0.7, 0.0), (0.0, 0.95, 0.2)),
    RIGHT: ((0.0, 0.76, 0.0), (0.25, 0.95, 0.12)),
}
GREY, RED, BLUE = (190, 190, 190), (170, 60, 50), (60, 80, 170)


def test_two_touching_boxes_on_a_table_are_two_regions() -> None:
    frame, ids = view(TWO_BOXES, {TABLE: GREY, LEFT: RED, RIGHT: BLUE})
    regions = objects(frame)
    assert best_iou(regions, ids == LEFT) > 0.9
    assert best_iou(regions, ids == RIGHT) > 0.9


def test_faces_of_a_box_are_one_object_but_several_parts() -> None:
    boxes = {LEFT: TWO_BOXES[LEFT]}
    frame, ids = view(boxes, {TABLE: GREY, LEFT: RED})
    assert best_iou(objects(frame), ids == LEFT) > 0.9
    parts = RgbdSegmenter(SegmenterConfig(part_penalty=20), "parts").segment(frame)
    n_on_box = sum((mask & (ids == LEFT)).sum() > 0.5 * mask.sum() for mask in parts.masks)
    assert n_on_box >= 2


def test_box_of_the_tables_colour_is_found_by_shape() -> None:
    frame, ids = view({LEFT: TWO_BOXES[LEFT]}, {TABLE: GREY, LEFT: GREY})
    assert best_iou(objects(frame), ids == LEFT) > 0.8


def test_coplanar_regions_are_separated_by_colour() -> None:
    frame = still_life()
    picture = np.zeros(frame.depth_m.shape, bool)
    picture[10:30, 70:110] = True
    assert best_iou(objects(frame), picture) > 0.85


def test_wall_is_a_part_but_not_an_object() -> None:
    frame = still_life()
    wall = (frame.depth_m == 3.0) & (frame.rgb[..., 0] == 205)
    assert best_iou(objects(frame), wall) < 0.1
    assert best_iou(RgbdSegmenter(SegmenterConfig(), "parts").segment(frame), wall) > 0.9


def test_small_flush_patch_joins_wall_and_large_patch_is_object() -> None:
    frame = still_life()
    frame.rgb[95:105, 20:30] = 240, 200, 40
    truth = np.zeros(frame.depth_m.shape, bool)
    truth[95:105, 20:30] = True
    assert best_iou(objects(frame, min_region_px=60), truth) < 0.1
    assert best_iou(objects(frame, min_region_px=60, structure_pattern_fraction=0.001), truth) > 0.6


@pytest.mark.parametrize("fraction", [0.02, 0.2])
def test_single_depth_holes_do_not_break_regions(fraction: float) -> None:
    frame, ids = view(TWO_BOXES, {TABLE: GREY, LEFT: RED, RIGHT: BLUE})
    holes = np.random.default_rng(1).random(frame.depth_m.shape) < fraction
    frame.depth_m[holes] = 0
    regions = objects(frame)
    assert best_iou(regions, ids == LEFT) > 0.8 and best_iou(regions, ids == RIGHT) > 0.8


@pytest.mark.parametrize("depth_m", [0.0, 2.0, np.nan])
@pytest.mark.parametrize("level", ["objects", "parts"])
def test_flat_empty_frame_gives_few_regions_and_no_error(depth_m: float, level: str) -> None:
    rgb: UInt8Array = np.full((120, 160, 3), 90, np.uint8)
    frame = Frame(0, 0.0, rgb, np.full((120, 160), depth_m, np.float32), np.eye(4), K)
    regions = RgbdSegmenter(SegmenterConfig(), "parts" if level == "parts" else "objects").segment(frame)
    assert len(regions.boxes) <= 1 and regions.masks.shape[1:] == (120, 160)


def test_masks_do_not_overlap_boxes_fit_and_scores_are_fractions() -> None:
    frame, _ = view(TWO_BOXES, {TABLE: GREY, LEFT: RED, RIGHT: BLUE})
    for level in ("objects", "parts"):
        regions = RgbdSegmenter(SegmenterConfig(), "parts" if level == "parts" else "objects").segment(frame)
        assert regions.masks.sum(axis=0).max() == 1
        assert ((regions.scores > 0) & (regions.scores <= 1)).all()
        for mask, (x0, y0, x1, y1) in zip(regions.masks, regions.boxes.astype(int), strict=True):
            rows, columns = np.nonzero(mask)
            assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == (x0, y0, x1, y1)


@pytest.mark.parametrize(("n", "n_links"), [(1, 0), (5, 0), (40, 12), (40, 60), (300, 900)])
def test_components_are_numbered_by_their_first_nodes(n: int, n_links: int) -> None:
    a, b = np.random.default_rng(n_links).integers(0, n, (2, n_links))
    links = coo_matrix((np.ones(n_links, np.int8), (a, b)), shape=(n, n))
    n_components, expected = connected_components(links, directed=False)
    component, found = connected(a, b, n)
    assert found == n_components
    assert component.tolist() == expected.tolist()
