"""OpenMask3D by hand: projection, views, prompts, crops, means, and its dependence on proposals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prediction_files import write_openyolo3d
from test_proposals import made_proposals

from su3d_bench.baselines.openmask3d.method import (
    MaskViews,
    OpenMask3D,
    OpenMask3DConfig,
    OpenMask3DSegment3D,
    OpenMask3DSegment3DConfig,
    as_openmask3d,
    count_pixels,
    crop_boxes,
    pixels_of_mask,
    prompted_mask,
    swapped_intrinsics,
    visible_pixels,
)
from su3d_bench.core import registry
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import SceneTools
from su3d_bench.core.maps import Instances, Proposals
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import BoolArray, Float32Array, Frame, Int64Array, SceneInfo, Surface
from su3d_bench.metrics.matching.labelling import most_similar
from su3d_bench.perception.cache import region_under
from su3d_bench.runs.frame_loop import no_detections

WIDTH, HEIGHT, FOCAL = 12, 8, 10.0
INTRINSICS = np.array([[FOCAL, 0, 0], [0, FOCAL, 0], [0, 0, 1]])


def frame(index: int = 0, depth_m: float = 1.0, x_m: float = 0.0) -> Frame:
    """A camera at (x_m, 0, 0) that looks along z at a wall; a point (u / 10, v / 10, 1) is seen at pixel u, v."""
    pose = np.eye(4)
    pose[0, 3] = x_m
    rgb, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.full((HEIGHT, WIDTH), depth_m, np.float32)
    return Frame(index, index / 30, rgb, depth, pose, INTRINSICS)


def seen(points: Sequence[Sequence[float]], view: Frame, tolerance_m: float = 0.2) -> list[int]:
    pixels = visible_pixels(np.array(points, np.float32), view, view.intrinsics, tolerance_m)
    return [int(pixel) for pixel in pixels]


class TestProjection:
    def test_pixel_is_the_projection_truncated_toward_zero(self) -> None:
        """-0.9 is in pixel 0, -1.1 in none; 11.9 is the last column, 12.0 is outside."""
        found = seen([(-0.09, 0, 1), (-0.11, 0, 1), (1.19, 0, 1), (1.2, 0, 1), (0.39, 0.29, 1)], frame())
        assert found == [0, -1, 11, -1, 2 * WIDTH + 3]

    def test_depth_may_differ_by_exactly_the_tolerance(self) -> None:
        assert seen([(0, 0, 1.25), (0, 0, 0.75), (0, 0, 1.26), (0, 0, 0.74)], frame(), 0.25) == [0, 0, -1, -1]

    def test_points_near_the_camera_plane_count_at_holes_on_either_side(self) -> None:
        """No test for a positive depth: a hole has depth 0, which is within 0.2 m of -0.1 m."""
        holes = frame(depth_m=0.0)
        assert seen([(0.015, 0.015, 0.1), (-0.015, -0.015, -0.1), (0, 0, -0.3)], holes) == [WIDTH + 1, WIDTH + 1, -1]
        assert seen([(-0.015, -0.015, -0.1)], frame()) == [-1]

    def test_point_in_the_camera_plane_falls_on_the_first_pixel(self) -> None:
        assert seen([(5, 5, 0)], frame(depth_m=0.0)) == [0] and seen([(5, 5, 0)], frame()) == [-1]

    def test_centres_are_scaled_by_the_other_axis(self) -> None:
        """640 x 480 of 1296 x 968: fx floor(478.02) / 968, fy 640 / 1296, cx 479 / 967, cy 639 / 1295."""
        colour = np.array([[1000.0, 0, 967], [0, 1000, 1295], [0, 0, 1]])
        scaled = swapped_intrinsics(colour, (968, 1296), 480, 640)
        assert np.diag(scaled)[:2] == pytest.approx([1000 * 478 / 968, 1000 * 640 / 1296])
        assert scaled[:2, 2] == pytest.approx([479, 639])

    def test_full_size_frame_is_unchanged_and_a_smaller_one_shifts_the_centre(self) -> None:
        whole = replace(frame(), intrinsics=np.array([[1170.0, 0, 647], [0, 1170, 483], [0, 0, 1]]))
        whole = replace(whole, rgb=np.zeros((968, 1296, 3), np.uint8), depth_m=np.zeros((968, 1296), np.float32))
        assert as_openmask3d(whole, (968, 1296)) == pytest.approx(whole.intrinsics)
        half = np.array([[577.0, 0, 319.5], [0, 578, 239.5], [0, 0, 1]])
        small = Frame(0, 0.0, np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32), np.eye(4), half)
        moved = as_openmask3d(small, (968, 1296))
        assert moved[:2, 2] - half[:2, 2] == pytest.approx(
            [319.5 * (1295 / 639 * 479 / 967 - 1), 239.5 * (967 / 479 * 639 / 1295 - 1)]
        )
        assert 1.2 < moved[0, 2] - half[0, 2] < 1.3


class TestViews:
    def test_pixels_count_once_even_if_several_points_hit_them(self) -> None:
        points = np.array([(0, 0, 1), (0.01, 0, 1), (0.3, 0, 1), (9, 9, 9)])
        proposals = made_proposals(points, [0, 1, 2, 3], [1, 2], [3], [])
        pixels = visible_pixels(proposals.points, frame(), INTRINSICS, 0.2)
        assert count_pixels(pixels, proposals, WIDTH * HEIGHT).tolist() == [2, 2, 0, 0]
        assert pixels_of_mask(pixels, proposals.mask(0), WIDTH).tolist() == [[0, 0], [3, 0]]

    def test_views_with_most_pixels_are_kept_and_ties_go_to_the_earlier(self) -> None:
        views = MaskViews(2, 2)
        for position, counts in enumerate([(3, 0), (5, 0), (5, 1), (3, 1), (6, 1)]):
            views.add(position, np.array(counts))
        assert views.positions.tolist() == [[4, 1], [2, 3]] and views.n_pixels.tolist() == [[6, 5], [1, 1]]


class Prompts:
    """Regions that answer the k-th prompt with the k-th score and record the points."""

    dim = 2

    def __init__(self, scores: Sequence[float], *, empty: Sequence[int] = ()) -> None:
        self.scores, self.empty = scores, empty
        self.asked: list[list[list[int]]] = []

    def mask_at(self, view: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        k = len(self.asked)
        self.asked.append(points.tolist())
        mask = np.zeros(view.depth_m.shape, np.bool_)
        mask[0, : 0 if k in self.empty else k + 1] = True
        return mask, self.scores[k]

    def encode_regions(self, view: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        return np.tile(np.array([1, 0], np.float32), (len(boxes), 1))


PIXELS = np.array([(x, y) for y in range(3) for x in range(4)])


class TestPrompts:
    def test_each_round_prompts_with_five_different_pixels_of_the_mask(self) -> None:
        prompts = Prompts([0.5] * 10)
        prompted_mask(prompts, frame(), PIXELS, 10, 5, np.random.default_rng(0))
        assert len(prompts.asked) == 10
        for points in prompts.asked:
            assert len(points) == len({tuple(point) for point in points}) == 5
            assert {tuple(point) for point in points} <= {tuple(pixel) for pixel in PIXELS.tolist()}
        assert len({str(sorted(points)) for points in prompts.asked}) > 5

    def test_best_round_wins_and_ties_go_to_the_first(self) -> None:
        scores = [0.2, 0.7, 0.3, 0.9, 0.9, 0.1, 0.9, 0, 0, 0]
        best = prompted_mask(Prompts(scores), frame(), PIXELS, 10, 5, np.random.default_rng(0))
        assert best is not None and best.sum() == 4  # the fourth round


class TestCrops:
    def test_levels_grow_by_the_floor_of_a_tenth_on_every_side(self) -> None:
        """19 wide, 29 high: floor(1.9) = 1 and floor(2.9) = 2 per level."""
        mask = np.zeros((60, 60), bool)
        mask[20:49, 10:29] = True
        expected = [[10, 20, 29, 49], [9, 18, 30, 51], [8, 16, 31, 53]]
        assert crop_boxes(mask, 3, 0.1).tolist() == expected

    def test_below_ten_pixels_nothing_grows_and_the_image_clips(self) -> None:
        small = np.zeros((30, 30), bool)
        small[3:12, 3:12] = True
        assert crop_boxes(small, 3, 0.1).tolist() == [[3, 3, 12, 12]] * 3
        corner = np.zeros((30, 30), bool)
        corner[:20, 10:] = True
        assert crop_boxes(corner, 3, 0.1).tolist() == [[10, 0, 30, 20], [8, 0, 30, 22], [6, 0, 30, 24]]


class WallOfPatches:
    """Regions of a wall of coloured patches: columns 0-3, 4-7 and 8-11 of the image, each with its own axis."""

    dim = 3

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.masks = np.zeros((3, HEIGHT, WIDTH), np.bool_)
        for k in range(3):
            self.masks[k, :, 4 * k : 4 * k + 4] = True

    def mask_at(self, view: Frame, points: Int64Array) -> tuple[BoolArray, float]:
        best, share = region_under(self.masks, points)
        return self.masks[best], share

    def encode_regions(self, view: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        self.frames.append(view.index)
        features = np.zeros((len(boxes), self.dim), np.float32)
        features[:, int(np.flatnonzero((self.masks == mask).all(axis=(1, 2)))[0])] = 1
        return features


class CountedFrames(Sequence[Frame]):
    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames, self.read = frames, list[int]()

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        self.read.append(index)
        return self.frames[index]


WALL = np.array([(0.1 * u + 0.05, 0.1 * v + 0.05, 1) for v in range(HEIGHT) for u in range(WIDTH)], np.float32)
COLUMN = np.tile(np.arange(WIDTH), HEIGHT)
LEFT, MIDDLE, RIGHT = (np.flatnonzero(k == COLUMN // 4).tolist() for k in range(3))
SCENE = SceneInfo("rooms", "room0", 4, 10, "rendered-rooms", seed=7)


def ran(
    proposals: Proposals, frames: Sequence[Frame], config: OpenMask3DConfig | None = None
) -> tuple[OpenMask3D, Instances, CountedFrames, WallOfPatches]:
    """OpenMask3D over true proposals on the wall."""
    config = config or OpenMask3DConfig(proposals="oracle")
    regions, counted = WallOfPatches(), CountedFrames(frames)
    surface = Surface(proposals.points, np.zeros((0, 3), np.int32))
    method = OpenMask3D(config)
    method.receive_tools(SceneTools(counted, regions, lambda: proposals))
    method.start(replace(SCENE, read_surface=lambda: surface))
    for one in frames:
        method.update(one, no_detections(one, method.needs), Timer())
    return method, method.finish(), counted, regions


class TestMethod:
    def test_each_proposal_gets_the_feature_of_what_its_views_show(self) -> None:
        _, found, _, _ = ran(made_proposals(WALL, LEFT, MIDDLE, RIGHT), [frame()])
        assert found.features is not None and found.features.tolist() == np.eye(3).tolist()
        assert found.scores.tolist() == [1, 1, 1] and found.labels is None
        assert np.array_equal(found.points, WALL) and found.mask(1).tolist() == MIDDLE
        assert found.boxes[0].tolist() == [WALL[LEFT].min(axis=0).tolist(), WALL[LEFT].max(axis=0).tolist()]

    def test_feature_is_the_plain_mean_over_all_crops(self, monkeypatch: pytest.MonkeyPatch) -> None:
        crops = np.eye(3, dtype=np.float32)[[0, 1, 1]]
        monkeypatch.setattr(WallOfPatches, "encode_regions", lambda *_: crops)
        features = ran(made_proposals(WALL, LEFT), [frame(0), frame(1)])[1].features
        assert features is not None and features[0] == pytest.approx([1 / 3, 2 / 3, 0])

    def test_two_objects_merged_by_a_proposal_stay_merged(self) -> None:
        _, found, _, _ = ran(made_proposals(WALL, LEFT + MIDDLE, RIGHT), [frame()])
        assert len(found) == 2 and found.mask(0).tolist() == LEFT + MIDDLE
        assert found.features is not None and found.features[0].max() == 1  # the best prompt saw one of the two

    def test_object_without_a_proposal_is_never_found(self) -> None:
        _, found, _, regions = ran(made_proposals(WALL, LEFT), [frame(0), frame(1), frame(2)])
        assert not set(found.indices.tolist()) & set(MIDDLE + RIGHT) and regions.masks.any(axis=0).all()

    def test_mask_without_a_usable_view_has_a_zero_feature_and_the_first_class(self) -> None:
        """As NaN becomes 0 and argmax 0 in the original; the protocols' rule is the same."""
        hidden = np.concatenate([WALL, [(0.5, 0.5, 3)]]).astype(np.float32)
        _, found, _, _ = ran(made_proposals(hidden, LEFT, [len(WALL)], []), [frame()])
        assert found.features is not None and found.features[1:].tolist() == [[0, 0, 0]] * 2
        assert most_similar(found.features, np.eye(3)[[1, 0, 2]]).tolist() == [1, 0, 0]
        assert found.boxes[2].tolist() == [[0, 0, 0], [0, 0, 0]] and np.diff(found.view_indptr).tolist() == [1, 0, 0]

    def test_only_the_best_views_are_read_each_frame_once_in_order(self) -> None:
        """Farther to the right fewer columns are visible; frames 0 and 3 show all, so they are the two views."""
        frames = [frame(10 * k, x_m=x) for k, x in enumerate((0.0, 0.6, 0.3, 0.0))]
        method, found, counted, regions = ran(
            made_proposals(WALL, list(range(len(WALL))), LEFT), frames, OpenMask3DConfig(proposals="oracle", top_k=2)
        )
        assert counted.read == [0, 3] and regions.frames == [0, 0, 30, 30]
        assert found.views.tolist() == [[0, 0], [30, 0], [0, 1], [30, 1]]
        assert method.finish_costs["n_frames_again"] == 2 and method.finish_costs["n_views"] == 4
        assert (method.n_points, method.n_instances) == (len(WALL), 2)
        assert method.map_bytes > 12 * len(WALL)

    def test_finish_midway_changes_nothing_and_runs_are_reproducible(self) -> None:
        proposals, frames = made_proposals(WALL, LEFT + MIDDLE, RIGHT), [frame(0), frame(10, x_m=0.1)]
        method, first, _, _ = ran(proposals, frames)
        again, (_, other, _, _) = method.finish(), ran(proposals, frames)
        assert first.features is not None and again.features is not None and other.features is not None
        assert first.features.tobytes() == again.features.tobytes() == other.features.tobytes()
        assert np.array_equal(first.views, other.views)

    def test_prompts_of_a_mask_do_not_depend_on_other_masks(self) -> None:
        alone = ran(made_proposals(WALL, LEFT + MIDDLE), [frame()])[1].features
        beside = ran(made_proposals(WALL, LEFT + MIDDLE, RIGHT), [frame()])[1].features
        assert alone is not None and beside is not None and alone[0].tolist() == beside[0].tolist()

    def test_proposal_score_is_the_confidence_on_request(self) -> None:
        config = OpenMask3DConfig(proposals="oracle", confidence="proposal")
        _, found, _, _ = ran(made_proposals(WALL, LEFT, RIGHT, scores=[0.3, 0.8]), [frame()], config)
        assert found.scores.tolist() == [0.3, 0.8]

    def test_other_intrinsics_change_the_views(self) -> None:
        config = OpenMask3DConfig(proposals="oracle", intrinsics="openmask3d", intrinsic_resolution=(16, 12))
        as_is, moved = (
            ran(made_proposals(WALL, LEFT), [frame()])[0],
            ran(made_proposals(WALL, LEFT), [frame()], config)[0],
        )
        assert as_is._views.n_pixels[0, 0] == 32 != moved._views.n_pixels[0, 0]

    def test_frame_that_differs_when_read_again_is_an_error(self) -> None:
        method, _, counted, _ = ran(made_proposals(WALL, LEFT), [frame()])
        counted.frames = [frame(5)]
        with pytest.raises(DataError, match="update 0 was frame 0, read again it is frame 5"):
            method.finish()

    def test_without_frames_or_proposals_results_are_empty(self) -> None:
        assert ran(made_proposals(WALL, LEFT), [])[1].features is not None
        assert len(ran(made_proposals(WALL), [frame()])[1]) == 0

    def test_proposals_from_files_are_described(self, tmp_path: Path) -> None:
        masks = np.zeros((1, len(WALL)), bool)
        masks[0, RIGHT] = True
        write_openyolo3d(tmp_path, {"name": "room0", "masks": masks, "scores": np.array([0.5])})
        _, found, _, _ = ran(made_proposals(WALL, LEFT), [frame()], OpenMask3DConfig(proposals_folder=tmp_path))
        assert (
            found.mask(0).tolist() == RIGHT and found.features is not None and found.features[0].tolist() == [0, 0, 1]
        )


class TestVariants:
    def test_defaults_are_the_published_ones(self) -> None:
        config = OpenMask3DConfig()
        assert (config.stride, config.top_k, config.vis_threshold) == (10, 5, 0.2)
        assert (config.num_random_rounds, config.num_selected_points) == (10, 5)
        assert (config.num_of_levels, config.multi_level_expansion_ratio) == (3, 0.1)
        assert (config.part_eps_m, config.part_min_points, config.part_max_dropped) == (0.95, 1, 0)
        other = OpenMask3DSegment3DConfig()
        assert (other.part_eps_m, other.part_min_points, other.part_max_dropped) == (0.05, 5, 15)
        assert (other.part_kept_share, other.surface_max, config.surface_max) == (0.8, 400, 150)

    def test_segment3d_splits_parts_by_density_and_openmask3d_by_gaps(self) -> None:
        """Two rows of points 30 cm apart, and a lone point: one part, but for Segment3D two and noise."""
        points = np.array([(0.01 * k, y, 0) for y in (0, 0.3) for k in range(20)] + [(0.1, 0.15, 0)], np.float32)
        surface = Surface(points, np.zeros((0, 3), np.int32), np.zeros(41, np.int32))
        shared: dict[str, Any] = {"segment_vote": False, "surface_max_share": 1.0, "surface_min_points": 1}
        sizes = {}
        for cls in (OpenMask3D, OpenMask3DSegment3D):
            method = cls(cls.Config(**shared))
            method.receive_tools(SceneTools((), WallOfPatches()))
            method.start(replace(SCENE, read_surface=lambda: surface))
            sizes[cls.name] = np.diff(method.finish().indptr).tolist()
        assert sizes == {"openmask3d": [41], "openmask3d-segment3d": [20]}  # of two equal parts floor(0.8 * 2) stay

    @pytest.mark.parametrize("name", ["openmask3d", "openmask3d-segment3d"])
    def test_methods_are_registered_need_no_masks_and_state_their_caveats(self, name: str) -> None:
        cls = registry.load("method", name)
        method = cls(cls.Config())
        assert cls.name == name and method.needs.masks == "none" and not method.needs.true_proposals
        assert "without a network" in method.caveat and "reproduced" in cls.about.status
        assert cls(cls.Config(proposals="oracle")).needs.true_proposals
