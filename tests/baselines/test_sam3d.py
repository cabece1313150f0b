"""SAM3D as a method: joining by overlap, its schedules, its map on the mesh, its features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from plates import Plate, axis, contents, look

from su3d_bench.baselines.sam3d.method import SAM3D, SAM3DConfig
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, SceneInfo, Surface

SCENE = SceneInfo("made", "plates", 4, 1, "rendered-rooms")
TREE, INCREMENTAL = SAM3DConfig(), SAM3DConfig(merge_schedule="incremental")
Views = Sequence[tuple[Frame, Detections]]


def plate(low: float, high: float, k: int = 0, name: str = "left") -> Plate:
    return Plate((low, high), (-0.5, 0.5), 2.0, axis(k), name, score=0.5, bend_m=0.0)


LEFT, RIGHT = plate(-0.6, 0.0), plate(0.0, 0.6, name="right")


def run(views: Views, config: SAM3DConfig = TREE, surface: Surface | None = None) -> SAM3D:
    method = SAM3D(config)
    method.start(SCENE if surface is None else replace(SCENE, read_surface=lambda: surface))
    for frame, detections in views:
        method.update(frame, detections, Timer())
    return method


def views_of(found: Instances, k: int) -> list[tuple[int, int]]:
    return [tuple(row) for row in found.views[found.view_indptr[k] : found.view_indptr[k + 1]].tolist()]


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_one_plate_in_many_frames_is_one_group_with_all_its_views(config: SAM3DConfig) -> None:
    found = run([look([LEFT], index, camera_x=0.05 * index) for index in range(5)], config).finish()
    assert len(found) == 1
    assert views_of(found, 0) == [(index, 0) for index in range(5)]
    assert found.scores.tolist() == [1.0]
    assert found.view_names == ("left",) * 5 and np.asarray(found.view_scores).tolist() == [0.5] * 5
    assert found.boxes[0] == pytest.approx(np.array([[-0.6, -0.5, 2], [0, 0.5, 2]]), abs=0.05)


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_mask_over_two_plates_joins_them_despite_opposite_features(config: SAM3DConfig) -> None:
    apart = [look([LEFT, replace(RIGHT, feature=axis(1))], 0)]
    both = look([plate(-0.6, 0.6, 2)], 1)
    found = run([*apart, both], config).finish()
    assert len(found) == 1
    assert views_of(found, 0) == [(0, 1), (0, 0), (1, 0)]  # the last mask of an image is its first group


def test_order_of_merging_matters() -> None:
    # A strip over the seam of two plates joins both if merged alone. Merged with the right plate first it is
    # mostly that plate, and shares too little with the left one.
    left, right, strip = plate(-1, 0), plate(0, 1), plate(-0.2, 0.2)
    views = [look([one], index) for index, one in enumerate((left, right, strip, right))]
    assert len(run(views, SAM3DConfig(overlap_ratio=0.4)).finish()) == 2
    assert len(run(views, SAM3DConfig(overlap_ratio=0.4, merge_schedule="incremental")).finish()) == 1


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_finish_midway_changes_nothing(config: SAM3DConfig) -> None:
    views = [look([LEFT, RIGHT], index, camera_x=0.04 * index) for index in range(5)]
    method = run(views[:3], config)
    assert contents(method.finish()) == contents(method.finish()) == contents(run(views[:3], config).finish())
    for frame, detections in views[3:]:
        method.update(frame, detections, Timer())
    assert contents(method.finish()) == contents(run(views, config).finish())


def test_feature_is_the_mean_of_the_views_or_that_of_the_largest() -> None:
    views = [
        look([LEFT], 0),
        look([replace(LEFT, feature=axis(1))], 1),
        look([plate(-0.7, 0.1, 1)], 2),
    ]
    mean = run(views).finish()
    assert np.asarray(mean.features) == pytest.approx(np.array([[1, 2, 0, 0]]) / 5**0.5)
    largest = run(views, SAM3DConfig(features="largest-view")).finish()
    assert np.asarray(largest.features).tolist() == [[0, 1, 0, 0]]
    assert largest.names == mean.names == ("left",)
    assert "largest-view" in SAM3D(SAM3DConfig(features="largest-view")).caveat


def grid_mesh(x: tuple[float, float], segments: bool = True) -> Surface:
    """A plane at 2 m with a vertex every 2.5 cm, cut into two segments at x = 0.1 m."""
    columns, rows = np.meshgrid(np.arange(x[0], x[1], 0.025), np.arange(-0.5, 0.5, 0.025), indexing="ij")
    vertices = np.stack([columns, rows, np.full(columns.shape, 2.0)], axis=-1).reshape(-1, 3).astype(np.float32)
    n = columns.shape[1]
    corner = np.arange(len(vertices)).reshape(columns.shape)[:-1, :-1].ravel()
    halves = [(corner, corner + n, corner + 1), (corner + 1, corner + n, corner + n + 1)]
    triangles = np.concatenate([np.column_stack(half) for half in halves]).astype(np.int32)
    of_vertex = np.where(vertices[:, 0] < 0.1, 40, 7).astype(np.int32)
    return Surface(vertices, triangles, of_vertex if segments else None)


def test_map_is_on_mesh_vertices_within_the_distance_limit() -> None:
    mesh = grid_mesh((-2.0, 1.0))
    found = run([look([LEFT], 0)], surface=mesh).finish()
    assert found.points.tobytes() == mesh.vertices.tobytes()
    reached = mesh.vertices[found.mask(0)][:, 0]
    assert reached.min() == pytest.approx(-1.2, abs=0.06) and reached.max() == pytest.approx(0.6, abs=0.06)
    near = run([look([LEFT], 0)], SAM3DConfig(max_distance_m=0.1), mesh).finish()
    assert mesh.vertices[near.mask(0)][:, 0].min() == pytest.approx(-0.7, abs=0.06)


def test_ensemble_assigns_whole_segments_to_their_group() -> None:
    mesh = grid_mesh((-0.6, 0.6))
    views = [look([replace(LEFT, feature=axis(1)), replace(RIGHT, feature=axis(2))], 0)]
    apart = run(views, surface=mesh).finish()
    found = run(views, SAM3DConfig(snap_to_segments=True), mesh).finish()
    # The border of the groups at x = 0 moves to that of the segments at 0.1.
    seams = [max(mesh.vertices[each.mask(k)][:, 0].min() for k in range(2)) for each in (apart, found)]
    assert seams == [pytest.approx(0, abs=0.03), pytest.approx(0.1, abs=0.001)]
    assert set(found.names) == {"left", "right"}
    right = found.names.index("right")
    assert np.asarray(found.features)[right].tolist() == [0, 0, 1, 0] and views_of(found, right) == [(0, 1)]
