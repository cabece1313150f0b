"""Per-instance rows of runs: the best match of each predicted mask and each ground-truth instance.

A row shows what the evaluator itself used: masks on the ground-truth points, with the names and confidences that
count; for point metrics, the points that it counts, by their object and by the mask that names them. Counts that differ
from those of the run are an error, as in error attribution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.analysis.attribution import Explained, Matched, explained_of, matched_instances, run_remarks
from su3d_bench.core.errors import ConfigError, printable, suggest
from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.core.types import Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.attribution.arrays import SceneOfMasks, SceneOfPoints, ScoredPoints
from su3d_bench.metrics.attribution.masks import CAUSES, causes_of, count_masks, errors_of
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS
from su3d_bench.metrics.instance.scene_counts import hits
from su3d_bench.metrics.instance.score import OBJECT
from su3d_bench.metrics.matching.labelling import scored_classes
from su3d_bench.metrics.matching.nearest import Points
from su3d_bench.metrics.metric import n_predictions
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic import confusion
from su3d_bench.reports.pictures.maps import names_of
from su3d_bench.reports.tables.instances import InstanceRow
from su3d_bench.runs.executors import SCENE_DONE, Event, Report
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.verify import read_checked

MAX_NAME_CHARACTERS = 200  # characters of a text in a cell
THRESHOLDS = (0.25, 0.5)
Box = tuple[float | None, float | None, float | None, float | None, float | None, float | None]
EMPTY_MAP_SIMILARITY: Box = (None,) * 6


@dataclass(frozen=True)
class InstanceRows:
    """The rows, and ``remarks``: what has no rows and why, and caveats of the runs."""

    rows: tuple[InstanceRow, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Selection:
    """Methods, protocols and scenes by name; by default all that a run has."""

    methods: Sequence[str] = ()
    protocols: Sequence[str] = ()
    scenes: Sequence[str] = ()


def instance_rows(
    paths: Sequence[Path],
    chosen: Selection = Selection(),
    report: Report = lambda event: None,
) -> InstanceRows:
    """The instances of the runs in the folders ``paths``, scene by scene, under each supported protocol.

    Raises ``ConfigError`` if nothing has instances or the run does not have a given name.
    """
    rows: list[InstanceRow] = []
    remarks: list[str] = []
    for run in map(read_checked, paths):
        methods = _chosen_methods(run, chosen, remarks)
        scenes = tuple(chosen.scenes) or run.scenes
        for n, (scene, found) in enumerate(matched_instances(run, methods, scenes), start=1):
            for matched in found:
                rows += _of_job(matched)
            report(Event(f"{run.name} {scene}", SCENE_DONE, n, len(scenes)))
        remarks += run_remarks(run)
    if not rows and remarks:
        raise ConfigError(f"{remarks[0]}; there are no instances to list")
    return InstanceRows(tuple(rows), tuple(dict.fromkeys(remarks)))


def _chosen_methods(run: FinishedRun, chosen: Selection, remarks: list[str]) -> list[Explained]:
    """The methods that are listed; adds to ``remarks`` why another has no rows."""
    for method in chosen.methods:
        run.check_method(method)
    for scene in chosen.scenes:
        if scene not in run.scenes:
            hint = suggest(scene, run.scenes, "it has")
            raise ConfigError(f"{run.name}: has no scene '{printable(scene, 100)}'{hint}")
    methods = []
    for method in chosen.methods or run.methods:
        try:
            explained = explained_of(run, method, chosen.protocols)
        except ConfigError as error:
            if chosen.protocols:
                raise
            remarks.append(str(error))
            continue
        remarks += explained.remarks
        if any(explained.scored_under(scene) for scene in run.scenes):
            methods.append(explained)
        else:
            remarks.append(f"{run.name}: {printable(method, 80)} has no score of kind instance or semantic")
    return methods


def _of_job(matched: Matched) -> Iterator[InstanceRow]:
    explained, rules, prediction = matched.explained, matched.rules, matched.prediction
    has_places = explained.run.data.truth_files is None  # files have no coordinates
    where = (
        explained.run.name, printable(matched.scene), printable(explained.method), printable(rules.name),
    )  # fmt: skip
    if isinstance(matched.evaluated, SceneOfPoints):
        scored = matched.evaluated.scored
        named = scored.points
        counts = confusion.per_scene(named.true_class, named.predicted, scored.is_counted)
        explained.check_same_counts(rules.name, matched.scene, counts)
        n_instances = int(matched.truth.instance.max(initial=0))
        yield from _OfPoints(rules, prediction, scored, n_instances, has_places=has_places).rows(where)
        return
    assert isinstance(matched.evaluated, SceneOfMasks) and not isinstance(prediction, DenseFeatures)
    explained.check_same_counts(rules.name, matched.scene, count_masks(*matched.evaluated.evaluated))
    yield from _rows(where, rules, prediction, matched.evaluated, matched.truth.points if has_places else None)


def _rows(
    where: tuple[str, str, str, str],
    rules: ProtocolRules,
    prediction: Instances | Partition,
    seen: SceneOfMasks,
    points: Points | None,
) -> Iterator[InstanceRow]:
    (values, masks, scoring), overlaps = seen.evaluated, seen.overlaps
    least = scoring.min_region_size
    at_25, at_50 = hits(values, masks.masks, masks.class_ids, masks.scores, scoring.class_ids, least, THRESHOLDS)
    errors = errors_of(overlaps)
    value_of = [int(values[members[0]]) for members in overlaps.members]
    number_of = [value % INSTANCES_PER_CLASS for value in value_of]
    ids = _ids(prediction, len(masks.masks))
    class_of = _class_names(rules)
    called = [class_of.get(int(one), "") for one in masks.class_ids]
    true_classes = [class_of[int(one)] for one in overlaps.class_of_instance]
    for k, name in enumerate(names_of(prediction)):
        met, iou = _best(overlaps.iou[k])
        yield InstanceRow(
            *where, "predicted", ids[k], k, called[k], printable(name, MAX_NAME_CHARACTERS), float(masks.scores[k]),
            len(masks.masks.mask(k)), None, bool(overlaps.is_counted[k]), iou,
            None if met is None else number_of[met], "" if met is None else true_classes[met],
            bool(at_25.is_hit[k]), bool(at_50.is_hit[k]), errors.of_mask[k], *_box(points, masks.masks.mask(k)),
        )  # fmt: skip
    for g, members in enumerate(overlaps.members):
        met, iou = _best(overlaps.iou[:, g])
        yield InstanceRow(
            *where, "true", number_of[g], None, true_classes[g], "", None,
            len(members), None, True, iou, None if met is None else ids[met], "" if met is None else called[met],
            value_of[g] in at_25.values, value_of[g] in at_50.values, errors.of_instance[g], *_box(points, members),
        )  # fmt: skip


class _OfPoints:
    """The counted points of a scene, grouped by ground-truth object and by predicted name.

    An object is an instance of one class, or all points of a class without an instance; a naming is all points that one
    mask gives one class, or without masks all points predicted as that class. Both are rows of ``_distinct``.
    """

    def __init__(
        self,
        rules: ProtocolRules,
        prediction: Instances | Partition | DenseFeatures,
        scored: ScoredPoints,
        n_instances: int,
        *,
        has_places: bool,
    ) -> None:
        points = scored.points
        self._rows = np.flatnonzero((points.true_class >= 0) & scored.is_counted[points.true_class])
        true, self._called = points.true_class[self._rows], points.predicted[self._rows]
        mask = points.mask[self._rows] if scored.has_masks else np.full(len(self._rows), -1)
        is_instance = points.object_id[self._rows] <= n_instances
        number = np.where(is_instance, points.object_id[self._rows], -1)
        self._is_right = true == self._called
        self._cause = causes_of(points, has_masks=scored.has_masks)[self._rows]
        is_named = self._called >= 0
        self._objects, self._object_of = _distinct(true, number)
        self._namings, naming = _distinct(self._called[is_named], mask[is_named])
        self._naming_of = np.full(len(self._rows), -1)
        self._naming_of[is_named] = naming
        self._positions = scored.positions if has_places else None
        self._classes = [printable(entry.name, MAX_NAME_CHARACTERS) for entry in rules.classes]
        self._takes_part = scored_classes(rules)
        self._ids: list[int] = []
        self._names: list[str] = []
        if not isinstance(prediction, DenseFeatures):
            self._ids = _ids(prediction, n_predictions(prediction))
            self._names = [printable(name, MAX_NAME_CHARACTERS) for name in names_of(prediction)]

    def rows(self, where: tuple[str, str, str, str]) -> Iterator[InstanceRow]:
        """The predicted rows, then the ground-truth rows."""
        names, iou = self._classes, self._overlaps()
        called_as = np.array([called for called, _ in self._namings], np.int64)
        true_class = np.array([true for true, _ in self._objects], np.int64)
        counted = self._takes_part[true_class]
        hits_of = np.where((called_as[:, None] == true_class) & counted, iou, 0.0)
        for k, (called, mask) in enumerate(self._namings):
            met, best = _best(np.where(counted, iou[k], 0.0))
            of = None if met is None else self._objects[met]
            members, hit = np.flatnonzero(self._naming_of == k), hits_of[k].max(initial=0)
            yield InstanceRow(
                *where, "predicted", self._ids[mask] if mask >= 0 else None, mask if mask >= 0 else None, names[called],
                self._names[mask] if mask >= 0 else "", None, len(members), self._n_right(members),
                bool(self._takes_part[called]), best, None if of is None or of[1] < 0 else of[1],
                "" if of is None else names[of[0]], bool(hit > 0.25), bool(hit > 0.5),
                self._error(members), *self._box(members),
            )  # fmt: skip
        for g, (true, number) in enumerate(self._objects):
            met, best = _best(iou[:, g])
            of = None if met is None else self._namings[met]
            members, hit = np.flatnonzero(self._object_of == g), hits_of[:, g].max(initial=0)
            yield InstanceRow(
                *where, "true", number if number >= 0 else None, None, names[true], "", None, len(members),
                self._n_right(members), bool(self._takes_part[true]), best,
                None if of is None or of[1] < 0 else self._ids[of[1]],
                "" if of is None else names[of[0]], bool(hit > 0.25), bool(hit > 0.5), self._error(members),
                *self._box(members),
            )  # fmt: skip

    def _overlaps(self) -> Float64Array:
        """The IoU (K, G) of each naming with each object over the counted points."""
        n, m = len(self._namings), len(self._objects)
        is_named = self._naming_of >= 0
        shared = np.bincount(self._naming_of[is_named] * m + self._object_of[is_named], minlength=n * m).reshape(n, m)
        of_naming = np.bincount(self._naming_of[is_named], minlength=n)
        of_object = np.bincount(self._object_of, minlength=m)
        return np.asarray(shared / np.maximum(of_naming[:, None] + of_object - shared, 1), np.float64)

    def _n_right(self, members: Int64Array) -> int:
        return int(self._is_right[members].sum())

    def _error(self, members: Int64Array) -> str:
        """The cause of most of the wrong points; on a tie, the first in ``CAUSES``."""
        causes = self._cause[members]
        n = np.bincount(causes[causes >= 0], minlength=len(CAUSES))
        return CAUSES[int(n.argmax())] if n.any() else ""

    def _box(self, members: Int64Array) -> Box:
        return _box(self._positions, self._rows[members])


def _distinct(classes: Int64Array, numbers: Int64Array) -> tuple[list[tuple[int, int]], Int64Array]:
    """The distinct pairs, ascending by number and then class, and the index of each point's pair."""
    pairs, place = np.unique(np.stack([numbers, classes], axis=1), axis=0, return_inverse=True)
    return [(int(one), int(number)) for number, one in pairs], place.reshape(-1)


def _class_names(rules: ProtocolRules) -> dict[int, str]:
    if not rules.names_masks:
        return {OBJECT: rules.curve_names[0]}
    return {entry.id: printable(entry.name, MAX_NAME_CHARACTERS) for entry in rules.classes}


def _ids(prediction: Instances | Partition, n: int) -> list[int]:
    ids = prediction.ids if isinstance(prediction, Instances) else ()
    return [int(one) for one in ids] if len(ids) == n else list(range(n))


def _best(iou: Float64Array) -> tuple[int | None, float]:
    """The index of the highest IoU (the first on a tie; None if it is 0), and the IoU."""
    place = int(iou.argmax()) if len(iou) else 0
    best = float(iou[place]) if len(iou) else 0.0
    return (place if best > 0 else None), best


def _box(points: Points | None, members: Int32Array | Int64Array) -> Box:
    if points is None or not len(members):
        return EMPTY_MAP_SIMILARITY
    own = points[members].astype(np.float64)
    low, high = own.min(axis=0), own.max(axis=0)
    x, y, z = (float(value) for value in (low + high) / 2)
    return x, y, z, *(float(value) for value in high - low)  # type: ignore[return-value]
