"""SAM3D as a method: what overlap joins and what it does not, its schedules, its map on the mesh, its features."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from grouped_clouds import HEIGHT, WIDTH, Plate, look
from pydantic import ValidationError

from su3d_bench.baselines.sam3d.method import SAM3D, SAM3DConfig, paint
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import SceneTools
from su3d_bench.core.maps import Instances, Proposals
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, SceneInfo, Surface

SCENE = SceneInfo("made", "plates", 4, 1, "rendered-rooms")
TREE, INCREMENTAL = SAM3DConfig(), SAM3DConfig(schedule="incremental")
LEFT, RIGHT = Plate((-0.6, 0.0)), Plate((0.0, 0.6))
Views = Sequence[tuple[Frame, Detections]]


def tools_with(surface: Callable[[], Surface]) -> SceneTools:
    def no_proposals() -> Proposals:
        raise AssertionError("SAM3D makes its own masks")

    return SceneTools((), None, surface, no_proposals)  # type: ignore[arg-type]


def no_mesh() -> Surface:
    raise DataError("made/plates: the dataset has no mesh")


def run(views: Views, config: SAM3DConfig = TREE, surface: Surface | None = None) -> SAM3D:
    method = SAM3D(config)
    method.receive_tools(tools_with(no_mesh if surface is None else lambda: surface))
    method.start(SCENE)
    for frame, detections in views:
        method.update(frame, detections, Timer())
    return method


def contents(found: Instances) -> tuple[object, ...]:
    parts = (found.points, found.indptr, found.indices, found.scores, found.features, found.views, found.view_indptr)
    return (*(np.asarray(part).tobytes() for part in parts), found.names, found.captions)


def views_of(found: Instances, k: int) -> list[tuple[int, int]]:
    return [tuple(row) for row in found.views[found.view_indptr[k] : found.view_indptr[k + 1]].tolist()]


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_one_plate_in_many_frames_is_one_group_with_all_its_views(config: SAM3DConfig) -> None:
    found = run([look([LEFT], index, camera_x=0.05 * index) for index in range(5)], config).finish()
    assert len(found) == 1
    assert views_of(found, 0) == [(index, 0) for index in range(5)]
    assert found.scores.tolist() == [1.0]
    assert found.view_names == ("plate 0",) * 5 and np.asarray(found.view_scores).tolist() == [0.5] * 5
    assert found.boxes[0] == pytest.approx(np.array([[-0.6, -0.5, 2], [0, 0.5, 2]]), abs=0.05)


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_two_touching_plates_of_one_feature_stay_apart(config: SAM3DConfig) -> None:
    assert len(run([look([LEFT, RIGHT], index) for index in range(4)], config).finish()) == 2


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_one_mask_over_both_joins_plates_whose_features_are_opposed(config: SAM3DConfig) -> None:
    apart = [look([LEFT, replace(RIGHT, axis=1)], 0)]
    both = look([Plate((-0.6, 0.6), axis=2)], 1)
    found = run([*apart, both], config).finish()
    assert len(found) == 1
    assert views_of(found, 0) == [(0, 1), (0, 0), (1, 0)]  # the last mask of an image is its first group


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_an_object_seen_in_halves_without_overlap_stays_two(config: SAM3DConfig) -> None:
    assert len(run([look([LEFT], 0), look([RIGHT], 1)], config).finish()) == 2


def test_two_objects_far_apart_with_one_feature_are_two_groups() -> None:
    assert len(run([look([Plate((-0.9, -0.4)), Plate((0.4, 0.9))], index) for index in range(2)]).finish()) == 2


def test_the_order_of_merging_decides() -> None:
    # A strip over the seam of two plates joins both where it comes alone. Merged with the right plate first it is
    # mostly that plate, and what it shares with the left one is too little.
    left, right, strip = Plate((-1, 0)), Plate((0, 1)), Plate((-0.2, 0.2))
    views = [look([plate], index) for index, plate in enumerate((left, right, strip, right))]
    assert len(run(views, SAM3DConfig(ratio=0.4)).finish()) == 2
    assert len(run(views, SAM3DConfig(ratio=0.4, schedule="incremental")).finish()) == 1


def test_the_first_of_overlapping_masks_ends_on_top() -> None:
    frame, detections = look([Plate((-0.3, 0.3)), Plate((-0.6, 0.6))], 0)
    found = paint(frame, detections.masks)
    assert found[HEIGHT // 2, WIDTH // 2] == 0
    assert found[HEIGHT // 2, WIDTH // 2 - 30] == 1
    assert found[0, 0] == -1


def test_a_mask_that_others_hide_is_no_view() -> None:
    found = run([look([Plate((-0.6, 0.6)), Plate((-0.3, 0.3))], 0)]).finish()
    assert [views_of(found, k) for k in range(len(found))] == [[(0, 0)]]


def test_groups_below_fifty_points_are_left_out() -> None:
    # 5 cm voxels: 6 x 6 points and 12 x 12
    found = run([look([Plate((-0.9, -0.6), (0, 0.3)), Plate((0, 0.6), (0, 0.6))], 0)]).finish()
    assert len(found) == 1 and found.names == ("plate 1",)


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_finish_midway_changes_nothing(config: SAM3DConfig) -> None:
    views = [look([LEFT, RIGHT], index, camera_x=0.04 * index) for index in range(5)]
    method = run(views[:3], config)
    assert contents(method.finish()) == contents(method.finish()) == contents(run(views[:3], config).finish())
    for frame, detections in views[3:]:
        method.update(frame, detections, Timer())
    assert contents(method.finish()) == contents(run(views, config).finish())


@pytest.mark.parametrize("config", [TREE, INCREMENTAL])
def test_a_scene_without_a_valid_point_ends_with_an_empty_map_and_says_so(
    config: SAM3DConfig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    for views in ([], [look([], 0), look([], 1)]):
        found = run(views, config).finish()
        assert len(found) == 0 and len(found.points) == 0
        assert caplog.messages[-1] == "made/plates: no frame of sam3d has a valid point; its map is empty"


def test_every_update_tells_its_stages_and_the_tree_merges_at_the_end() -> None:
    views = [look([LEFT], index) for index in range(2)]
    stages = []
    for config in (TREE, INCREMENTAL):
        method, timer = run(views[:1], config), Timer()
        method.update(*views[1], timer)
        stages.append(set(timer.take()))
        method.finish()
        stages.append(set(method.finish_costs))
    per_frame, at_the_end = {"backproject", "paint", "voxelise"}, {"merge_ms", "match_ms", "voxelise_ms"}
    assert stages == [per_frame, at_the_end, per_frame | {"match", "merge"}, set()]


def test_the_tree_holds_all_frames_and_the_map_only_itself() -> None:
    views = [look([LEFT, RIGHT], 0) for _ in range(3)]
    waiting, merged = run(views, TREE), run(views, INCREMENTAL)
    assert (waiting.n_instances, merged.n_instances) == (6, 2)
    assert waiting.n_points == 3 * merged.n_points > 0
    # 3 coordinates and a group a point, a group and a number a view, 8 bytes each; every mask of every frame is a view
    assert merged.map_bytes == 8 * (4 * merged.n_points + 2 * 6)


def test_a_feature_is_the_mean_of_the_views_or_that_of_the_largest() -> None:
    views = [
        look([replace(LEFT, axis=0)], 0),
        look([replace(LEFT, axis=1)], 1),
        look([Plate((-0.7, 0.1), axis=1)], 2),
    ]
    mean = run(views).finish()
    assert np.asarray(mean.features) == pytest.approx(np.array([[1, 2, 0, 0]]) / 5**0.5)
    largest = run(views, SAM3DConfig(features="largest-view")).finish()
    assert np.asarray(largest.features).tolist() == [[0, 1, 0, 0]]
    assert largest.names == mean.names == ("plate 0",)
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


def test_the_map_is_on_the_meshs_vertices_and_none_is_taken_beyond_the_limit() -> None:
    mesh = grid_mesh((-2.0, 1.0))
    found = run([look([LEFT], 0)], surface=mesh).finish()
    assert found.points.tobytes() == mesh.vertices.tobytes()
    reached = mesh.vertices[found.mask(0)][:, 0]
    assert reached.min() == pytest.approx(-1.2, abs=0.06) and reached.max() == pytest.approx(0.6, abs=0.06)
    near = run([look([LEFT], 0)], SAM3DConfig(max_distance_m=0.1), mesh).finish()
    assert mesh.vertices[near.mask(0)][:, 0].min() == pytest.approx(-0.7, abs=0.06)


def test_without_a_mesh_the_map_is_the_merged_cloud_and_a_line_says_so(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    method = run([look([LEFT], 0)])
    assert len(method.finish().points) == method.n_points
    assert "groups stay on its own points" in caplog.messages[0] and "no mesh" in caplog.messages[0]


def test_the_ensemble_gives_segments_whole_to_the_group_that_claims_them() -> None:
    mesh = grid_mesh((-0.6, 0.6))
    views = [look([replace(LEFT, axis=1), replace(RIGHT, axis=2)], 0)]
    apart = run(views, surface=mesh).finish()
    found = run(views, SAM3DConfig(ensemble=True), mesh).finish()
    # The seam of the groups at x = 0 moves to that of the segments at 0.1.
    seams = [max(mesh.vertices[each.mask(k)][:, 0].min() for k in range(2)) for each in (apart, found)]
    assert seams == [pytest.approx(0, abs=0.03), pytest.approx(0.1, abs=0.001)]
    assert set(found.names) == {"plate 0", "plate 1"}
    right = found.names.index("plate 1")
    assert np.asarray(found.features)[right].tolist() == [0, 0, 1, 0] and views_of(found, right) == [(0, 1)]


def test_a_segment_that_no_group_claims_is_no_instance() -> None:
    mesh = grid_mesh((-0.6, 2.0))
    found = run([look([LEFT], 0)], SAM3DConfig(ensemble=True, max_distance_m=0.05), mesh).finish()
    assert len(found) == 1
    assert mesh.vertices[found.mask(0)][:, 0].max() < 0.1


def test_a_mesh_without_published_segments_is_cut_by_its_bends() -> None:
    flat = grid_mesh((-0.6, 0.6), segments=False)  # no bend: one segment, which the larger group takes
    views = [look([Plate((-0.6, 0.2)), Plate((0.2, 0.6))], 0)]
    found = run(views, SAM3DConfig(ensemble=True), flat).finish()
    assert found.names == ("plate 0",)
    assert len(found.mask(0)) > 0.9 * len(flat.vertices)


def test_the_ensemble_without_a_mesh_is_refused_before_the_first_frame() -> None:
    with pytest.raises(DataError, match=r"made/plates: sam3d's ensemble needs the scan's mesh .*; set ensemble=false"):
        run([], SAM3DConfig(ensemble=True))


def test_detections_of_another_frame_or_size_are_refused() -> None:
    (frame, detections), method = look([LEFT], 0), run([])
    with pytest.raises(DataError, match="frame 0: the detections are those of frame 3"):
        method.update(frame, replace(detections, frame_index=3), Timer())
    with pytest.raises(DataError, match="frame 0: masks are 80x60 and the image is 160x120"):
        method.update(frame, replace(detections, masks=detections.masks[:, ::2, ::2]), Timer())


def test_features_of_another_encoder_are_refused() -> None:
    method = run([look([LEFT], 0)])
    with pytest.raises(DataError, match="frame 1: features have 3 dimensions, those of the map have 4"):
        method.update(*look([LEFT], 1, n_axes=3), Timer())


@pytest.mark.parametrize(
    "options", ['{"voxel": 0.1}', '{"voxel_m": 0}', '{"ratio": 1.5}', '{"schedule": "fold"}', '{"stride": 0}']
)
def test_options_that_mean_nothing_are_refused(options: str) -> None:
    with pytest.raises(ValidationError):
        SAM3DConfig.model_validate_json(options)


def test_the_defaults_are_those_of_the_original() -> None:
    assert (TREE.voxel_m, TREE.ratio, TREE.th, TREE.merge_th, TREE.stride) == (0.05, 0.5, 50, 50, 20)
    assert (TREE.max_distance_m, TREE.ensemble, TREE.ensemble_th, TREE.schedule) == (0.6, False, 20, "tree")
