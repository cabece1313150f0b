"""OpenSU3D by the text of its paper, sentence by sentence: slow, sharing only its settings with the pipeline.

NumPy, a KD-tree and scikit-learn's DBSCAN. One function per equation or sentence, named in its docstring; choices that
the paper leaves open are fields of ``OpenSU3DConfig``. The whole scene is one array, and every image uses all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from su3d_bench.opensu3d.config import OpenSU3DConfig

Array = NDArray[Any]
View = tuple[int, int]  # the index of an image, and the row of a detection in it

NONE = -1


class Cloud(NamedTuple):
    """Points (N, 3) and the ID (N,) of each, ``NONE`` if there is none."""

    points: Array
    ids: Array

    def where(self, chosen: Array) -> Cloud:
        return Cloud(self.points[chosen], self.ids[chosen])

    def followed_by(self, other: Cloud) -> Cloud:
        return Cloud(np.concatenate([self.points, other.points]), np.concatenate([self.ids, other.ids]))

    @property
    def named(self) -> list[int]:
        """uniq(ID)."""
        return [int(one) for one in np.unique(self.ids) if one != NONE]


class Sighting(NamedTuple):
    """The stored data of a detection: its points, and the metadata n, c, s_pred, f_MS and f_G."""

    points: Array
    name: str
    caption: str
    score: float
    multi_scale: Array
    of_image: Array


class Thing(NamedTuple):
    """An element (P, n, c, f_MV, bb_3D, centroid) of the map M, with its views in Q.

    ``rows`` are those of P_scene.
    """

    rows: Array
    name: str
    caption: str
    feature: Array
    box: Array
    centroid: Array
    views: list[View]


def mask_image(masks: Array, border_px: int, shape: str) -> Array:
    """M': "masks M are updated to M' with these IDs as per-pixel labels, including a border of px pixels around each".

    Largest first, so that the smaller of overlapping masks is on top; a ring has no instance, even on other masks.
    """
    image = np.full(masks.shape[1:], NONE)
    for k in sorted(range(len(masks)), key=lambda k: -np.count_nonzero(masks[k])):
        image[around(masks[k], border_px, shape)] = NONE
        image[masks[k]] = k
    return image


def around(mask: Array, border_px: int, shape: str) -> Array:
    """The pixels at most ``border_px`` from a pixel of ``mask``, including the mask."""
    from scipy.ndimage import distance_transform_cdt, distance_transform_edt

    near = mask.copy()
    if mask.any():
        # Only where the border can reach: distances of a whole image are slow.
        v, u = (slice(max(one.min() - border_px, 0), one.max() + border_px + 1) for one in np.nonzero(mask))
        outside = ~mask[v, u]
        distance = distance_transform_edt(outside) if shape == "disc" else distance_transform_cdt(outside, "chessboard")
        near[v, u] = distance <= border_px
    return near


def back_projected(depth: Array, intrinsics: Array, pose: Array, image: Array, settings: OpenSU3DConfig) -> Cloud:
    """P_frame, Eq. 1: { T (D(u, v) K^-1 (u, v, 1)), M'(u, v) }."""
    has_depth = np.isfinite(depth) & (depth > 0) & (depth >= settings.depth_min) & (depth <= settings.depth_max)
    if settings.background_pixel_rule == "drop":
        has_depth &= image != NONE
    v, u = np.nonzero(has_depth)
    rays = np.linalg.inv(intrinsics) @ np.stack([u, v, np.ones(len(u))])
    camera = depth[v, u].astype(float) * rays
    world = pose[:3, :3] @ camera + pose[:3, 3:]
    return Cloud(world.T, image[v, u])


def cells_of(*columns: Array) -> Array:
    """A number (N,) for each row of integer ``columns`` (N, any): equal exactly for equal rows."""
    rows = np.column_stack(columns).astype(np.int64)
    rows -= rows.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(rows.T), tuple(rows.max(axis=0) + 1)))


def reduced(cloud: Cloud, voxel: float) -> Cloud:
    """One point per voxel and ID: the first."""
    if voxel == 0 or not len(cloud.ids):
        return cloud
    _, first = np.unique(cells_of(np.floor(cloud.points / voxel), cloud.ids), return_index=True)
    return cloud.where(np.sort(first))


def crop_of(scene: Cloud, frame: Cloud, eps: float) -> Array:
    """P'_scene: "only points within the bounds of P_frame", widened by eps so that every match is inside."""
    low, high = frame.points.min(axis=0) - eps, frame.points.max(axis=0) + eps
    return np.asarray(((scene.points >= low) & (scene.points <= high)).all(axis=1))


def index_pairs(frame: Cloud, crop: Cloud, eps: float) -> tuple[Array, Array]:
    """{(i_frame, i_scene)}: each p of P_frame with the nearest q of P'_scene, where d(p, q) < eps."""
    from scipy.spatial import cKDTree

    if not len(crop.points):
        return np.zeros(0, int), np.zeros(0, int)
    distance, nearest = cKDTree(crop.points).query(frame.points)
    pairs = np.flatnonzero(distance < eps)
    return pairs, nearest[pairs]


def replaced_ids(frame: Cloud, crop: Cloud, settings: OpenSU3DConfig) -> dict[int, int]:
    """ID_f to ID_s according to Eq. 2: "if OverlapRatio >= rho, we perform an ID replacement"."""
    i_frame, i_scene = index_pairs(frame, crop, settings.eps)
    same: dict[int, int] = {}
    for id_f in frame.named:
        met = crop.ids[i_scene[frame.ids[i_frame] == id_f]]
        id_s, c_s = np.unique(met[met != NONE], return_counts=True)
        if not len(id_s):
            continue
        most = int(np.argmax(c_s))  # the lowest ID in a tie
        c_f, of_scene = np.count_nonzero(frame.ids == id_f), np.count_nonzero(crop.ids == id_s[most])
        divisor = {
            "as-printed": min(c_f, c_s[most]),
            "frame-segment": c_f,
            "smaller-segment": min(c_f, of_scene),
        }[settings.overlap_rule]
        if c_s[most] / divisor >= settings.overlap_threshold:
            same[id_f] = int(id_s[most])
    return same


def concatenated(scene: Cloud, near: Array, frame: Cloud, settings: OpenSU3DConfig) -> Cloud:
    """P_scene after "P'_frame, which is then concatenated to P_scene"; ``near`` (N,) are the points of P'_scene.

    "Additionally, set of points from P'_scene can also be deleted to retain constant sparsity": those whose voxel a new
    point takes, but no instance point for a point of none, which is then dropped itself.
    """
    if settings.density == "all":
        return scene.followed_by(frame)
    voxels = cells_of(np.floor(np.concatenate([scene.points[near], frame.points]) / settings.eps))
    contents, new = np.split(voxels, [np.count_nonzero(near)])
    holds_instance, is_instance = scene.ids[near] != NONE, frame.ids != NONE
    comes = is_instance | ~np.isin(new, np.append(contents[holds_instance], new[is_instance]))
    if settings.density == "frame":
        return scene.followed_by(frame.where(comes & ~np.isin(new, contents) & one_per_voxel(new, is_instance, 1)))
    comes &= one_per_voxel(new, is_instance, -1)
    goes = np.isin(contents, new[is_instance]) | (~holds_instance & np.isin(contents, new))
    stays = np.ones(len(near), bool)
    stays[np.flatnonzero(near)[goes]] = False
    return scene.where(stays).followed_by(frame.where(comes))


def one_per_voxel(voxel: Array, is_instance: Array, step: int) -> Array:
    """Whether a point is the first of its voxel, or the last (step -1): of instance points if there are any."""
    in_turn = np.lexsort([step * np.arange(len(voxel)), ~is_instance])
    _, first = np.unique(voxel[in_turn], return_index=True)
    return np.isin(np.arange(len(voxel)), in_turn[first])


def cosine(a: Array, b: Array) -> float:
    """The bracket in the two updated fusion equations, with their 1e-8."""
    return float(a @ b) / max(float(np.linalg.norm(a)) * float(np.linalg.norm(b)), 1e-8)


def multi_scale_feature(crops: Sequence[Array], settings: OpenSU3DConfig) -> Array:
    """f_MS of the k crops: the plain mean, or the weighted one in which f_1, the best-fit crop, has ratio 1."""
    k = len(crops)
    if settings.fusion.multi_scale == "direct":
        return np.asarray(sum(crops) / k)
    f_1 = crops[settings.fusion.crop_ratios.index(1.0)]
    return np.asarray(sum(cosine(f_1, f_i) * f_i for f_i in crops) / k)


def multi_view_feature(top: Sequence[Sighting], settings: OpenSU3DConfig) -> Array:
    """f_MV of the top m views: the plain mean, or with the images' own features, both terms inside the sum."""
    m = len(top)
    if settings.fusion.multi_view == "direct":
        return np.asarray(sum(one.multi_scale for one in top) / m)
    return np.asarray(sum(one.multi_scale + cosine(one.multi_scale, one.of_image) * one.of_image for one in top) / m)


def clusters_of(points: Array, settings: OpenSU3DConfig) -> list[Array]:
    """The rows of each cluster "with points >= 80% of the largest cluster", largest first; the rest is noise."""
    from sklearn.cluster import DBSCAN

    dbscan = DBSCAN(eps=settings.dbscan_eps, min_samples=settings.dbscan_min_points, algorithm="kd_tree")
    labels = dbscan.fit(points).labels_
    clusters = sorted((np.flatnonzero(labels == one) for one in range(labels.max() + 1)), key=lambda rows: -len(rows))
    return [rows for rows in clusters if len(rows) >= settings.split_fraction * len(clusters[0])]


class PaperProgram:
    """P_scene, Q and the stored metadata, extended image by image."""

    def __init__(self, settings: OpenSU3DConfig) -> None:
        self.settings = settings
        self.scene = Cloud(np.zeros((0, 3)), np.zeros(0, int))
        self.tracks: dict[int, list[View]] = {}  # Q
        self.seen: dict[View, Sighting] = {}

    def add_image(self, frame: Any, detections: Any) -> None:
        """Processes an image I' with its detections: section "2D to 3D Fusion & Tracking"."""
        settings = self.settings
        width = frame.depth_m.shape[1]  # the paper's px refer to images of the reference width
        px = settings.border_px * (width / settings.border_reference_width if settings.border_reference_width else 1)
        image = mask_image(detections.masks, round(px), settings.border_shape)
        cloud = back_projected(frame.depth_m, frame.intrinsics, frame.camera_to_world, image, settings)
        cloud = reduced(cloud, settings.eps if settings.frame_voxel is None else settings.frame_voxel)
        if not len(cloud.points):
            return
        near = crop_of(self.scene, cloud, settings.eps)
        same = replaced_ids(cloud, self.scene.where(near), settings)
        updated = cloud.ids.copy()
        for id_f in cloud.named:
            of_f = cloud.ids == id_f
            updated[of_f] = same.get(id_f, len(self.tracks))
            view = frame.index, detections.row_of(id_f)
            self.tracks.setdefault(int(updated[of_f][0]), []).append(view)
            self.seen[view] = self.sighting(detections, id_f, cloud.points[of_f])
        self.scene = concatenated(self.scene, near, Cloud(cloud.points, updated), settings)

    def sighting(self, detections: Any, k: int, points: Array) -> Sighting:
        """The stored data of detection ``k``."""
        crops = [
            np.asarray(detections.crop_features[k, detections.crop_ratios.index(ratio)], float)
            for ratio in self.settings.fusion.crop_ratios
        ]
        name = detections.names[k]
        return Sighting(
            points,
            name,
            detections.captions[k].strip() or f"{'an' if name[0] in 'aeiou' else 'a'} {name} in a scene",
            float(detections.scores[k]),
            multi_scale_feature(crops, self.settings),
            np.asarray(detections.global_feature, float),
        )

    def things(self) -> list[Thing]:
        """M, section "Post Processing": for each i of uniq(ID of P_scene) the instances found in it by DBSCAN."""
        found = []
        for parent in self.scene.named:
            own = np.flatnonzero(self.scene.ids == parent)
            clusters = clusters_of(self.scene.points[own], self.settings)
            for rows in (own[members] for members in clusters):
                views = self.tracks[parent]
                if len(clusters) > 1:
                    views = [view for view in views if self.hits(view, self.scene.points[rows])]
                found.append(self.thing(rows, views))
        return found

    def hits(self, view: View, points: Array) -> bool:
        """Whether the back-projected mask of ``view`` overlaps ``points``: both have a point in one voxel of eps."""
        of_mask, of_points = (np.floor(cloud / self.settings.eps) for cloud in (self.seen[view].points, points))
        return not {*map(tuple, of_mask)}.isdisjoint(map(tuple, of_points))

    def thing(self, rows: Array, views: list[View]) -> Thing:
        """Label and caption "corresponding to the highest S'_pred", f_MV of the top m, box and centroid of P_i."""
        points = self.scene.points[rows]
        by_score = sorted(views, key=lambda view: -self.seen[view].score)  # the earlier in a tie
        top = [self.seen[view] for view in by_score[: self.settings.top_m]]
        return Thing(
            rows,
            top[0].name,
            top[0].caption,
            multi_view_feature(top, self.settings),
            np.stack([points.min(axis=0), points.max(axis=0)]),
            points.mean(axis=0),
            views,
        )
