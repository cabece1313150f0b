"""Cost of an update of each incremental method, without perception, with 0.1 to 5 million points in its map.

A 1200x680 image of a wall with 24 masks; the map contains that wall, far beyond the view, in the method's own
form: voxels, objects with a side of one metre, features (16 dimensions). Every round starts from the same map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from su3d_bench.baselines.conceptfusion.method import ConceptFusion, ConceptFusionConfig
from su3d_bench.baselines.conceptgraphs.method import ConceptGraphs
from su3d_bench.baselines.conceptgraphs.objects import MapObject, Sighting, box_of
from su3d_bench.baselines.sam3d.method import SAM3D, SAM3DConfig
from su3d_bench.baselines.sam3d.overlap import GroupedCloud, voxelise
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Float64Array, Frame, Int64Array, SceneInfo
from su3d_bench.opensu3d.pipeline import OpenSU3D

WIDTH, HEIGHT, FOCAL = 1200, 680, 600.0
DISTANCE_M = 2.5
DIMENSIONS = 16
SCENE = SceneInfo("made", "wall", 2, 1, "rendered-rooms")
Method = OpenSU3D | SAM3D | ConceptGraphs | ConceptFusion
SIZES = (100_000, 1_000_000, 5_000_000)


def view(method: Method) -> tuple[Frame, Detections]:
    """The wall in 24 masks of 140x170 pixels, with the crops that the method needs."""
    intrinsics = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    depth_m = np.full((HEIGHT, WIDTH), DISTANCE_M, np.float32)
    masks = np.zeros((24, HEIGHT, WIDTH), np.bool_)
    boxes = np.zeros((24, 4), np.float32)
    for k in range(24):
        row, column = divmod(k, 6)
        boxes[k] = 200 * column + 10, 170 * row + 10, 200 * column + 180, 170 * row + 150
        masks[k, 170 * row + 10 : 170 * row + 150, 200 * column + 10 : 200 * column + 180] = True
    n, ratios = len(masks), method.needs.crop_ratios
    detections = Detections(
        frame_index=0,
        masks=masks,
        boxes=boxes,
        scores=np.ones(n, np.float32),
        names=("thing",) * n,
        captions=("",) * n,
        crop_ratios=ratios,
        crop_features=np.full((n, len(ratios), DIMENSIONS), DIMENSIONS**-0.5, np.float32),
        global_feature=np.full(DIMENSIONS, DIMENSIONS**-0.5, np.float32),
    )
    return Frame(0, 0.0, np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth_m, np.eye(4), intrinsics), detections


def wall(n_points: int, spacing_m: float) -> tuple[Float64Array, Int64Array]:
    """Points of a square wall in front of the camera, in rows, and the square metre in which each lies."""
    side = round(n_points**0.5)
    y, x = np.divmod(np.arange(side * side), side)
    points = np.column_stack([x + 0.5, y + 0.5, np.zeros(side * side)]) * spacing_m
    tile = np.floor(points[:, 0]).astype(np.int64) + np.floor(points[:, 1]).astype(np.int64) * (side + 1)
    points += [-side * spacing_m / 2, -side * spacing_m / 2, DISTANCE_M]
    return points, np.unique(tile, return_inverse=True)[1].astype(np.int64)


def opensu3d(n_points: int) -> tuple[Method, Callable[[], None]]:
    """Its map only grows with new areas, and this view is not new: nothing to undo."""
    method = OpenSU3D()
    method.start(SCENE)
    points, tile = wall(n_points, 0.02)
    for rows in np.array_split(np.arange(len(points)), max(1, n_points // 100_000)):
        method._map.insert(points[rows], (tile[rows] + 1).astype(np.int32))
    return method, lambda: None


def sam3d(n_points: int) -> tuple[Method, Callable[[], None]]:
    method = SAM3D(SAM3DConfig(merge_schedule="incremental"))
    method.start(SCENE)
    points, tile = wall(n_points, 0.05)
    no_views = np.zeros(0, np.int64)
    cloud = voxelise(GroupedCloud(points, tile, no_views, no_views), 0.05)

    def reset() -> None:
        method._clouds = [cloud]

    return method, reset


def conceptgraphs(n_points: int) -> tuple[Method, Callable[[], None]]:
    """Objects whose search trees are not built yet, like those of the last view after a merge."""
    method = ConceptGraphs()
    method.start(SCENE)
    points, tile = wall(n_points, method.config.downsample_voxel_size)
    points += np.random.default_rng(0).normal(0, method.config.noise_m, points.shape)
    order = np.argsort(tile, kind="stable")
    parts = np.split(points[order], np.flatnonzero(np.diff(tile[order])) + 1)
    feature = np.full(DIMENSIONS, DIMENSIONS**-0.5)
    seen = (Sighting(0, 0, "thing", "", 1.0),)
    objects = [
        MapObject(i, part, box_of(part, method.config), feature, np.ones(1), seen) for i, part in enumerate(parts)
    ]

    def reset() -> None:
        method._map._objects = [replace(one) for one in objects]
        method._map._n_frames = 0  # no periodic clean-up in the measured update

    return method, reset


def conceptfusion(n_points: int) -> tuple[Method, Callable[[], None]]:
    """Normals point away from the camera, as in its own views of a wall; the whole view is averaged in."""
    method = ConceptFusion(ConceptFusionConfig(feature_storage="memory"))
    method.start(SCENE)
    points, _ = wall(n_points, 0.02)
    n = len(points)
    table = method._table_for(view(method)[1])
    table.append(np.ones((1, DIMENSIONS), np.float16), np.zeros(n, np.int32), np.ones(n))
    fused = method._map
    fused._points, fused._normals, fused._counts, fused._n = points, np.tile([0.0, 0, 1], (n, 1)), np.ones(n), n
    return method, lambda: None


MAPS = {made.__name__: made for made in (opensu3d, sam3d, conceptgraphs, conceptfusion)}


@pytest.mark.parametrize("n_points", SIZES)
@pytest.mark.parametrize("name", MAPS)
def test_update(benchmark: BenchmarkFixture, name: str, n_points: int) -> None:
    benchmark.group = f"update of {name}"
    method, reset = MAPS[name](n_points)
    frame, detections = view(method)
    reset()
    n_before = method.n_points
    benchmark.pedantic(
        lambda: method.update(frame, detections, Timer()), setup=reset, rounds=5, warmup_rounds=1, iterations=1
    )
    n_after = method.n_points
    benchmark.extra_info["points in the map"] = n_before
    assert 0.95 * n_before <= n_after <= n_before + 100_000
