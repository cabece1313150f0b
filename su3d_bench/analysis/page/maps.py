"""The maps of runs for their page: per scene, frames, ground truth and the contents of each map."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from su3d_bench.analysis.attribution import Inputs
from su3d_bench.analysis.page.scene import (
    MAX_INSPECTED,
    SKETCH_WIDTH,
    Growth,
    SceneData,
    SceneReader,
    Seen,
    ShownTruths,
    TruthOverlay,
    fed_frames,
    frames_of,
    growth_of,
    instance_data,
    instances_of,
    judged_objects,
    not_shown_reason,
    same_objects,
)
from su3d_bench.core.errors import ConfigError, Su3dError, printable, printable_json
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import Float32Array, Frame, Int64Array
from su3d_bench.metrics.attribution.arrays import EvaluatedScene, SceneOfMasks
from su3d_bench.metrics.matching.labelling import (
    class_index_of_ids,
    classes_of_prediction,
    cosines,
    scored_classes,
)
from su3d_bench.metrics.matching.nearest import Candidates, nearest
from su3d_bench.metrics.matching.transfer import masks_of, transfer_masks
from su3d_bench.metrics.metric import n_predictions, present
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic.score import has_feature
from su3d_bench.reports.page.maps import (
    COLOUR_NEAR_M,
    Cloud,
    colour_plane,
    frame_cover,
    index_plane,
    jpeg_text,
    nearest_classes,
    nearest_colours,
    pack_map,
    point_owners,
    thinned,
)
from su3d_bench.reports.pictures.canvas import class_colours
from su3d_bench.reports.pictures.scene import SEEN_POINTS, seen_points
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import read_prediction

MAX_POINTS, MIN_POINTS = 60_000, 3_000  # of one map: what a phone can draw, what still shows a room
BYTES_PER_POINT = 6.0  # in the page, measured on the rooms: position, colour, owner and true class, deflated, in base64
SHARE_OF_POINTS = 0.6  # of the page; the rest is for instances, pictures and tables
THUMBNAILS = 14  # frames of a scene that are shown
FRAMES_AT_ONCE = 6  # frames read for the map's colours between two checks of coverage
GREY_SHARE = 0.01  # fraction of points that may stay without a colour while there are frames left
EVERY = 8  # step of the points that are checked for being seen
THUMBNAIL_WIDTH, JPEG_QUALITY = 240, 62
MapOfRun = tuple[int, FinishedRun, str, str]


@dataclass(frozen=True)
class PageMap:
    """A map in the page's format; if it cannot be shown, ``content`` is empty and ``reason`` is set.

    ``truth``: the ground-truth variant shown with it, None if there is none.
    """

    run: int
    scene: str
    method: str
    content: str
    reason: str | None
    truth: str | None = None

    def listed(self) -> dict[str, Any]:
        """The entry of the page's list of maps."""
        return {name: value for name, value in vars(self).items() if name != "content"}


@dataclass(frozen=True)
class PageScene:
    """A scene of the page; ``thumbnails``: pairs of frame index and JPEG in base64; ``remarks``: what is missing.

    ``truths`` have the format of maps; each map refers to the one shown with it by its index here.
    """

    scene: str
    thumbnails: tuple[tuple[int, str], ...]
    maps: tuple[PageMap, ...]
    truths: tuple[str, ...]
    remarks: tuple[str, ...]

    def listed(self) -> dict[str, Any]:
        """The scene in the page's format, without its maps."""
        about = {"scene": self.scene, "thumbnails": dict(self.thumbnails)}
        return about | {"remarks": list(self.remarks), "truths": list(self.truths)}


def points_of_each(n_maps: int, max_bytes: int) -> int:
    """The number of points per map for a page of ``max_bytes``.

    >>> points_of_each(2, 30_000_000), points_of_each(160, 30_000_000)
    (60000, 18750)
    """
    share = int(SHARE_OF_POINTS * max_bytes / BYTES_PER_POINT / max(1, n_maps))
    return min(MAX_POINTS, max(MIN_POINTS, share))


@dataclass
class Spaces:
    """The encoders of runs and the features of the queries with each, computed once."""

    queries: tuple[str, ...]
    _encoders: dict[Path, Encoder] = field(default_factory=dict)
    _texts: dict[Path, Any] = field(default_factory=dict)

    def encoder(self, run: FinishedRun) -> Encoder:
        path = run.folder.path
        if path not in self._encoders:
            self._encoders[path] = run.encoder()
        return self._encoders[path]

    def naming(self, run: FinishedRun, prediction: Prediction) -> Encoder | None:
        """The encoder that names the instances of a map; None if all of them have labels."""
        labels = getattr(prediction, "labels", None)
        return None if labels is not None and all(labels) else self.encoder(run)

    def texts(self, run: FinishedRun) -> Any:
        """The features (Q, D) of the queries."""
        path = run.folder.path
        if path not in self._texts:
            self._texts[path] = self.encoder(run).encode_texts(list(self.queries))
        return self._texts[path]


def page_scene(
    scene: str,
    maps: Sequence[MapOfRun],
    spaces: Spaces,
    data: SceneData,
    max_points: int,
    report_activity: Callable[[str], None] = lambda doing: None,
    evaluated: Mapping[tuple[int, str], Mapping[str, EvaluatedScene]] = MappingProxyType({}),
) -> PageScene:
    """A scene with its ``maps``. A map that fails has a reason on the page instead.

    ``report_activity`` is called before each map is computed; ``evaluated``: existing evaluations of it, by protocol.
    """
    return _Scene(scene, maps, spaces, data, evaluated).page(max_points, report_activity)


@dataclass
class _Scene:
    """One scene under all methods of all runs."""

    scene: str
    maps: Sequence[MapOfRun]
    spaces: Spaces
    data: SceneData
    evaluated: Mapping[tuple[int, str], Mapping[str, EvaluatedScene]]
    frame_of: dict[int, Frame | None] = field(default_factory=dict)
    shown_truths: ShownTruths = field(default_factory=ShownTruths)

    @cached_property
    def reader(self) -> SceneReader:
        return SceneReader(self.maps[0][1], self.scene, self.data)

    def page(self, max_points: int, report_activity: Callable[[str], None]) -> PageScene:
        read = {key[:1] + key[3:]: self._read(key) for key in self.maps}
        chosen = self._chosen_frames([a_map for a_map in read.values() if isinstance(a_map, Instances)])
        frames = {
            index: frame for index in sorted(chosen) if (frame := self._frame(index, THUMBNAIL_WIDTH)) is not None
        }
        clouds = {key: thinned(one.points, max_points) for key, one in read.items() if not isinstance(one, str)}
        seen = self._seen([cloud.points for cloud in clouds.values()])
        made = []
        for index, run, scene, method in self.maps:
            report_activity(f"map of {printable(method, 60)}")
            prediction, about = read[index, method], (index, printable(scene, 200), printable(method, 200))
            if isinstance(prediction, str):
                made.append(PageMap(*about, "", prediction))
                continue
            growth = growth_of(run, scene, method)
            beside = self._beside((index, method), run, prediction)
            content = self._pack(run, prediction, clouds[index, method], frames, seen, growth, beside)
            made.append(PageMap(*about, content, None, None if beside is None else beside.variant))
        thumbnails = tuple((index, _thumbnail(frame)) for index, frame in frames.items())
        truths = tuple(self.shown_truths.packed(max_points, seen))
        return PageScene(printable(self.scene, 200), thumbnails, tuple(made), truths, tuple(self.reader.remarks))

    def _read(self, key: MapOfRun) -> Prediction | str:
        _, run, scene, method = key
        try:
            return read_prediction(run.folder.job(scene, method).prediction)
        except Su3dError as error:
            return printable(str(error))

    def _frame(self, index: int, width: int) -> Frame | None:
        """Frame ``index`` of the full sequence, read once; None if missing. ``width``: sufficient width in pixels."""
        if index not in self.frame_of:
            frame = None
            if 0 <= index < len(self.reader.sequence):
                frame = self.reader.had("no views", lambda: self.data.frame(self.reader.dataset, index, width))
            self.frame_of[index] = frame if frame is not None and frame.index == index else None
        return self.frame_of[index]

    def _seen(self, clouds: Sequence[Float32Array]) -> Seen | None:
        """The points seen in the shown frames, and in as many more as are needed to see nearly all of ``clouds``."""
        fed = [index for _, run, scene, method in self.maps for index in fed_frames(run, scene, method)]
        places = self.data.in_turn(self.reader.dataset, fed) if len(self.reader.sequence) else []
        unseen = np.concatenate([np.zeros((0, 3), np.float32), *(points[::EVERY] for points in clouds)])
        few = GREY_SHARE * len(unseen)
        unseen = _not_near([frame for frame in self.frame_of.values() if frame is not None], unseen)
        for start in range(0, len(places), FRAMES_AT_ONCE):
            if len(unseen) <= few:
                break
            more = (self._frame(index, SKETCH_WIDTH) for index in places[start : start + FRAMES_AT_ONCE])
            unseen = _not_near([frame for frame in more if frame is not None], unseen)
        read = [frame for frame in self.frame_of.values() if frame is not None]
        if not read:
            return None
        points, colours = seen_points(read, SEEN_POINTS)
        return Candidates(points), colours

    def _chosen_frames(self, maps: Sequence[Instances]) -> Sequence[int]:
        """The frames to show: as few as possible that show every instance, from those that the maps list."""
        return frame_cover([frames_of(a_map, k) for a_map in maps for k in range(len(a_map))], THUMBNAILS)

    def _beside(self, job: tuple[int, str], run: FinishedRun, prediction: Prediction) -> TruthOverlay | None:
        """The ground truth shown with a map, and which of its objects the map misses.

        It is that of the first usable instance protocol, otherwise that of the protocol whose classes the map shows.
        """
        fitting = (run.rules(name) for name in run.protocols if not not_shown_reason(run, name, prediction))
        judging = next(fitting, None)
        rules = shown_rules(run) if judging is None else judging
        truth = None if rules is None else self.reader.truth(rules)
        if rules is None or truth is None or not len(truth.points):
            return None
        about = {"truth": self.shown_truths.place(truth), "objects": len(instances_of(truth))}
        variant = rules.ground_truth
        if judging is None:
            if isinstance(prediction, DenseFeatures):
                return TruthOverlay(variant, about, {})
            cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
            moved = transfer_masks(prediction.points, masks_of(prediction), truth.points, cap_m, voxel_m)
            return TruthOverlay(variant, about, same_objects(truth, moved))

        def judged_by(rules: ProtocolRules) -> tuple[dict[str, Any], Mapping[int, Mapping[str, Any]]]:
            seen = self.evaluated.get(job, {}).get(rules.name)
            if not isinstance(seen, SceneOfMasks):
                rules = Inputs(run, job[1]).rules(rules)
                seen = SceneOfMasks(rules, truth, prediction, self.spaces.naming(run, prediction))
            same = same_objects(truth, seen.overlaps.predicted.masks)
            return {"protocol": rules.name, **judged_objects(truth, seen.overlaps)}, same

        judged, same = self.reader.had("no missed objects", partial(judged_by, judging)) or ({}, {})
        return TruthOverlay(variant, about | judged, same)

    def _pack(
        self,
        run: FinishedRun,
        prediction: Prediction,
        cloud: Cloud,
        frames: Mapping[int, Frame],
        seen: Seen | None,
        growth: Growth | None,
        beside: TruthOverlay | None,
    ) -> str:
        rules = shown_rules(run)
        truth = None if rules is None else self.reader.truth(rules)
        planes: dict[str, Any] = {"owner": index_plane(point_owners(prediction, cloud.rows))}
        colours = None if seen is None else nearest_colours(cloud.points, *seen)
        if colours is not None:
            planes["colour"] = colour_plane(colours)
        about: dict[str, Any] = {"protocol": None, "classes": [], "class_colours": [], "instances": [], "queries": []}
        classes: Int64Array | None = None
        about["beside"] = None if beside is None else beside.about
        if rules is not None:
            names = [entry.name for entry in rules.classes]
            tints = class_colours(names)
            about |= {"protocol": rules.name, "classes": names, "class_colours": [tints[name] for name in names]}
            of_truth = None if truth is None else class_index_of_ids(rules, truth.semantic)
            if truth is not None and of_truth is not None:
                of_truth = np.where((of_truth >= 0) & scored_classes(rules)[of_truth], of_truth, -1)
                planes["truth"] = nearest_classes(cloud.points, self.data.candidates(truth), of_truth).astype(np.uint16)
            classes = self.reader.had(
                "no classes", lambda: shown_classes(run, rules, prediction, of_truth, cloud, self.spaces)
            )
        if isinstance(prediction, DenseFeatures):
            if classes is not None:
                planes["class"] = index_plane(classes)
        else:
            similarity = self._similarity(run, prediction)
            about["queries"] = [] if similarity is None else list(self.spaces.queries)
            about["instances"] = [
                instance_data(prediction, k, classes, similarity, frames) for k in range(n_predictions(prediction))
            ]
            for k, of_truth_object in () if beside is None else beside.same.items():
                about["instances"][k]["object"] = of_truth_object
            if growth is not None and isinstance(prediction, Instances):
                about["growth"] = growth.steps
                for k, one in enumerate(about["instances"]):
                    one["born"] = growth.step_of(frames_of(prediction, k))
        return pack_map(cloud, planes, printable_json(about))

    def _similarity(self, run: FinishedRun, prediction: Prediction) -> Any:
        """The cosine (K, Q) of each instance with each query; None if the map has no features."""
        features = prediction.features
        if features is None or not len(features) or not self.spaces.queries:
            return None
        texts = self.reader.had("no similarities", lambda: self.spaces.texts(run))
        return cosines(features, texts) if texts is not None and texts.shape[1] == features.shape[1] else None


def shown_rules(run: FinishedRun) -> ProtocolRules | None:
    """The rules whose classes are used to show the maps of a run: point protocols before instance protocols."""
    fitting: list[ProtocolRules] = []
    for name in run.protocols:
        with suppress(ConfigError):  # rules of another version are skipped
            fitting += [rules for rules in (run.rules(name),) if rules.vocabulary is not None]
    return min(fitting, key=lambda rules: not rules.takes_dense, default=None)


def shown_classes(
    run: FinishedRun,
    rules: ProtocolRules,
    prediction: Prediction,
    truth: Int64Array | None,
    cloud: Cloud,
    spaces: Spaces,
) -> Int64Array:
    """The class of each instance, or of each drawn point of dense features; ``truth``: the true class of each point."""
    if isinstance(prediction, DenseFeatures):
        prediction = DenseFeatures(cloud.points, np.asarray(prediction.features[cloud.rows]))
    is_present = scored_classes(rules) if truth is None else present(truth, len(rules.classes))
    called = classes_of_prediction(rules, prediction, spaces.naming(run, prediction), is_present)
    return np.where(has_feature(prediction), called, -1) if isinstance(prediction, DenseFeatures) else called


def _not_near(frames: Sequence[Frame], points: Float32Array) -> Float32Array:
    """The ``points`` that get no colour from any of ``frames``."""
    seen, _ = seen_points(frames, SEEN_POINTS * len(frames) // MAX_INSPECTED)
    return points[nearest(seen, points, COLOUR_NEAR_M)[1] < 0]


def _thumbnail(frame: Frame) -> str:
    """A frame as a small JPEG in base64."""
    import cv2

    height, width = frame.depth_m.shape
    size = (THUMBNAIL_WIDTH, max(1, round(THUMBNAIL_WIDTH * height / width)))
    return jpeg_text(np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), np.uint8), JPEG_QUALITY)
