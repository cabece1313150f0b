"""3D proposals from files, from the mesh's shape and from the ground truth; each rule by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prediction_files import write_openmask3d, write_openyolo3d, write_scannet_text
from test_mesh_segments import sheet

from su3d_bench.baselines.openmask3d.method import OpenMask3D, OpenMask3DConfig
from su3d_bench.baselines.openmask3d.proposals import (
    ProposalConfig,
    chosen_nodes,
    contrast,
    linked_within,
    make_proposals,
    read_proposals,
    segments_of,
    split_into_parts,
    surface_proposals,
    voted_by_segments,
)
from su3d_bench.baselines.openmask3d.segment_tree import SegmentTree, contacts_of, is_within, merge_cost, merge_tree
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Proposals
from su3d_bench.core.types import SceneInfo, Surface

MASKS = np.array([[1, 1, 0, 0, 0, 0], [0, 1, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0]], bool)  # two overlap, one is empty
SCENE: dict[str, Any] = {
    "name": "room0",
    "masks": MASKS,
    "scores": np.array([0.9, 0.4, 0.2]),
    "labels": np.array([0, 0, 0]),
    "files": [f"pred_mask/room0_{k}.txt" for k in range(3)],
}


def made_proposals(points: np.ndarray, *masks: Sequence[int], scores: Sequence[float] | None = None) -> Proposals:
    return Proposals(
        points=points.astype(np.float32),
        indptr=np.cumsum([0, *(len(mask) for mask in masks)]).astype(np.int64),
        indices=np.array([k for mask in masks for k in mask], np.int32),
        scores=np.ones(len(masks)) if scores is None else np.array(scores, np.float64),
        source="made",
    )


def choice(most: int, min_points: int, max_share: float, same_iou: float) -> ProposalConfig:
    return ProposalConfig(
        surface_max=most, surface_min_points=min_points, surface_max_share=max_share, surface_duplicate_iou=same_iou
    )


def flat(n: int = 6) -> Surface:
    points = np.array([(k, 0, 0) for k in range(n)], np.float32)
    return Surface(points, np.zeros((0, 3), np.int32))


def masks_of(proposals: Proposals) -> list[list[int]]:
    return [proposals.mask(k).tolist() for k in range(len(proposals))]


class TestFiles:
    def test_mask3d_and_segment3d_export_is_read_from_the_last_decoder(self, tmp_path: Path) -> None:
        write_scannet_text(tmp_path / "decoder_-1", SCENE | {"labels": ["0.0"] * 3})
        found = read_proposals(tmp_path, "room0", flat())
        assert masks_of(found) == [[0, 1], [1, 2, 3], []]
        assert found.scores.tolist() == [0.9, 0.4, 0.2] and "scannet-text" in found.source

    def test_openmask3d_matrix_is_read_without_its_features(self, tmp_path: Path) -> None:
        write_openmask3d(tmp_path, SCENE, np.zeros((3, 4)))
        found = read_proposals(tmp_path, "room0", flat())
        assert masks_of(found) == [[0, 1], [1, 2, 3], []] and found.scores.tolist() == [1, 1, 1]

    def test_masks_with_scores_are_read_too(self, tmp_path: Path) -> None:
        write_openyolo3d(tmp_path, SCENE)
        assert np.allclose(read_proposals(tmp_path, "room0", flat()).scores, [0.9, 0.4, 0.2])

    @pytest.mark.parametrize("write", [write_scannet_text, write_openyolo3d])
    def test_masks_of_another_mesh_are_one_clear_error(self, tmp_path: Path, write: Any) -> None:
        write(tmp_path, SCENE)
        with pytest.raises(PredictionError, match="of 6 points, but the mesh of 'room0' has 7 vertices; use"):
            read_proposals(tmp_path, "room0", flat(7))

    def test_point_groups_are_masks_but_maps_with_points_are_not(self, tmp_path: Path) -> None:
        np.save(tmp_path / "room0.npy", np.array([0, 0, 1, -1, 1, 1]))
        assert masks_of(read_proposals(tmp_path, "room0", flat())) == [[0, 1], [2, 4, 5]]
        other = tmp_path / "labels"
        other.mkdir()
        (other / "room0.txt").write_text("1\n2\n" * 3)
        with pytest.raises(PredictionError, match="'scannet-semantic-text' has no masks over the mesh"):
            read_proposals(other, "room0", flat())


class TestParts:
    ROW = np.array([(x, 0, 0) for x in (0.0, 0.9, 1.8, 3.0, 3.5, 9.0)])

    def test_with_one_point_parts_are_linked_by_gaps_up_to_eps(self) -> None:
        """0, 0.9 and 1.8 are linked by gaps of 0.9, 3.0 and 3.5 by 0.5; from 1.8 to 3.0 it is too far."""
        assert linked_within(self.ROW, 0.95).tolist() == [0, 0, 0, 1, 1, 2]
        assert linked_within(self.ROW[:2], 0.9).tolist() == [0, 0]  # a gap of exactly eps links

    def test_each_part_is_a_mask_with_its_score_best_first(self) -> None:
        proposals = made_proposals(self.ROW, [0, 1, 3, 4], [5], [1, 2], scores=[0.2, 0.9, 0.2])
        parts = split_into_parts(proposals, 0.95, 1, 0, 1.0)
        assert masks_of(parts) == [[5], [0, 1], [3, 4], [1, 2]] and parts.scores.tolist() == [0.9, 0.2, 0.2, 0.2]

    def test_small_parts_are_dropped_and_four_of_five_kept(self) -> None:
        points = np.array([(x, 0, 0) for x in range(12)])
        masks = [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9], [10]]
        proposals = made_proposals(points, *masks, scores=[0.1, 0.6, 0.5, 0.4, 0.3, 0.9])
        parts = split_into_parts(proposals, 1.0, 1, 1, 0.8)  # [10] has no more than one point
        assert masks_of(parts) == [[2, 3], [4, 5], [6, 7], [8, 9]]
        assert len(split_into_parts(made_proposals(points, [0]), 1.0, 1, 0, 0.8)) == 0  # floor(0.8)

    def test_mask_takes_segments_it_covers_by_more_than_half(self) -> None:
        segments = np.array([0, 0, 1, 1, 1, 2])
        voted = voted_by_segments(made_proposals(self.ROW, [0, 2, 3], [5], [0]), segments)
        assert masks_of(voted) == [[2, 3, 4], [5], []]  # half of segment 0 is not more than half


def box_on_a_floor() -> Surface:
    """A floor of 4 x 4 m with a box of 1 x 1 x 1 m on it, with vertices 10 cm apart; the box's bottom is open."""
    heights = np.zeros((41, 41))
    vertices, triangles = sheet(heights.tolist(), 0.1)
    under = np.all((vertices[:, :2] > 1.55) & (vertices[:, :2] < 2.45), axis=1)
    floor = triangles[~under[triangles].any(axis=1)]
    parts, faces, start = [vertices], [floor], len(vertices)
    side, side_faces = sheet(np.zeros((11, 11)).tolist(), 0.1)
    flipped = side_faces[:, [0, 2, 1]]
    x, y = side[:, 0], side[:, 1]
    for points, corners in (
        (np.stack([x + 1.5, y + 1.5, np.ones_like(x)], 1), side_faces),
        (np.stack([x + 1.5, np.full_like(x, 1.5), y], 1), side_faces),
        (np.stack([x + 1.5, np.full_like(x, 2.5), y], 1), flipped),
        (np.stack([np.full_like(x, 1.5), x + 1.5, y], 1), flipped),
        (np.stack([np.full_like(x, 2.5), x + 1.5, y], 1), side_faces),
    ):
        parts.append(points.astype(np.float32))
        faces.append(corners + start)
        start += len(points)
    merged, inverse = np.unique(np.round(np.concatenate(parts), 4), axis=0, return_inverse=True)
    corners = inverse.reshape(-1)[np.concatenate(faces)]
    used, renumbered = np.unique(corners, return_inverse=True)
    return Surface(merged[used].astype(np.float32), renumbered.reshape(corners.shape).astype(np.int32))


class TestTree:
    def test_cheapest_pair_is_merged_first(self) -> None:
        """Three flat squares in a row, 0 and 1 level, 2 leaning: 0 and 1 become node 3, all of them node 4."""
        flat_part, flat_faces = sheet(np.zeros((4, 4)).tolist(), 0.01)
        parts = [
            flat_part,
            flat_part + np.array((0.04, 0, 0), np.float32),
            flat_part[:, [2, 1, 0]] + np.array((0.08, 0, 0), np.float32),
        ]
        vertices = np.concatenate(parts).astype(np.float32)
        triangles = np.concatenate([flat_faces + 16 * k for k in range(3)]).astype(np.int32)
        contacts = contacts_of(vertices, triangles, np.repeat(np.arange(3), 16))
        assert list(zip(contacts.first.tolist(), contacts.second.tolist(), strict=True)) == [(0, 1), (1, 2)]
        tree = merge_tree(contacts)
        assert tree.parent.tolist() == [3, 3, 4, 4, -1]
        assert sorted(tree.leaves[tree.start[3] : tree.end[3]].tolist()) == [0, 1]
        assert (tree.start[4], tree.end[4]) == (0, 3)
        assert is_within(tree, np.array([0, 2, 3, 4]), 3).tolist() == [True, False, True, True]

    def test_cost_grows_with_bend_and_size_and_falls_with_the_shared_border(self) -> None:
        assert merge_cost(5.0, 10, 40, 100) == pytest.approx(0.52 * 0.76 * 10)
        assert merge_cost(5.0, 10, 10, 100) == pytest.approx(0.52 * 0.01 * 10)
        assert merge_cost(1.0, 10, 40, 400) == pytest.approx(0.12 * 0.76 * 20)

    def test_contrast_is_border_bend_over_relative_length(self) -> None:
        """1250 patches of 4 cm² are 0.5 m²: full size; 50 of them count by the root of 0.04."""
        tree = SegmentTree(
            parent=np.array([-1, -1]),
            n_patches=np.array([1250, 50]),
            n_contacts=np.array([100, 0]),
            bend=np.array([40.0, 0.0]),
            leaves=np.arange(2),
            start=np.array([0, 1]),
            end=np.array([1, 2]),
            patch_m=0.02,
        )
        expected = [0.4 / (100 / 1250**0.5 + 0.2), 0.3 * 0.04**0.5 / 0.2]
        assert contrast(tree) == pytest.approx(expected)

    def test_better_of_two_nearly_equal_nested_parts_is_kept(self) -> None:
        tree = SegmentTree(
            parent=np.array([3, 3, 4, 4, -1]),
            n_patches=np.array([9, 1, 10, 10, 20]),
            n_contacts=np.ones(5, np.int64),
            bend=np.ones(5),
            leaves=np.arange(3),
            start=np.array([0, 1, 2, 0, 0]),
            end=np.array([1, 2, 3, 2, 3]),
            patch_m=0.02,
        )
        points, scores = np.array([9, 1, 10]), np.array([0.8, 0.5, 0.3, 0.9, 0.1])
        chosen = chosen_nodes(tree, points, scores, choice(10, 1, 1.0, 0.5))
        assert chosen.tolist() == [3, 1, 2, 4]  # 0 is 9 of the 10 points of 3; 4 has twice the points: IoU 0.5 itself
        assert chosen_nodes(tree, points, scores, choice(2, 2, 0.5, 1.0)).tolist() == [3, 0]

    def test_box_on_a_floor_stands_out_most(self) -> None:
        surface = box_on_a_floor()
        found = surface_proposals(surface, segments_of(surface), choice(5, 20, 0.5, 0.5))
        is_box = (np.abs(surface.vertices - (2, 2, 0.5)) <= 0.501).all(axis=1)
        best = np.isin(np.arange(len(is_box)), found.mask(0))
        assert (best & is_box).sum() / (best | is_box).sum() > 0.8
        assert (np.diff(found.scores) <= 0).all() and "without a network" in found.source

    def test_published_segments_are_used_if_available(self) -> None:
        vertices, triangles = sheet([[0.0] * 6] * 6)
        published = Surface(vertices, triangles, np.where(vertices[:, 0] < 0.25, 40, 7).astype(np.int32))
        assert segments_of(published).tolist() == np.where(vertices[:, 0] < 0.25, 1, 0).tolist()
        found = surface_proposals(published, segments_of(published), choice(5, 1, 0.9, 0.5))
        assert sorted(len(mask) for mask in masks_of(found)) == [18, 18]


def scene_with(surface: Surface) -> SceneInfo:
    return SceneInfo("rooms", "room0", 1, 1, "camera", read_surface=lambda: surface)


class TestConfig:
    def test_true_proposals_are_mapped_to_the_nearest_vertices_with_overlaps(self) -> None:
        truth = made_proposals(np.array([(0.1, 0, 0), (2.1, 0, 0), (4.9, 0, 0)]), [0, 1], [1, 2])
        found = make_proposals(ProposalConfig(proposals="oracle"), scene_with(flat()), lambda: truth)
        assert masks_of(found) == [[0, 1, 2, 3], [2, 3, 4, 5]] and found.source == "made"  # 3 is 0.9 from 2.1
        assert OpenMask3D(OpenMask3DConfig(proposals="oracle")).caveat is None

    def test_files_are_kept_as_exported_unless_parts_are_requested(self, tmp_path: Path) -> None:
        write_openyolo3d(tmp_path, SCENE | {"masks": np.array([[1, 1, 0, 0, 1, 1]] * 3, bool)})
        segments = np.arange(6, dtype=np.int32)
        surface = Surface(flat().vertices, flat().triangles, segments)
        for split, expected in (("surface", [[0, 1, 4, 5]] * 3), ("never", [[0, 1, 4, 5]] * 3),
                                ("always", [[0, 1], [4, 5]] * 3)):  # fmt: skip
            config = ProposalConfig(proposals_folder=tmp_path, split_parts=split, part_eps_m=1.0)  # type: ignore[arg-type]
            assert masks_of(make_proposals(config, scene_with(surface), None)) == expected
        method = OpenMask3D(OpenMask3DConfig(proposals_folder=tmp_path))
        assert method.caveat is None and list(method.inputs) == ["proposals"]
