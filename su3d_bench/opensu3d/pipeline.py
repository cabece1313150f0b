"""OpenSU3D: masks of single images, fused and tracked into one map of instances, incrementally."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.files.atomic import Scratch
from su3d_bench.core.files.state import check_range, read_state, write_state
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Detections, Frame, Int32Array, Int64Array, PerceptionNeeds, SceneInfo
from su3d_bench.numerics.visibility import depth_gap
from su3d_bench.opensu3d import tracking, voxel_map
from su3d_bench.opensu3d.config import SCHEMES, OpenSU3DConfig, crop_levels
from su3d_bench.opensu3d.frame_cloud import NO_DETECTION, FrameCloud, frame_cloud
from su3d_bench.opensu3d.postprocess import CONFIDENCES, IDS, segments_of, to_instances
from su3d_bench.opensu3d.voxel_map import NO_INSTANCE, VoxelMap

logger = logging.getLogger(__name__)
logger.setLevel(logging.INFO)  # dropped points are logged per scene


class OpenSU3D:
    """Masks of single images, fused and tracked into one map of instances, frame by frame: the reference pipeline."""

    name = "opensu3d"
    warms_up = True
    keeps_ids = True
    finishes_in_fork = True
    Config = OpenSU3DConfig
    about = MethodAbout(
        paper="Mohiuddin et al.: OpenSU3D: Open World 3D Scene Understanding using Foundation Models",
        source="written from the paper without reading the authors' code",
        licence="that of this project",
        needs=("masks of named objects with scores", "an encoder of images and texts"),
        status="each step is tested on hand-worked cases; not compared with the original, and no number of its paper "
        "has been reproduced",
    )
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        **{scheme: {"scheme": scheme} for scheme in SCHEMES},
        "owner": {"border_pixel_rule": "owner"},
        "removing": {"removal_views": 3},
        **{f"score-{rule}": {"instance_score": rule} for rule in ("mean", "max", "top-m-sum")},
    }
    # The paper's symbols, as varied in its ablation (Table I).
    short_names: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {
        "m": ("top_m", lambda value: value),
        "k": ("crop_ratios", crop_levels),
        "ratios": ("crop_ratios", lambda value: value),
    }

    def __init__(self, config: OpenSU3DConfig | None = None) -> None:
        self.config = config or OpenSU3DConfig()
        self._scratch = Scratch()
        self._clear()

    def _clear(self) -> None:
        self._scratch.close()
        self._scratch = Scratch()
        self._map = VoxelMap(self.config.eps, self.config.density)
        self._table = tracking.TrackingTable(list)
        self._images: list[tracking.ImageRecord] = []
        self._seeds: dict[int, int] = {}
        self._n_absent: dict[int, int] = {}  # views in a row that look through an instance
        self._next_id = NO_INSTANCE + 1
        self._n_detections = 0
        self._losses: Counter[str] = Counter()  # over all frames
        self.losses: dict[str, int] = {}  # of the last frame
        self.postprocess_ms: float | None = None  # of the last ``finish``

    @property
    def needs(self) -> PerceptionNeeds:
        return self.config.needs

    @property
    def caveat(self) -> str | None:
        """Source of the confidences, unless all are 1."""
        rule = self.config.instance_score
        return None if rule == "ones" else f"instance confidence: {CONFIDENCES[rule]}; not defined in the paper"

    @property
    def n_points(self) -> int:
        """Number of map points so far, including those without an instance."""
        return len(self._map)

    @property
    def n_instances(self) -> int:
        """Number of scene ids assigned so far, before post-processing."""
        return self._next_id - 1 - NO_INSTANCE

    def start(self, scene: SceneInfo) -> None:
        """Reset the state; nothing about the new scene is needed."""
        self._clear()

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Fuse one image into the map; the cost depends on the view, not on the size of the map."""
        detections.check_of(frame)
        if self.config.removal_views:
            with timer.stage("remove"):
                self._look_through(frame)
        with timer.stage("backproject"):
            cloud = frame_cloud(frame, detections.masks, self.config)
        with timer.stage("match"):
            matched = self._map.nearest(cloud.points[: cloud.n_inside])
        with timer.stage("track"):
            scene_id_of = self._track(cloud, matched, detections)
        with timer.stage("insert"):
            self._insert(cloud, matched, scene_id_of, detections)
        self.losses = {"n_swallowed": cloud.n_swallowed, "n_too_far": cloud.n_too_far}
        self._losses.update(self.losses)
        self._n_detections += len(detections)

    @property
    def _removed(self) -> Int32Array:
        """The scene ids of removed instances. Their points stay, so that others keep their index, but do not count."""
        n = self.config.removal_views
        return np.array([key for key, n_absent in self._n_absent.items() if n and n_absent >= n], np.int32)

    def _look_through(self, frame: Frame) -> None:
        """Count the views in a row in which more of an instance's points are looked through than seen.

        Occluded points and those outside the image do not count; a removed instance stays so.
        """
        own = np.flatnonzero((self._map.ids != NO_INSTANCE) & np.isin(self._map.ids, self._removed, invert=True))
        gap, ids, margin_m = depth_gap(self._map.points[own], frame), self._map.ids[own], self.config.removal_margin_m
        chosen = gap > margin_m, np.abs(gap) <= margin_m
        n_through, n_seen = (np.bincount(ids[some], minlength=self._next_id) for some in chosen)
        for key in np.flatnonzero(n_through + n_seen).tolist():
            self._n_absent[key] = self._n_absent.get(key, 0) + 1 if n_through[key] > n_seen[key] else 0

    def _track(self, cloud: FrameCloud, matched: Int64Array, detections: Detections) -> Int32Array:
        """Scene id of each detection, NO_INSTANCE for those without points; also added to Q."""
        scene_id_of = np.full(len(detections), NO_INSTANCE, np.int32)
        if cloud.n_inside == 0:
            return scene_id_of
        there = self._map.ids_of(matched)
        there[np.isin(there, self._removed)] = NO_INSTANCE
        overlaps = tracking.count_overlaps(cloud.owner[: cloud.n_inside], there)
        wanted = np.unique(overlaps.best[overlaps.best > NO_INSTANCE])
        # One axis at a time: numpy's minimum over rows of three is ten times slower.
        lower = np.array([axis.min() for axis in cloud.points.T]) - self.config.eps
        upper = np.array([axis.max() for axis in cloud.points.T]) + self.config.eps
        inside = np.append(self._map.count_inside(lower, upper, wanted), 0)
        n_scene = np.where(overlaps.best > NO_INSTANCE, inside[np.searchsorted(wanted, overlaps.best)], 0)
        ratios = tracking.overlap_ratios(overlaps, n_scene, self.config.overlap_rule)
        ids, self._next_id = tracking.assign_ids(overlaps, ratios, self.config.overlap_threshold, self._next_id)
        if self._next_id > IDS:
            raise DataError(f"frame {detections.frame_index}: the map has more than {IDS - 1:,} instances")
        scene_id_of[overlaps.segments] = ids
        for detection, scene_id in zip(overlaps.segments, ids, strict=True):
            self._table[int(scene_id)].append(tracking.View(len(self._images), int(detection)))
        return scene_id_of

    def _insert(self, cloud: FrameCloud, matched: Int64Array, scene_id_of: Int32Array, detections: Detections) -> None:
        ids = np.append(scene_id_of, NO_INSTANCE).astype(np.int32)[cloud.owner]  # NO_DETECTION is the last entry
        placed = self._map.insert(cloud.points, ids)
        self._plant(cloud, placed, scene_id_of)
        hit = placed.copy()
        hit[: cloud.n_inside] = np.where(placed[: cloud.n_inside] >= 0, placed[: cloud.n_inside], matched)
        hit[cloud.owner == NO_DETECTION] = -1
        self._images.append(tracking.record_of(detections, self.config.fusion, cloud.owner, hit, self._scratch))

    def _plant(self, cloud: FrameCloud, placed: Int64Array, scene_id_of: Int32Array) -> None:
        """Store the map point at the centre of each new id's first mask: the cluster there gets the id."""
        for detection, scene_id in enumerate(scene_id_of.tolist()):
            if scene_id == NO_INSTANCE or scene_id in self._seeds:
                continue
            own = np.flatnonzero((cloud.owner[: cloud.n_inside] == detection) & (placed[: cloud.n_inside] >= 0))
            if len(own):
                points = cloud.points[own]
                offsets = points - np.median(points, axis=0)
                self._seeds[scene_id] = int(placed[own[np.argmin((offsets**2).sum(axis=1))]])

    def finish(self) -> Instances:
        """The instances of the current map and its points without an instance."""
        start = time.perf_counter()
        by_age, removed = self._map.by_age, self._removed
        by_age = by_age[~np.isin(self._map.ids[by_age], removed)]
        points, ids = self._map.points[by_age], self._map.ids[by_age]
        segments = segments_of(points, ids, by_age, self._table, self._seeds, self._images, self.config)
        instances = to_instances(points, ids, segments, self._images, self.config)
        self.postprocess_ms = (time.perf_counter() - start) * 1e3
        return instances

    def save_state(self, folder: Path) -> None:
        """Store the map, Q and all detections."""
        tables = {key: [[view.position, view.detection] for view in views] for key, views in self._table.items()}
        counts = {"next_id": self._next_id, "n_detections": self._n_detections, "absent": self._n_absent}
        losses = {"losses": dict(self._losses), "last_losses": self.losses}
        images = [image.content() for image in self._images]
        write_state(
            folder,
            {"map": self._map.state(), "images": images, "table": tables, "seeds": self._seeds, **counts, **losses},
        )

    def load_state(self, folder: Path) -> None:
        """Continue from a stored state."""
        values = read_state(folder, {**voxel_map.FORMS, **tracking.FORMS})
        self._clear()
        self._next_id, self._n_detections = int(values["next_id"]), int(values["n_detections"])
        check_range("ids", values["map"]["ids"], NO_INSTANCE, min(self._next_id, IDS))
        self._map.restore(values["map"])
        self._images = [tracking.image_of(content, self._scratch) for content in values["images"]]
        for key, views in values["table"].items():
            for position, detection in views:
                if min(position, detection) < 0 or detection >= len(self._images[position].names):
                    raise StoreError(f"saved state: segment {key} has a view that does not exist")
            self._table[int(key)] = [tracking.View(*view) for view in views]
        self._seeds = {int(key): int(place) for key, place in values["seeds"].items()}
        self._n_absent = {int(key): int(n) for key, n in values["absent"].items()}
        check_range("seeds", np.array([*self._seeds.values()], np.int64), 0, len(self._map))
        self._losses.update(values["losses"])
        self.losses = dict(values["last_losses"])

    def close(self) -> None:
        """Reset the state, log dropped points, and free memory and disk space."""
        n_swallowed, n_too_far = self._losses["n_swallowed"], self._losses["n_too_far"]
        if n_swallowed:
            of_all = n_swallowed, self._n_detections, self.config.border_px
            logger.info("opensu3d: %d of %d detections lie entirely in the rings of others (border_px %g)", *of_all)
        if n_too_far:
            depth_max = self.config.depth_max
            logger.info("opensu3d: %d pixels beyond depth_max (%g m) were dropped", n_too_far, depth_max)
        self._clear()
        self._scratch.close()
