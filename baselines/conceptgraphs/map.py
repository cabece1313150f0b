"""ConceptGraphs' map of objects, frame by frame: association of detections with objects; shared by both variants.

Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/cfslam_pipeline_batch.py``,
``conceptgraph/slam/mapping.py`` and ``compute_overlap_matrix_2set``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from su3d_bench.baselines.conceptgraphs import objects as steps
from su3d_bench.baselines.conceptgraphs.objects import MapObject, MappingConfig, Sighting
from su3d_bench.core.errors import StoreError
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.maps import Instances, Masks, starts_of
from su3d_bench.core.types import Detections, Float32Array, Float64Array, Frame, Int64Array, OrientedBox

MIN_SIDE_M = 0.02  # thinner boxes are extended to it before intersection
MIN_IOU = 1e-6
NEW_OBJECT = -1
# A state's arrays: an object of N points, features of F and T dimensions, a box.
FORMS = {
    "points": "f8 N 3", "feature": "f8 F", "text_feature": "f8 T", "centre": "f8 3", "sizes": "f8 3",
    "rotation": "f8 3 3",
}  # fmt: skip
CLASSES = (MapObject, Sighting, OrientedBox)


def box_iou(detections: Sequence[MapObject], objects: Sequence[MapObject]) -> Float64Array:
    """IoU (M, N) of the boxes, with sides of at least 2 cm.

    If PyTorch3D rejects a box of the frame or the map as not planar enough, the IoU of axis-aligned extents
    is used for all pairs, as in the original after PyTorch3D's error.
    """
    of_detections = steps.grown([item.box for item in detections], MIN_SIDE_M)
    of_objects = steps.grown([item.box for item in objects], MIN_SIDE_M)
    if steps.are_coplanar([*of_detections, *of_objects]):
        return steps.oriented_iou(of_detections, of_objects)
    return steps.axis_aligned_iou(
        steps.extents_of_clouds([item.points for item in detections]),
        steps.extents_of_clouds([item.points for item in objects]),
    )


def overlap_similarity(detections: Sequence[MapObject], objects: Sequence[MapObject], voxel_m: float) -> Float64Array:
    """The share (M, N) of each detection's points nearer than ``voxel_m`` to the object; 0 for disjoint boxes."""
    similarity = np.zeros((len(detections), len(objects)))
    for i, j in np.argwhere(box_iou(detections, objects) >= MIN_IOU):
        similarity[i, j] = objects[j].share_near(detections[i].points, voxel_m)
    return similarity


def geometric_similarity(
    detections: Sequence[MapObject], objects: Sequence[MapObject], config: MappingConfig
) -> Float64Array:
    """s_geo (M, N) of the configured kind, 0..1."""
    if config.spatial_sim_type == "overlap":
        return overlap_similarity(detections, objects, config.downsample_voxel_size)
    return steps.axis_aligned_iou(
        steps.extents_of_boxes([item.box for item in detections]),
        steps.extents_of_boxes([item.box for item in objects]),
    )


def semantic_similarity(
    detections: Sequence[MapObject], objects: Sequence[MapObject], config: MappingConfig
) -> Float64Array:
    """s_sem (M, N): the cosine as in the code, or the paper's phi_sem = cosine / 2 + 1 / 2."""
    cosine: Float64Array = (
        np.stack([item.feature for item in detections]) @ np.stack([item.feature for item in objects]).T
    )
    return cosine if config.association == "code" else cosine / 2 + 0.5


def total_similarity(
    detections: Sequence[MapObject], objects: Sequence[MapObject], config: MappingConfig
) -> Float64Array:
    """(1 + b) s_geo + (1 - b) s_sem (M, N) with the physical bias b, 0 in all published commands."""
    geometric = geometric_similarity(detections, objects, config)
    semantic = semantic_similarity(detections, objects, config)
    return (1 + config.phys_bias) * geometric + (1 - config.phys_bias) * semantic


def assign(similarity: Float64Array, threshold: float) -> Int64Array:
    """The object (M,) for each detection: the most similar one at or above ``threshold``, otherwise NEW_OBJECT.

    Several detections may join one object; ties go to the first object.

    >>> assign(np.array([[1.3, 1.2], [1.1, 1.19], [1.0, 1.2]]), 1.2).tolist()
    [0, -1, 1]
    """
    best: Int64Array = np.argmax(similarity, axis=1)
    is_alike = similarity[np.arange(len(best)), best] >= threshold
    return np.where(is_alike, best, NEW_OBJECT)


class ObjectMap:
    """Foreground objects, and one object per background class, which gets all regions with its name."""

    def __init__(self, config: MappingConfig, seed: int, background_names: Sequence[str] = ()) -> None:
        self._config = config
        self._seed = seed
        self._objects: list[MapObject] = []
        self._background: dict[str, MapObject | None] = dict.fromkeys(background_names)
        self._n_frames = 0
        self._n_created = 0
        self._feature_size = 0

    def __len__(self) -> int:
        return len(self._objects) + sum(item is not None for item in self._background.values())

    @property
    def n_points(self) -> int:
        """Points of all objects, including background."""
        return sum(len(item.points) for item in self._everything)

    @property
    def n_bytes(self) -> int:
        """Bytes of points and features of all objects, without their KD-trees."""
        arrays = [(item.points, item.feature, item.text_feature) for item in self._everything]
        return sum(array.nbytes for of_object in arrays for array in of_object)

    @property
    def _everything(self) -> list[MapObject]:
        return [item for item in (*self._objects, *self._background.values()) if item is not None]

    def update(self, frame: Frame, detections: Detections, text_features: Float32Array, timer: StageTimer) -> None:
        """Add one frame; ``text_features`` (K, T) are those of the detections' names."""
        detections.check_of(frame)
        self._n_frames += 1
        self._feature_size = detections.crop_features.shape[2]
        with timer.stage("filter"):
            is_background = np.array([name in self._background for name in detections.names], np.bool_)
            rows = steps.kept_regions(detections, is_background, self._config)
            masks = steps.subtract_contained(detections.boxes[rows], detections.masks[rows])
        with timer.stage("backproject"):
            lifted = list(steps.lift(frame, rows, masks, self._config, self._seed))
        fresh = [self._object_of(region, detections, text_features) for region in lifted]
        if self._background:
            with timer.stage("background"):
                self._merge_background(fresh)
        foreground = [item for item in fresh if item.sightings[0].name not in self._background]
        if not foreground:  # the original skips to the next frame here, including the periodic steps
            return
        if not self._objects:
            self._objects = foreground
            return
        self._associate(foreground, timer)
        self._tidy_up(timer)

    def _object_of(self, region: steps.LiftedRegion, detections: Detections, text_features: Float32Array) -> MapObject:
        k = region.detection
        self._n_created += 1
        seen = Sighting(
            detections.frame_index,
            detections.row_of(k),
            detections.names[k],
            detections.captions[k],
            float(detections.scores[k]),
        )
        return MapObject(
            number=self._n_created,
            points=region.points,
            box=region.box,
            feature=steps.unit(detections.crop_features[k, 0].astype(np.float64)),
            text_feature=steps.unit(text_features[k].astype(np.float64)),
            sightings=(seen,),
        )

    def _merge_background(self, fresh: Sequence[MapObject]) -> None:
        for item in fresh:
            name = item.sightings[0].name
            if name in self._background:
                before = self._background[name]
                self._background[name] = (
                    item if before is None else steps.merged(before, item, self._config, with_dbscan=False)
                )

    def _associate(self, fresh: Sequence[MapObject], timer: StageTimer) -> None:
        """All similarities are computed before the first merge; no clustering here."""
        with timer.stage("match"):
            joins = assign(total_similarity(fresh, self._objects, self._config), self._config.association_threshold)
        with timer.stage("merge"):
            for item, j in zip(fresh, joins, strict=True):
                if j == NEW_OBJECT:
                    self._objects.append(item)
                else:
                    self._objects[j] = steps.merged(self._objects[j], item, self._config, with_dbscan=False)

    def _tidy_up(self, timer: StageTimer) -> None:
        """The periodic steps."""
        config = self._config
        if self._is_due(config.denoise_interval):
            with timer.stage("denoise"):
                self._objects = [steps.denoised(item, config) for item in self._objects]
        if self._is_due(config.filter_interval):
            self._objects = steps.seen_enough(self._objects, config)
        if self._is_due(config.merge_interval):
            with timer.stage("overlap"):
                self._objects = steps.merge_overlapping(self._objects, config)

    def _is_due(self, interval: int) -> bool:
        return interval > 0 and self._n_frames % interval == 0

    def state(self) -> dict[str, Any]:
        """The values from which ``restore`` recreates the map."""
        counts = [self._seed, self._n_frames, self._n_created, self._feature_size]
        return {"objects": self._objects, "background": self._background, "counts": counts}

    def restore(self, values: Mapping[str, Any]) -> None:
        """Fill this empty map."""
        if values["background"].keys() != self._background.keys():
            raise StoreError("saved state: 'background' does not fit the settings")
        self._objects, self._background = values["objects"], values["background"]
        self._seed, self._n_frames, self._n_created, self._feature_size = map(int, values["counts"])

    def finish(self) -> Instances:
        """The map after a final clean-up, background objects last and labelled with their names."""
        background = [steps.denoised(item, self._config) for item in self._background.values() if item is not None]
        objects = [steps.denoised(item, self._config) for item in self._objects]
        objects = steps.merge_overlapping(steps.seen_enough(objects, self._config), self._config)
        everything = [*objects, *background]
        descriptions = [_description(item) for item in everything]
        names, captions = tuple(name for name, _ in descriptions), tuple(caption for _, caption in descriptions)
        features = np.array([item.feature for item in everything], np.float32)
        clouds = [item.points.astype(np.float32) for item in everything]
        points = np.concatenate([np.zeros((0, 3), np.float32), *clouds])
        seen = [sighting for each in everything for sighting in each.sightings]
        return Instances.of(
            points,
            Masks(starts_of(map(len, clouds)), np.arange(len(points), dtype=np.int32)),
            np.array([_score(item, self._config.instance_score) for item in everything], np.float64),
            features.reshape(len(everything), self._feature_size),
            labels=("",) * len(objects) + names[len(objects) :] if background else None,
            names=names,
            captions=captions,
            views=[[(sighting.frame_index, sighting.detection) for sighting in item.sightings] for item in everything],
            view_names=tuple(sighting.name for sighting in seen),
            view_scores=np.array([sighting.score for sighting in seen], np.float64),
            ids=[item.number for item in everything],
        )


def _description(item: MapObject) -> tuple[str, str]:
    """The most frequent name of its detections (the first in a tie), and the caption of the most certain of them."""
    names = Counter(seen.name for seen in item.sightings)
    name = max(names, key=lambda name: names[name])
    best = max((seen for seen in item.sightings if seen.name == name), key=lambda seen: seen.score)
    return name, best.caption


def _score(item: MapObject, rule: steps.InstanceScore) -> float:
    if rule == "ones":
        return 1.0
    return float(item.n_detections if rule == "num-detections" else max(seen.score for seen in item.sightings))
