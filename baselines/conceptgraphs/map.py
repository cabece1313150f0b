"""ConceptGraphs' map of objects, frame by frame: what its two variants share.

Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/cfslam_pipeline_batch.py``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from su3d_bench.baselines.conceptgraphs.association import NEW_OBJECT, assign, total_similarity
from su3d_bench.baselines.conceptgraphs.config import InstanceScore, MappingConfig
from su3d_bench.baselines.conceptgraphs.objects import (
    MapObject,
    Sighting,
    denoised,
    merge_overlapping,
    merged,
    seen_enough,
    unit,
)
from su3d_bench.baselines.conceptgraphs.regions import LiftedRegion, kept_regions, lift, subtract_contained
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.types import Detections, Float32Array, Frame, Instances
from su3d_bench.predictions.base import instances_of


class ObjectMap:
    """Objects in the foreground, and one object a background class that takes every region of its name."""

    def __init__(self, config: MappingConfig, seed: int, background_names: Sequence[str] = ()) -> None:
        self._config = config
        self._seed = seed
        self._objects: list[MapObject] = []
        self._background: dict[str, MapObject | None] = dict.fromkeys(background_names)
        self._n_frames = 0
        self._n_created = 0
        self._feature_size = 0

    def __len__(self) -> int:
        return len(self._objects) + sum(one is not None for one in self._background.values())

    @property
    def n_points(self) -> int:
        """Points of all objects, background included."""
        return sum(len(one.points) for one in self._everything)

    @property
    def n_bytes(self) -> int:
        """What points and features of all objects take, their KD-trees apart."""
        arrays = [(one.points, one.feature, one.text_feature) for one in self._everything]
        return sum(array.nbytes for of_object in arrays for array in of_object)

    @property
    def _everything(self) -> list[MapObject]:
        return [one for one in (*self._objects, *self._background.values()) if one is not None]

    def update(self, frame: Frame, detections: Detections, text_features: Float32Array, timer: StageTimer) -> None:
        """Take in one frame; ``text_features`` (K, T) are those of the detections' names."""
        if detections.frame_index != frame.index:
            raise DataError(f"frame {frame.index}: the detections are those of frame {detections.frame_index}")
        self._n_frames += 1
        self._feature_size = detections.crop_features.shape[2]
        with timer.stage("filter"):
            is_background = np.array([name in self._background for name in detections.names], np.bool_)
            rows = kept_regions(detections, is_background, self._config)
            masks = subtract_contained(detections.boxes[rows], detections.masks[rows])
        with timer.stage("backproject"):
            lifted = list(lift(frame, rows, masks, self._config, self._seed))
        found = [self._object_of(region, detections, text_features) for region in lifted]
        if self._background:
            with timer.stage("background"):
                self._merge_background(found)
        foreground = [one for one in found if one.sightings[0].name not in self._background]
        if not foreground:  # the original goes on to the next frame here, past the periodic steps too
            return
        if not self._objects:
            self._objects = foreground
            return
        self._associate(foreground, timer)
        self._tidy_up(timer)

    def _object_of(self, region: LiftedRegion, detections: Detections, text_features: Float32Array) -> MapObject:
        k = region.detection
        self._n_created += 1
        seen = Sighting(
            detections.frame_index, k, detections.names[k], detections.captions[k], float(detections.scores[k])
        )
        return MapObject(
            number=self._n_created,
            points=region.points,
            box=region.box,
            feature=unit(detections.crop_features[k, 0].astype(np.float64)),
            text_feature=unit(text_features[k].astype(np.float64)),
            sightings=(seen,),
        )

    def _merge_background(self, found: Sequence[MapObject]) -> None:
        for one in found:
            name = one.sightings[0].name
            if name in self._background:
                before = self._background[name]
                self._background[name] = one if before is None else merged(before, one, self._config, with_dbscan=False)

    def _associate(self, found: Sequence[MapObject], timer: StageTimer) -> None:
        """All similarities are those before the first merge; no clustering here."""
        with timer.stage("match"):
            joins = assign(total_similarity(found, self._objects, self._config), self._config.association_threshold)
        with timer.stage("merge"):
            for one, j in zip(found, joins, strict=True):
                if j == NEW_OBJECT:
                    self._objects.append(one)
                else:
                    self._objects[j] = merged(self._objects[j], one, self._config, with_dbscan=False)

    def _tidy_up(self, timer: StageTimer) -> None:
        """What happens at every so many frames."""
        config = self._config
        if self._is_due(config.denoise_interval):
            with timer.stage("denoise"):
                self._objects = [denoised(one, config) for one in self._objects]
        if self._is_due(config.filter_interval):
            self._objects = seen_enough(self._objects, config)
        if self._is_due(config.merge_interval):
            with timer.stage("overlap"):
                self._objects = merge_overlapping(self._objects, config)

    def _is_due(self, interval: int) -> bool:
        return interval > 0 and self._n_frames % interval == 0

    def finish(self) -> Instances:
        """The map so far after its last clean-up, background objects last and labelled with their names."""
        background = [denoised(one, self._config) for one in self._background.values() if one is not None]
        objects = [denoised(one, self._config) for one in self._objects]
        objects = merge_overlapping(seen_enough(objects, self._config), self._config)
        everything = [*objects, *background]
        told = [_told(one) for one in everything]
        names, captions = tuple(name for name, _ in told), tuple(caption for _, caption in told)
        features = np.array([one.feature for one in everything], np.float32)
        seen = [one for each in everything for one in each.sightings]
        instances = instances_of(
            [one.points.astype(np.float32) for one in everything],
            "conceptgraphs",
            features=features.reshape(len(everything), self._feature_size),
            labels=("",) * len(objects) + names[len(objects) :] if background else None,
            names=names,
            captions=captions,
            ids=[one.number for one in everything],
        )
        return replace(
            instances,
            scores=np.array([_score(one, self._config.instance_score) for one in everything], np.float64),
            views=np.array([(one.frame_index, one.detection) for one in seen], np.int32).reshape(-1, 2),
            view_indptr=np.cumsum([0, *(one.n_detections for one in everything)]).astype(np.int64),
            view_names=tuple(one.name for one in seen),
            view_scores=np.array([one.score for one in seen], np.float64),
        )


def _told(one: MapObject) -> tuple[str, str]:
    """The name of most of its detections, the first seen of equals, and the caption of the surest one of that name."""
    names = Counter(seen.name for seen in one.sightings)
    name = max(names, key=lambda name: names[name])
    best = max((seen for seen in one.sightings if seen.name == name), key=lambda seen: seen.score)
    return name, best.caption


def _score(one: MapObject, rule: InstanceScore) -> float:
    if rule == "ones":
        return 1.0
    return float(one.n_detections if rule == "num-detections" else max(seen.score for seen in one.sightings))
