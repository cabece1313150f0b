"""OpenSU3D as the text of its paper says it, sentence by sentence: slow, and sharing no line with the pipeline.

Numpy, a KD-tree and scikit-learn's DBSCAN. A function an equation or a sentence, named in its docstring; what the paper
leaves open is a field of ``PaperSettings``. The whole scene is one array that grows, and every step looks at all of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
View = tuple[int, int]

NONE = -1


@dataclass(frozen=True)
class PaperSettings:
    """The paper's values, and the readings of what it leaves open."""

    crop_ratios: tuple[float, ...] = (0.8, 1.0, 1.2)
    multi_scale: Literal["direct", "weighted"] = "direct"
    multi_view: Literal["direct", "with-global"] = "direct"
    top_m: int = 5
    border_px: int = 20
    background_pixels: Literal["keep", "drop"] = "keep"
    depth_min: float = 0.0
    depth_max: float = np.inf
    frame_voxel: float = 0.02
    epsilon: float = 0.02
    rho: float = 0.3
    overlap_rule: Literal["smaller-segment", "frame-segment", "as-printed"] = "smaller-segment"
    density: Literal["scene", "frame", "all"] = "scene"
    dbscan: bool = True
    dbscan_epsilon: float = 0.1
    dbscan_points: int = 20
    split_share: float | None = 0.8


class Cloud(NamedTuple):
    """Points (N, 3) with an ID (N,) each, ``NONE`` where there is none."""

    points: Array
    ids: Array

    def where(self, chosen: Array) -> Cloud:
        return Cloud(self.points[chosen], self.ids[chosen])

    def followed_by(self, other: Cloud) -> Cloud:
        return Cloud(np.concatenate([self.points, other.points]), np.concatenate([self.ids, other.ids]))


@dataclass
class Sighting:
    """What is stored of a detection: M' gives its points, the rest is its metadata."""

    points: Array
    name: str
    caption: str
    score: float
    multi_scale_feature: Array
    global_feature: Array


@dataclass(frozen=True)
class Thing:
    """An element of the map M: (P, n, c, f_MV, bb_3D, centroid), with the views that Q holds for it."""

    rows: Array
    name: str
    caption: str
    feature: Array
    box: Array
    centroid: Array
    views: list[View]
    parent: int


def mask_image(masks: Array, border_px: int) -> Array:
    """M': "masks M are updated to M' with these IDs as per-pixel labels, including a border of px pixels around each".

    The largest mask first, so that the smaller is painted last; a ring is of no instance also where a mask lies.
    """
    image = np.full(masks.shape[1:], NONE)
    for k in sorted(range(len(masks)), key=lambda k: -int(masks[k].sum())):
        image[within(masks[k], border_px)] = NONE
        image[masks[k]] = k
    return image


def within(mask: Array, distance_px: int) -> Array:
    """The pixels at most so many rows and columns from a pixel of ``mask``."""
    near = np.zeros_like(mask)
    for v, u in np.argwhere(mask):
        near[max(v - distance_px, 0) : v + distance_px + 1, max(u - distance_px, 0) : u + distance_px + 1] = True
    return near


def back_projected(depth: Array, intrinsics: Array, pose: Array, image: Array, settings: PaperSettings) -> Cloud:
    """P_frame, Eq. 1: { T (D(u, v) K^-1 (u, v, 1)), M'(u, v) }."""
    inside = (depth > 0) & (depth >= settings.depth_min) & (depth <= settings.depth_max)
    if settings.background_pixels == "drop":
        inside &= image != NONE
    v, u = np.nonzero(inside)
    rays = np.linalg.inv(intrinsics) @ np.stack([u, v, np.ones(len(u))])
    camera = depth[v, u].astype(float) * rays
    world = pose[:3, :3] @ camera + pose[:3, 3:]
    return Cloud(world.T, image[v, u])


def voxels_of(points: Array, size: float) -> Array:
    return np.floor(points / size).astype(int)


def reduced(cloud: Cloud, size: float) -> Cloud:
    """One point a voxel an ID, the first."""
    if not size or not len(cloud.points):
        return cloud
    keys = np.column_stack([voxels_of(cloud.points, size), cloud.ids])
    _, first = np.unique(keys, axis=0, return_index=True)
    return cloud.where(np.sort(first))


def crop_of(scene: Cloud, frame: Cloud, epsilon: float) -> Array:
    """P'_scene: "containing only points within the bounds of P_frame", as rows of P_scene."""
    low, high = frame.points.min(axis=0) - epsilon, frame.points.max(axis=0) + epsilon
    return np.flatnonzero(((scene.points >= low) & (scene.points <= high)).all(axis=1))


def index_pairs(frame: Cloud, crop: Cloud, epsilon: float) -> list[tuple[int, int]]:
    """{(i_frame, i_scene)}: to each point p of P_frame the nearest q of P'_scene where d(p, q) < epsilon."""
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(crop.points).query(frame.points)
    return [(i, int(nearest[i])) for i in np.flatnonzero(distance < epsilon)]


def tracked(frame: Cloud, crop: Cloud, pairs: list[tuple[int, int]], settings: PaperSettings) -> dict[int, int]:
    """ID_f to ID_s where "the overlap ratio satisfies a pre-defined threshold", Eq. 2."""
    same: dict[int, int] = {}
    for id_f in np.unique(frame.ids[frame.ids != NONE]).tolist():
        matched = [int(crop.ids[j]) for i, j in pairs if frame.ids[i] == id_f and crop.ids[j] != NONE]
        if not matched:
            continue
        id_s, c_s = max(((id_s, matched.count(id_s)) for id_s in sorted(set(matched))), key=lambda one: one[1])
        n_f, n_s = int((frame.ids == id_f).sum()), int((crop.ids == id_s).sum())
        divisor = {"smaller-segment": min(n_f, n_s), "frame-segment": n_f, "as-printed": min(n_f, c_s)}
        if c_s / divisor[settings.overlap_rule] >= settings.rho:
            same[id_f] = id_s
    return same


def concatenated(scene: Cloud, frame: Cloud, settings: PaperSettings) -> Cloud:
    """P_scene after "P'_frame ... is then concatenated"; "points from P'_scene can also be deleted"."""
    if settings.density == "all" or not settings.frame_voxel:
        return scene.followed_by(frame)
    held = [tuple(key) for key in voxels_of(scene.points, settings.frame_voxel)]
    new = [tuple(key) for key in voxels_of(frame.points, settings.frame_voxel)]
    if settings.density == "frame":
        taken = set(held)
        return scene.followed_by(frame.where(np.array([key not in taken for key in new], bool)))
    of_instances = {key for key, id_f in zip(new, frame.ids, strict=True) if id_f != NONE}
    of_none = {*new} - of_instances
    goes = [key in of_instances or (id_s == NONE and key in of_none) for key, id_s in zip(held, scene.ids, strict=True)]
    kept = {key for key, id_s, gone in zip(held, scene.ids, goes, strict=True) if id_s != NONE and not gone}
    comes = [id_f != NONE or key not in kept for key, id_f in zip(new, frame.ids, strict=True)]
    return scene.where(~np.array(goes, bool)).followed_by(frame.where(np.array(comes, bool)))


def cosine(a: Array, b: Array) -> float:
    """The bracket of Eq. 5 and Eq. 6, with the paper's 1e-8."""
    return float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-8)


def multi_scale_feature(crops: Array, settings: PaperSettings) -> Array:
    """f_MS of the features (k, D) of the crops: Eq. 3, or Eq. 5 with the best-fit crop, that of ratio 1, as f_1."""
    k = len(crops)
    if settings.multi_scale == "direct":
        return sum(crops) / k
    best_fit = crops[settings.crop_ratios.index(1.0)]
    return sum(cosine(best_fit, f) * f for f in crops) / k


def multi_view_feature(seen: list[Sighting], settings: PaperSettings) -> Array:
    """f_MV of the top views: Eq. 4, or Eq. 6 with both terms inside the sum."""
    m = len(seen)
    if settings.multi_view == "direct":
        return sum(s.multi_scale_feature for s in seen) / m
    return sum(s.multi_scale_feature + cosine(s.multi_scale_feature, s.global_feature) * s.global_feature for s in seen) / m


def clusters_of(points: Array, settings: PaperSettings) -> list[Array]:
    """The rows of "clusters with points >= 80 % of the largest cluster", the largest first."""
    from sklearn.cluster import DBSCAN

    if not settings.dbscan:
        return [np.arange(len(points))]
    label = DBSCAN(eps=settings.dbscan_epsilon, min_samples=settings.dbscan_points).fit(points).labels_
    clusters = sorted((np.flatnonzero(label == one) for one in range(label.max() + 1)), key=lambda rows: -len(rows))
    if settings.split_share is None:
        return clusters[:1]
    return [rows for rows in clusters if len(rows) >= settings.split_share * len(clusters[0])]


@dataclass
class PaperProgram:
    """P_scene, Q and the stored metadata, which grow image by image."""

    settings: PaperSettings = field(default_factory=PaperSettings)
    scene: Cloud = field(default_factory=lambda: Cloud(np.zeros((0, 3)), np.zeros(0, int)))
    tracks: dict[int, list[View]] = field(default_factory=dict)
    seen: dict[View, Sighting] = field(default_factory=dict)

    def add_image(self, frame: Any, detections: Any) -> None:
        """One image I': section II-B up to "a new entry is added in Q"."""
        settings = self.settings
        image = mask_image(detections.masks, settings.border_px)
        cloud = back_projected(frame.depth_m, frame.intrinsics, frame.camera_to_world, image, settings)
        cloud = reduced(cloud, settings.frame_voxel)
        if not len(cloud.points):
            return
        same: dict[int, int] = {}
        crop = self.scene.where(crop_of(self.scene, cloud, settings.epsilon))
        if len(crop.points):
            same = tracked(cloud, crop, index_pairs(cloud, crop, settings.epsilon), settings)
        ids = np.full(len(cloud.ids), NONE)
        for id_f in np.unique(cloud.ids[cloud.ids != NONE]).tolist():
            id_s = same.get(id_f, len(self.tracks))
            self.tracks.setdefault(id_s, []).append((frame.index, id_f))
            ids[cloud.ids == id_f] = id_s
            self.seen[frame.index, id_f] = self.sighting(detections, id_f, cloud.points[cloud.ids == id_f])
        self.scene = concatenated(self.scene, Cloud(cloud.points, ids), settings)

    def sighting(self, detections: Any, k: int, points: Array) -> Sighting:
        at = [detections.crop_ratios.index(ratio) for ratio in self.settings.crop_ratios]
        return Sighting(
            points,
            detections.names[k],
            detections.captions[k] or f"{article(detections.names[k])} {detections.names[k]} in a scene",
            float(detections.scores[k]),
            multi_scale_feature(detections.crop_features[k][at].astype(float), self.settings),
            detections.global_feature.astype(float),
        )

    def things(self) -> list[Thing]:
        """The map M of "Post Processing": an element an i of uniq(ID of P_scene), split where DBSCAN splits it."""
        found = []
        for one in np.unique(self.scene.ids[self.scene.ids != NONE]).tolist():
            of_one = np.flatnonzero(self.scene.ids == one)
            for nth, rows in enumerate(clusters_of(self.scene.points[of_one], self.settings)):
                views = self.tracks[one]
                if nth:
                    views = [view for view in views if self.hits(view, self.scene.points[of_one[rows]])]
                found.append(self.thing(of_one[rows], views, one))
        return found

    def hits(self, view: View, points: Array) -> bool:
        """Whether the view's mask, back-projected, lies on the points."""
        from scipy.spatial import cKDTree

        distance, _ = cKDTree(points).query(self.seen[view].points)
        return bool((distance < self.settings.epsilon).any())

    def thing(self, rows: Array, views: list[View], parent: int) -> Thing:
        """Label and caption of the highest score, f_MV of the top m, box and centroid of the points."""
        points = self.scene.points[rows]
        best_first = sorted(views, key=lambda view: (-self.seen[view].score, view))
        top = [self.seen[view] for view in best_first[: self.settings.top_m]]
        return Thing(
            rows,
            top[0].name,
            top[0].caption,
            multi_view_feature(top, self.settings),
            np.stack([points.min(axis=0), points.max(axis=0)]),
            points.mean(axis=0),
            views,
            parent,
        )


def article(name: str) -> str:
    return "an" if name[:1].lower() in "aeiou" else "a"
