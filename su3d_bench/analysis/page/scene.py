"""Data of a map's instances for a page: names, scores, sizes, views, and when each was first seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from su3d_bench.core.errors import ConfigError, Su3dError, printable, printable_json
from su3d_bench.core.interfaces import HasPreviews
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Prediction
from su3d_bench.core.types import Frame, GroundTruth, Int32Array, Int64Array, UInt8Array
from su3d_bench.metrics.attribution.overlaps import Overlaps
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.instance.scene_counts import intersections
from su3d_bench.metrics.matching.nearest import Candidates
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.reports.page.maps import (
    box_in_view,
    colour_plane,
    extent_of,
    index_plane,
    nearest_colours,
    pack_map,
    thinned,
)
from su3d_bench.reports.pictures.canvas import class_colours
from su3d_bench.reports.pictures.maps import truth_owner
from su3d_bench.reports.pictures.scene import spread
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.records import read_updates

Had = TypeVar("Had")
MAX_VIEWS = 12  # listed frames of an instance
MAX_CAPTION = 240  # characters
MAX_STEPS = 500  # of a timeline: more than a slider has pixels


def fed_frames(run: FinishedRun, scene: str, method: str) -> list[int]:
    """The frames that a method was given, from its table of updates; empty if that cannot be read."""
    return [int(index) for index in _updates(run, scene, method).get("frame", ())]


def _updates(run: FinishedRun, scene: str, method: str) -> Mapping[str, Any]:
    updates = run.folder.job(scene, method).updates
    with suppress(Su3dError, OSError):
        return read_updates(updates, updates.name)
    return {}


@dataclass(frozen=True)
class Growth:
    """The updates of a map: ``steps`` in the page's form, a subset of ``frames`` if there are very many."""

    frames: Sequence[int]
    places: Int64Array
    steps: Mapping[str, Any]

    def step_of(self, views: Sequence[int]) -> int | None:
        """The step by which an instance with these views was first seen; None if no view is from a known frame."""
        known = [self._place_of[frame] for frame in views if frame in self._place_of]
        return int(np.searchsorted(self.places, min(known))) if known else None

    @cached_property
    def _place_of(self) -> Mapping[int, int]:
        return {frame: place for place, frame in reversed(list(enumerate(self.frames)))}


def growth_of(run: FinishedRun, scene: str, method: str) -> Growth | None:
    """The growth of a method's map; None if its table of updates has fewer than two frames.

    >>> growth = Growth([0, 40, 80], np.array([0, 2]), {})
    >>> growth.step_of([0]), growth.step_of([80, 40]), growth.step_of([7])
    (0, 1, None)
    """
    columns = _updates(run, scene, method)
    frames = [int(index) for index in columns.get("frame", ())]
    if len(frames) < 2:
        return None
    places = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_STEPS)).round().astype(np.int64))
    steps: dict[str, Any] = {"update": (places + 1).tolist(), "frame": [frames[place] for place in places]}
    if "n_instances" in columns:
        steps["held"] = [int(columns["n_instances"][place]) for place in places]
    return Growth(frames, places, steps)


def frames_of(instances: Instances, k: int) -> list[int]:
    """The frames in which an instance was seen, each once; empty if the method stores no views."""
    if not len(instances.views):
        return []
    rows = instances.views[instances.view_indptr[k] : instances.view_indptr[k + 1]]
    return list(dict.fromkeys(int(frame) for frame, _ in rows))


def instance_data(
    prediction: Prediction, k: int, classes: Int64Array | None, similarity: Any, frames: Mapping[int, Frame]
) -> dict[str, Any]:
    """An instance: points, class, similarities in thousandths, and for ``Instances`` also name, score and views."""
    data: dict[str, Any] = {}
    if classes is not None:
        data["class"] = int(classes[k])
    if similarity is not None:
        data["similarity"] = [round(1000 * float(value)) for value in similarity[k]]
    if not isinstance(prediction, Instances):
        assert not isinstance(prediction, DenseFeatures)
        return {"id": k, "points": int((prediction.instance == k).sum()), **data}
    views = frames_of(prediction, k)
    own = prediction.points[prediction.mask(k)]
    data |= {
        "id": int(prediction.ids[k]) if len(prediction.ids) else k,
        "name": printable((prediction.labels or prediction.names)[k] or prediction.names[k], 80),
        "caption": printable(prediction.captions[k], MAX_CAPTION),
        "score": round(float(prediction.scores[k]), 4),
        "points": len(own),
        "n_views": len(views),
        "views": views[:MAX_VIEWS],
    }
    data |= extent_of(own)
    boxes = {index: _box(own, frames[index]) for index in views if index in frames}
    seen = {index: box for index, box in boxes.items() if box is not None}
    if seen:
        best = max(
            seen, key=lambda index: ((seen[index][2] - seen[index][0]) * (seen[index][3] - seen[index][1]), -index)
        )
        data |= {"view": best, "box": seen[best]}
    return data


def _box(points: Any, frame: Frame) -> list[float] | None:
    height, width = frame.depth_m.shape
    return box_in_view(points[:: max(1, len(points) // 2000)], frame.camera_to_world, frame.intrinsics, width, height)


MAX_INSPECTED = 48  # frames read per scene
SKETCH_WIDTH = 160  # of a frame for these searches, if reading it smaller saves time


class SceneData:
    """The data of one scene, cached per dataset object: a run keeps its datasets."""

    def __init__(self, scene: str) -> None:
        self._name = scene.partition("/")[2]
        self._scene = scene
        self._truths: dict[tuple[int, str], GroundTruth] = {}
        self._candidates: dict[int, Candidates] = {}  # of ground truths that are cached above
        self._sequences: dict[int, Sequence[Frame]] = {}
        self._frames: dict[tuple[int, int, int], Frame] = {}

    def truth(self, dataset: Any, variant: str) -> GroundTruth:
        key = id(dataset), variant
        if key not in self._truths:
            self._truths[key] = dataset.ground_truth(self._name, variant)
        return self._truths[key]

    def candidates(self, truth: GroundTruth) -> Candidates:
        """The points of a ground truth, for nearest-neighbour queries."""
        if id(truth) not in self._candidates:
            self._candidates[id(truth)] = Candidates(truth.points)
        return self._candidates[id(truth)]

    def truth_of_run(self, run: FinishedRun, variant: str) -> GroundTruth:
        """The ground truth in the data of ``run``, which must be unchanged since the run."""
        return self.truth(run.dataset(self._scene), variant)

    def sequence(self, dataset: Any) -> Sequence[Frame]:
        """Every frame, in order."""
        if id(dataset) not in self._sequences:
            self._sequences[id(dataset)] = dataset.frames(self._name, 1)
        return self._sequences[id(dataset)]

    def frame(self, dataset: Any, index: int, width: int) -> Frame:
        """Frame ``index`` of the sequence, ``width`` pixels wide if the dataset reads smaller ones faster."""
        has_sketches = isinstance(dataset, HasPreviews)
        key = id(dataset), index, width if has_sketches else 0
        if key not in self._frames:
            sketched = dataset.sketch(self._name, index, width) if has_sketches else None
            self._frames[key] = self.sequence(dataset)[index] if sketched is None else sketched
        return self._frames[key]

    def in_turn(self, dataset: Any, fed: Iterable[int]) -> list[int]:
        """The frames to read, distant ones first: from those that methods were ``fed``, or from all if unknown."""
        n_frames = len(self.sequence(dataset))
        known = sorted({index for index in fed if 0 <= index < n_frames}) or range(n_frames)
        return [known[place] for place in spread(len(known), MAX_INSPECTED)]


class SceneReader:
    """The available data of one scene of a run; ``remarks``: what is not available, each once."""

    def __init__(self, run: FinishedRun, scene: str, data: SceneData) -> None:
        self._run, self._scene, self.data = run, scene, data
        self.remarks: list[str] = []

    def had(self, what: str, make: Callable[[], Had]) -> Had | None:
        """The result of ``make``; None and a remark if it fails."""
        try:
            return make()
        except Su3dError as error:
            line = printable(f"{what}: {error}")
            if line not in self.remarks:
                self.remarks.append(line)
            return None

    @cached_property
    def dataset(self) -> Any:
        """The dataset; None if its data are not those of the run."""
        return self.had("no frames, colours and ground truth", lambda: self._run.dataset(self._scene))

    @cached_property
    def sequence(self) -> Sequence[Frame]:
        """Every frame, in order; empty if they are not available."""
        if self.dataset is None:
            return ()
        return self.had("no frames", lambda: self.data.sequence(self.dataset)) or ()

    def truth(self, rules: ProtocolRules) -> GroundTruth | None:
        if self.dataset is None:
            return None
        return self.had("no ground truth", lambda: self.data.truth(self.dataset, rules.ground_truth))


Seen = tuple[Candidates, UInt8Array]  # points (n, 3) m seen in frames and their colours (n, 3)


@dataclass(frozen=True)
class TruthOverlay:
    """The ground truth shown with a map: its ``variant``, and the page's data ``about`` it.

    ``same``: index of each instance that is an object of this ground truth -> the object.
    """

    variant: str
    about: Mapping[str, Any]
    same: Mapping[int, Mapping[str, Any]]


class ShownTruths:
    """The ground truths of a scene shown with maps, each once, in the order of first use."""

    def __init__(self) -> None:
        self._truths: list[GroundTruth] = []

    def place(self, truth: GroundTruth) -> int:
        """The index of ``truth`` among those that are shown."""
        for place, known in enumerate(self._truths):
            if known is truth:
                return place
        self._truths.append(truth)
        return len(self._truths) - 1

    def packed(self, max_points: int, seen: Seen | None) -> list[str]:
        """The ground truths in the format of maps, in base64."""
        return [_packed(truth, max_points, seen) for truth in self._truths]


def not_shown_reason(run: FinishedRun, protocol: str, prediction: Prediction) -> str | None:
    """Why ``protocol`` cannot show what a map misses; None if it can."""
    with suppress(ConfigError):  # another version of the protocol
        rules = run.rules(protocol)
        return kind_incompatibility(rules, prediction) if rules.kind == "instance" else "counts no objects"
    return "its installed rules differ"


def judged_objects(truth: GroundTruth, overlaps: Overlaps) -> dict[str, list[int]]:
    """Indices of objects into ``instances_of``: the ``counted`` ones, and the ``missed`` ones among them.

    Missed as defined by the kind of error of that name.
    """
    place_of = {int(number): place for place, number in enumerate(instances_of(truth))}
    counted = [place_of.get(int(truth.instance[members[0]])) for members in overlaps.members]
    missed = set(overlaps.missed.tolist())
    return {
        "counted": [place for place in counted if place is not None],
        "missed": [place for k, place in enumerate(counted) if k in missed and place is not None],
    }


def same_objects(truth: GroundTruth, masks: Masks) -> dict[int, dict[str, Any]]:
    """For each of ``masks`` on the ground-truth points that matches an object with IoU > 0.5: its index and name.

    The index is that in ``instances_of``; fragments and merged masks match no object.
    """
    numbers = instances_of(truth)
    column = np.where(truth.instance > 0, np.searchsorted(numbers, truth.instance), len(numbers))
    shared = intersections(column, len(numbers) + 1, masks.indptr, masks.indices, np.arange(len(masks)))[:, :-1]
    union = masks.sizes[:, None] + np.bincount(column, minlength=len(numbers) + 1)[:-1] - shared
    row_of_class = truth_owner(truth)
    found: dict[int, dict[str, Any]] = {}
    for row, place in np.argwhere(2 * shared > union).tolist():  # objects are disjoint: at most one per mask
        called = _most(row_of_class[truth.instance == numbers[place]])
        found[row] = {"place": place, "name": printable(truth.labels.names[called], 80) if called >= 0 else ""}
    return found


def _most(classes: Int32Array) -> int:
    """The row of the most frequent label, -1 if no point has one."""
    known = classes[classes >= 0]
    return int(np.bincount(known).argmax()) if len(known) else -1


def instances_of(truth: GroundTruth) -> Int64Array:
    """The numbers of the instances of a ground truth, ascending."""
    return np.unique(truth.instance[truth.instance > 0]).astype(np.int64)


def _packed(truth: GroundTruth, max_points: int, seen: Seen | None) -> str:
    cloud = thinned(truth.points, max_points)
    numbers, names = instances_of(truth), [printable(name, 80) for name in truth.labels.names]
    row_of_class = truth_owner(truth)
    place = np.searchsorted(numbers, truth.instance)
    owner = np.where(truth.instance > 0, place, -1)
    planes: dict[str, Any] = {"owner": index_plane(owner[cloud.rows]), "class": index_plane(row_of_class[cloud.rows])}
    colours = None if seen is None else nearest_colours(cloud.points, *seen)
    if colours is not None:
        planes["colour"] = colour_plane(colours)
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(numbers) + 1))
    instances = []
    for k, number in enumerate(numbers.tolist()):
        rows = order[starts[k] : starts[k + 1]]
        called = _most(row_of_class[rows])
        one = {"id": number, "class": called, "points": len(rows), **extent_of(truth.points[rows])}
        instances.append(one | {"name": names[called] if called >= 0 else ""})
    tints = class_colours(truth.labels.names)
    about: dict[str, Any] = {
        "protocol": None, "classes": names, "class_colours": [tints[name] for name in truth.labels.names],
        "instances": instances, "queries": [],
    }  # fmt: skip
    return pack_map(cloud, planes, printable_json(about))
