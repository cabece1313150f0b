"""ConceptGraphs' similarities, assignment and merges: hand-worked values of every formula."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plates import QUIET, at_cosine, axis, block
from scipy.spatial import ConvexHull, HalfspaceIntersection

from su3d_bench.baselines.conceptgraphs.map import (
    NEW_OBJECT,
    assign,
    overlap_similarity,
    semantic_similarity,
    total_similarity,
)
from su3d_bench.baselines.conceptgraphs.objects import (
    MapObject,
    Sighting,
    bounding_box,
    denoised,
    grown,
    merge_overlapping,
    merged,
    oriented_iou,
    overlap_ratios,
    voxel_average,
)
from su3d_bench.core.types import OrientedBox

PAPER = QUIET.model_copy(update={"association": "paper"})


def an_object(
    points: np.ndarray,
    number: int = 1,
    *,
    n: int = 1,
    feature: tuple[float, ...] = axis(0),
    text: tuple[float, ...] = axis(0),
) -> MapObject:
    """An object with ``n`` detections."""
    seen = tuple(Sighting(k, 0, "item", "", 1.0) for k in range(n))
    cloud = np.asarray(points, np.float64)
    return MapObject(number, cloud, bounding_box(cloud, oriented=True), np.array(feature), np.array(text), seen)


def box(centre: tuple[float, float, float], sizes: tuple[float, float, float] = (1, 1, 1), turn: float = 0.0):  # type: ignore[no-untyped-def]
    """A box rotated about the z axis."""
    c, s = np.cos(turn), np.sin(turn)
    return OrientedBox(np.array(centre, float), np.array(sizes, float), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))


def iou(a: OrientedBox, b: OrientedBox) -> float:
    forth, back = float(oriented_iou([a], [b])[0, 0]), float(oriented_iou([b], [a])[0, 0])
    assert forth == pytest.approx(back, abs=1e-12)
    return forth


# Boxes


def test_boxes_shifted_by_half_a_side_have_iou_one_third() -> None:
    assert iou(box((0, 0, 0)), box((0.5, 0, 0))) == pytest.approx(1 / 3)
    assert iou(box((0, 0, 0)), box((0, 0, 0))) == pytest.approx(1)
    assert iou(box((0, 0, 0)), box((0.1, 0, 0.2), (0.5, 0.5, 0.5))) == pytest.approx(1 / 8)
    assert iou(box((3, 4, 5), turn=0.3), box((3, 4, 5), turn=0.3 + np.pi / 2)) == pytest.approx(1)


def test_cube_rotated_by_45_degrees_intersects_in_an_octagon() -> None:
    octagon = 2 * (np.sqrt(2) - 1)
    assert iou(box((0, 0, 0)), box((0, 0, 0), turn=np.pi / 4)) == pytest.approx(octagon / (2 - octagon))


def half_spaces(one: OrientedBox) -> np.ndarray:
    normals = np.concatenate([one.rotation.T, -one.rotation.T])
    return np.column_stack([normals, -normals @ one.centre - np.tile(one.sizes / 2, 2)])


def test_box_intersections_match_half_space_intersections() -> None:
    rng = np.random.default_rng(5)
    n_compared = 0
    for _ in range(40):
        one, other = (
            OrientedBox(rng.normal(0, 0.3, 3), rng.uniform(0.2, 1.5, 3), np.linalg.qr(rng.normal(size=(3, 3)))[0])
            for _ in range(2)
        )
        inside = (one.centre + other.centre) / 2  # a point of both, or the pair is skipped
        if max(one.distance_outside(inside[None])[0], other.distance_outside(inside[None])[0]) > 0:
            continue
        meets = HalfspaceIntersection(np.concatenate([half_spaces(one), half_spaces(other)]), inside)
        shared = ConvexHull(meets.intersections).volume
        expected = shared / (one.sizes.prod() + other.sizes.prod() - shared)
        assert iou(one, other) == pytest.approx(expected, rel=1e-6)
        n_compared += 1
    assert n_compared > 20


def test_sides_below_2_cm_are_extended_to_2_cm() -> None:
    (thin,) = grown([box((1, 2, 3), (0.5, 0.001, 0.02))], 0.02)
    assert thin.sizes.tolist() == [0.5, 0.02, 0.02]
    assert thin.centre.tolist() == [1, 2, 3]


# Similarities


def test_overlap_is_the_share_of_detection_points_nearer_than_the_voxel() -> None:
    # distances 0, 0.125, exactly 0.25, and far: a distance of one voxel is not near enough
    base = block((0, 0, 0), (1, 1, 1), 0.25)
    model = an_object(base)
    points = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.875], [0.5, 0.5, 1.0], [0.5, 0.5, 2.0]])
    assert model.share_near(points, 0.25) == 0.5
    detection = an_object(np.concatenate([points, base[:4]]))
    assert overlap_similarity([detection], [model], 0.25)[0, 0] == 6 / 8
    assert overlap_similarity([model], [detection], 0.25)[0, 0] != 6 / 8


def two_at(cosine: float) -> tuple[MapObject, MapObject]:
    one = an_object(block((0, 0, 0)))
    return one, replace(one, feature=np.array(at_cosine(cosine)))


@pytest.mark.parametrize("cosine", [-0.5, 0.0, 0.6, 1.0])
def test_code_uses_the_cosine_and_the_paper_maps_it_to_0_1(cosine: float) -> None:
    one, other = two_at(cosine)
    assert semantic_similarity([one], [other], QUIET)[0, 0] == pytest.approx(cosine)
    assert semantic_similarity([one], [other], PAPER)[0, 0] == pytest.approx(cosine / 2 + 0.5)


def test_both_rules_sum_and_each_has_its_threshold() -> None:
    one, other = two_at(0.15)
    assert total_similarity([one], [other], QUIET)[0, 0] == pytest.approx(1.15)
    assert total_similarity([one], [other], PAPER)[0, 0] == pytest.approx(1.575)
    assert (QUIET.association_threshold, PAPER.association_threshold) == (1.2, 1.1)
    assert QUIET.model_copy(update={"sim_threshold": 0.9}).association_threshold == 0.9


def test_detection_joins_the_most_similar_object_at_or_above_the_threshold() -> None:
    similarity = np.array([[1.2, 1.0], [1.19, 1.1], [1.3, 1.9], [1.5, 1.5], [1.4, 1.0]])
    assert assign(similarity, 1.2).tolist() == [0, NEW_OBJECT, 1, 0, 0]


# Merges


def test_merge_weights_features_by_previous_detections() -> None:
    one = an_object(block((0, 0, 0)), 5, n=3, feature=axis(0), text=axis(2))
    other = an_object(block((0, 0, 0)), 9, n=1, feature=axis(1), text=axis(3))
    result = merged(one, other, QUIET, with_dbscan=False)
    assert result.feature == pytest.approx(np.array([3, 1, 0, 0]) / np.sqrt(10))
    assert result.text_feature == pytest.approx(np.array([0, 0, 3, 1]) / np.sqrt(10))
    assert (result.number, result.n_detections) == (5, 4)


def test_merge_averages_clouds_by_voxel_and_makes_a_new_box() -> None:
    one, other = an_object(block((0, 0, 0))), an_object(block((0.5, 0, 0)))
    result = merged(one, other, QUIET, with_dbscan=False)
    both = np.concatenate([one.points, other.points])
    assert result.points == pytest.approx(voxel_average(both, 0.025))
    assert result.box.sizes.max() > 0.7


def test_denoising_keeps_the_largest_cluster_but_not_in_tiny_objects() -> None:
    one = an_object(np.concatenate([block((0, 0, 0)), block((2, 0, 0), (0.1, 0.1, 0.1))]))
    clean = denoised(one, QUIET)
    assert len(clean.points) == len(block((0, 0, 0)))
    assert clean.box.sizes.max() < 0.5 < one.box.sizes.max()
    three = an_object(np.array([[0, 0, 0], [0.001, 0, 0], [0.5, 0, 0], [0.9, 0, 0]]))
    assert denoised(three, QUIET) is three  # its four points are three voxels


def part(low_z: float, number: int, **more) -> MapObject:  # type: ignore[no-untyped-def]
    """A block of six layers 5 cm apart starting at ``low_z``."""
    return an_object(block((0, 0, low_z)), number, **more)


def test_ratios_of_a_wall_and_objects_along_it_match_brute_force() -> None:
    rng = np.random.default_rng(0)
    wall = an_object(rng.uniform((0, 0, 0), (5, 0.1, 1), (1500, 3)))
    things = [an_object(rng.uniform((x, 0, 0), (x + 0.6, 0.4, 0.5), (200, 3))) for x in np.arange(0, 5, 0.5)]
    ratios = overlap_ratios([wall, *things], 0.05)
    for k, thing in enumerate(things, start=1):
        is_near = np.linalg.norm(wall.points[:, None] - thing.points, axis=2) < 0.05
        assert ratios[0, k] == is_near.any(axis=1).mean() > 0
        assert ratios[k, 0] == is_near.any(axis=0).mean() > 0


def test_contained_object_is_merged_into_its_container() -> None:
    whole, piece = an_object(block((0, 0, 0), (0.3, 0.3, 0.6)), 1, n=2), part(0.25, 2, n=3)
    (result,) = merge_overlapping([whole, piece], QUIET)
    assert (result.number, result.n_detections) == (1, 5)
    assert len(result.points) == len(whole.points)
