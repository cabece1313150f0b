"""From points with ids to instances: density clustering, boxes, names, captions, fused features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from su3d_bench.core.english import with_article
from su3d_bench.core.maps import Instances, Masks, starts_of
from su3d_bench.core.types import Float64Array, Int32Array, Int64Array
from su3d_bench.opensu3d.config import InstanceScore, OpenSU3DConfig
from su3d_bench.opensu3d.tracking import ImageRecord, TrackingTable, View, fuse_views

NOISE = -1
# Cluster ids are above scene-segment ids and contain them: 7000012 is a part of 12.
IDS = 1_000_000
CONFIDENCES: Mapping[InstanceScore, str] = {
    "mean": "mean score of its views",
    "max": "highest score of its views",
    "top-m-sum": "sum of the scores of its top m views over m",
}


@dataclass(frozen=True)
class Segment:
    """A candidate instance: ``id``, points (oldest first) and views (in order)."""

    id: int
    points: Int64Array
    views: tuple[View, ...]


def caption_of(name: str) -> str:
    """Default caption of an object: "an {object} in a scene", with the right article."""
    return f"{with_article(name.strip() or 'object')} in a scene"


def cluster(points: Float64Array, config: OpenSU3DConfig) -> Int64Array:
    """DBSCAN label (N,) of each point: 0, 1, ... or NOISE."""
    from su3d_bench.numerics.clusters import density_clusters

    return density_clusters(points, config.dbscan_eps, config.dbscan_min_points)


def kept_clusters(labels: Int64Array, split_fraction: float) -> list[int]:
    """Labels of clusters that become instances: at least ``split_fraction`` of the largest; largest first."""
    sizes = np.bincount(labels[labels != NOISE])
    order = np.argsort(-sizes, kind="stable")
    return [int(label) for label in order if sizes[label] >= split_fraction * sizes[order[0]]]


def segments_of(
    points: Float64Array,
    ids: Int32Array,
    index: Int64Array,
    table: TrackingTable,
    seeds: Mapping[int, int],
    images: Sequence[ImageRecord],
    config: OpenSU3DConfig,
) -> list[Segment]:
    """Instances after clustering, the largest cluster of each scene segment first; noise is dropped.

    ``index`` (N,) is the map index of each point, which identifies view hits and clusters (see ``id_of``).
    """
    order = np.argsort(ids, kind="stable")
    kept: list[Segment] = []
    split_off: list[Segment] = []
    scene_ids = sorted(table)
    ends = [np.searchsorted(ids[order], np.array(scene_ids, np.int32), side) for side in ("left", "right")]
    for scene_id, first, last in zip(scene_ids, *ends, strict=True):
        own = order[first:last]
        labels = cluster(points[own], config)
        clusters = kept_clusters(labels, config.split_fraction)
        views = tuple(table[scene_id])
        for rank, label in enumerate(clusters):
            members = own[labels == label]
            places = np.sort(index[members])
            hitting = views if len(clusters) == 1 else _views_that_hit(places, views, images)
            segment = Segment(id_of(scene_id, places, seeds.get(scene_id)), members, hitting)
            (split_off if rank else kept).append(segment)
    return kept + split_off


def id_of(scene_id: int, places: Int64Array, seed: int | None) -> int:
    """The id of the cluster of segment ``scene_id`` with the ascending map indices ``places``.

    The segment's own id if its ``seed`` is among them, else one derived from the cluster's first index: indices never
    change as the map grows, so an id never moves to another object, however often the map is requested.
    """
    at = np.searchsorted(places, -1 if seed is None else seed)
    is_home = seed is not None and at < len(places) and places[at] == seed
    return scene_id if is_home else (int(places[0]) + 1) * IDS + scene_id


def _views_that_hit(members: Int64Array, views: tuple[View, ...], images: Sequence[ImageRecord]) -> tuple[View, ...]:
    """Those of ``views`` that hit one of ``members`` (sorted, at least one)."""

    def is_hit(view: View) -> bool:
        hits = images[view.position].hits_of(view.detection)
        place = np.searchsorted(members, hits)
        return bool((members[np.minimum(place, len(members) - 1)] == hits).any())

    return tuple(view for view in views if is_hit(view))


def best_views(views: tuple[View, ...], images: Sequence[ImageRecord], m: int) -> tuple[View, ...]:
    """The ``m`` views of the highest prediction score; ties: the earlier image, then the earlier detection."""
    return tuple(sorted(views, key=lambda v: (-images[v.position].scores[v.detection], v.position, v.detection))[:m])


def instance_score(scores: Float64Array, rule: InstanceScore, m: int) -> float:
    """Confidence of an instance: 1, or computed by ``rule`` from the detector scores of its views."""
    if rule == "ones":
        return 1.0
    if rule == "max":
        return float(scores.max())
    if rule == "mean":
        return float(scores.mean())
    return float(np.sort(scores)[::-1][:m].sum() / m)


def to_instances(
    points: Float64Array,
    ids: Int32Array,
    segments: Sequence[Segment],
    images: Sequence[ImageRecord],
    config: OpenSU3DConfig,
) -> Instances:
    """The map: points with and without an instance, excluding points that clustering dropped as noise."""
    of_segments = np.concatenate([np.zeros(0, np.int64), *(segment.points for segment in segments)])
    is_kept = ids == 0
    is_kept[of_segments] = True
    row = np.cumsum(is_kept) - 1
    described = [_described(segment, images, config) for segment in segments]
    views = [(images[view.position], view.detection) for segment in segments for view in segment.views]
    dimension = images[0].n_dimensions if images else 0
    return Instances.of(
        points[is_kept].astype(np.float32),
        Masks(starts_of(len(segment.points) for segment in segments), row[of_segments].astype(np.int32)),
        scores=np.array([each.score for each in described], np.float64),
        features=np.array([each.feature for each in described], np.float32).reshape(len(segments), dimension),
        names=tuple(each.name for each in described),
        captions=tuple(each.caption for each in described),
        centroids=np.array([points[s.points].mean(axis=0) for s in segments], np.float32).reshape(len(segments), 3),
        views=[[images[view.position].source_of(view.detection) for view in s.views] for s in segments],
        ids=[segment.id for segment in segments],
        view_names=tuple(image.names[row] for image, row in views),
        view_scores=np.array([image.scores[row] for image, row in views], np.float64),
    )


class _Description(NamedTuple):
    name: str
    caption: str
    score: float
    feature: Float64Array


def _described(segment: Segment, images: Sequence[ImageRecord], config: OpenSU3DConfig) -> _Description:
    top = best_views(segment.views, images, config.top_m)
    best = images[top[0].position]
    name = best.names[top[0].detection]
    scores = np.array([images[view.position].scores[view.detection] for view in segment.views])
    feature = fuse_views(
        np.stack([images[view.position].feature_of(view.detection) for view in top]),
        np.stack([images[view.position].feature_of_image() for view in top]),
        config.fusion.multi_view,
    )
    caption = best.captions[top[0].detection].strip() or caption_of(name)
    return _Description(name, caption, instance_score(scores, config.instance_score, config.top_m), feature)
