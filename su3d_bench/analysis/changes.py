"""How the maps of a finished run follow changes of their scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.analysis.identity import over_time
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.interfaces import Encoder, HasChanges, UsesGroundTruth
from su3d_bench.core.maps import DenseFeatures, Instances, Partition
from su3d_bench.core.types import BoolArray, Float32Array, Frame, GroundTruth, Int64Array, SceneChange
from su3d_bench.formats.tables.table import NOT_MEASURED, Table, percent, text_table
from su3d_bench.metrics import changes as metric
from su3d_bench.metrics.changes import NEVER, MapAt, Pairs, Places
from su3d_bench.metrics.instance.average_precision import InstanceCounts, combine
from su3d_bench.metrics.instance.score import masks_and_scores
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.matching.transfer import masks_of_partition, reduce_to_voxels, transfer_masks
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import first_instances
from su3d_bench.numerics.visibility import SEEN_M, depth_gap, visible
from su3d_bench.runs.executors import Report
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import Part, build_method
from su3d_bench.runs.scene_data import SceneData
from su3d_bench.store.predictions import read_prediction

COLUMNS = ("ghosts", "ghost points", "found", "removed", "wrong merges", "ObjectF1", "4D ObjectF1", "AppearedF1",
           "DisappearedF1", "ChangeF1", "t-AP", "t-AP50", "where then", "where now")  # fmt: skip
WAITS = ("updates until found", "updates until removed")
SPACING_M, MIN_POINTS = 0.03, 25  # of points that count, and of a seen object: 100 vertices of a scan at 1.5 cm


@dataclass(frozen=True)
class Changes:
    """The values of a method over all scenes, fractions and updates; None for undefined ones."""

    method: str
    protocol: str
    values: Mapping[str, float | None]


_Known = tuple[Places, Float32Array, Sequence[str]]  # the places, points and names of a scene
_Counts = tuple[Pairs, InstanceCounts | None]  # of a scene; the second is that of t-AP


def changes(run: FinishedRun, methods: Sequence[str], protocols: Sequence[str], report: Report) -> list[Changes]:
    """The changes in the maps of each of ``methods`` under each of ``protocols`` of a run with intermediate maps.

    Raises ``ConfigError`` as ``over_time``, and for a scene that does not change.
    """
    methods, rules, jobs, encoder = over_time(run, methods, protocols)
    counts: dict[tuple[str, str], list[_Counts]] = {(method, one.name): [] for one in rules for method in methods}
    for job in jobs:
        scene = SceneData(job, report)
        if not isinstance(scene.dataset, HasChanges):
            raise ConfigError(f"{job.scene}: does not change; use scenes of homes-changing")
        change = scene.dataset.change(job.scene_name)
        for one in rules:
            known: dict[tuple[int, str], _Known] = {}  # methods differ by stride and corruption
            for part in (part for part in job.methods if part.name in methods):
                scene.report_activity(part, "finding what the frames show")
                fed = next((each for each in (part, *job.methods) if build_method(each).needs.frames), part)
                key = len(scene.frames(fed)), fed.corruption  # the oracle's, which uses none, are those of another
                if key not in known:
                    known[key] = places_of(change, scene.truth(one.ground_truth), one, scene.clean_frames(fed))
                counts[part.name, one.name].append(_count(known[key], part, one, scene.maps(fed), encoder))
    thresholds = {one.name: one.thresholds for one in rules}
    return [Changes(*names, _values(each, thresholds[names[1]])) for names, each in counts.items()]


def _values(counts: Sequence[_Counts], thresholds: Sequence[float]) -> dict[str, float | None]:
    values = metric.change_values([pairs for pairs, _ in counts])
    stages = [one for _, one in counts if one is not None]
    if len(stages) == len(counts):
        curve = combine(stages, thresholds)
        values |= {"t-AP": curve.ap, "t-AP50": curve.ap50}
    return {name: None if np.isnan(value) else value for name, value in values.items()}


def places_of(change: SceneChange, truth: GroundTruth, rules: ProtocolRules, frames: Iterable[Frame]) -> _Known:
    """The places of objects of the scored classes of ``rules``, and the points (N, 3); all others are background.

    Points of a left place within the cap of a surface that is there at the end, such as that on which the object stood,
    are left out: there a map rightly has points.
    """
    scored, was = [entry.id for entry in rules.scored], change.before
    left = np.flatnonzero(np.isin(was.instance, change.left) & np.isin(was.semantic, scored))
    left = left[np.isinf(nearest(truth.points, was.points[left], rules.transfer.cap_m or SEEN_M)[0])]
    points = np.concatenate([truth.points, was.points[left]])
    key = np.append(np.where(np.isin(truth.semantic, scored), 2 * truth.instance, -1), 2 * was.instance[left] + 1)
    kept = reduce_to_voxels(points, masks_of_partition(key, int(key.max()) + 1), SPACING_M)
    points, key = points[kept], key[kept].astype(np.int64)
    keys, place = np.unique(np.append(-1, key), return_inverse=True)
    ids, is_left, place = keys[1:] // 2, keys[1:] % 2 == 1, place[1:] - 1
    shown, empty = (np.full(len(points), NEVER) for _ in range(2))
    is_new = np.isin(ids, change.came) & ~is_left
    places = Places(ids, is_new, is_left, change.first_frame, place, shown, empty, [], MIN_POINTS)
    for n, frame in enumerate(frames, 1):
        places.frames.append(frame.index)
        there = np.flatnonzero((places.shown == NEVER) & np.append(places.is_present(frame.index), True)[place])
        places.shown[there[visible(points[there], frame)]] = n
        is_gone = np.append(is_left, False)[place] & (frame.index >= change.first_frame)
        gone = np.flatnonzero((places.empty == NEVER) & is_gone)
        places.empty[gone[depth_gap(points[gone], frame) > SEEN_M]] = n
    return places, points, _names(change, truth, rules, ids)


def _names(change: SceneChange, truth: GroundTruth, rules: ProtocolRules, ids: Int64Array) -> list[str]:
    """The class name of each of the objects ``ids``, empty if another object of the class is there before or after."""
    instance = np.concatenate([change.before.instance, truth.instance]).astype(np.int64)
    semantic = np.concatenate([change.before.semantic, truth.semantic])
    objects = np.unique(instance[instance > 0] << 32 | semantic[instance > 0])
    class_of = dict(zip((objects >> 32).tolist(), (objects & 0xFFFFFFFF).tolist(), strict=True))
    n_objects = Counter(class_of.values())
    name_of = {entry.id: rules.prompt_names.get(entry.name, entry.name) for entry in rules.scored}
    return [name_of[class_of[one]] if n_objects[class_of[one]] == 1 else "" for one in ids.tolist()]


def _answers(
    found: MapAt, prediction: Instances | Partition | None, known: _Known, is_asked: BoolArray, rules: ProtocolRules,
    encoder: Encoder,
) -> Int64Array:  # fmt: skip
    """Right answers of a map to "where is the NAME?", and questions (2,): about those of the places ``is_asked`` whose
    object has been seen and is the only one of its name. Without ``prediction``, the oracle's, which has the objects.
    """
    places, _, names = known
    asked = np.flatnonzero(is_asked & (places.after[0] <= found.n_updates) & (np.array(names) != ""))
    if prediction is None:
        first = np.array([np.flatnonzero(found.ids == places.object_ids[row])[0] for row in asked], np.int64)
    elif prediction.features is None:
        return np.zeros(2, np.int64)
    else:
        first = first_instances(rules, [names[row] for row in asked.tolist()], prediction, encoder)
    return metric.answers(found, asked, first)


def _count(
    known: _Known, part: Part, rules: ProtocolRules, files: Sequence[tuple[Path, int]], encoder: Encoder
) -> _Counts:
    """The counts of a method's maps in ``files``, each after so many updates; the oracle has what is there and seen.

    The last map before the change is asked where left objects were, the last after it where new ones are.
    """
    (places, points, _), is_oracle = known, isinstance(build_method(part), UsesGroundTruth)
    maps, last = list[MapAt](), dict[str, tuple[MapAt, Instances | Partition | None]]()
    for path, n_updates in files:
        prediction = None if is_oracle else read_prediction(path)
        if isinstance(prediction, DenseFeatures):
            raise ConfigError(f"{part.name}: its maps have no instances; choose others with --methods")
        if prediction is None:
            maps.append(places.perfect(n_updates))
        else:
            masks, scores = masks_and_scores(prediction)
            cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
            moved = transfer_masks(prediction.points, masks, points, cap_m, voxel_m)
            ids = prediction.ids if isinstance(prediction, Instances) and len(prediction.ids) else np.arange(len(masks))
            maps.append(places.map_at(n_updates, moved, np.asarray(ids, np.int64), scores))
        last["then" if maps[-1].frame < places.change else "now"] = maps[-1], prediction
    pairs, before = dict(metric.count_changes(places, maps)), metric.last_before_change(places, maps)
    for when, is_asked in (("then", places.is_left), ("now", places.is_new)):
        pairs[f"where {when}"] = np.zeros(2, np.int64)
        if when in last:
            pairs[f"where {when}"] = _answers(*last[when], known, is_asked, rules, encoder)
    if before is None or not getattr(build_method(part), "keeps_ids", False):
        return pairs, None
    return pairs, metric.count_stages(places, [before, maps[-1]], rules.thresholds)


def changes_table(found: Sequence[Changes]) -> Table:
    """A table of the values, in per cent, except times, which are in updates."""
    rows = [["method", "protocol", *COLUMNS, *WAITS]]
    for one in found:
        waits = [one.values[name] for name in WAITS]
        cells = [percent(one.values.get(name)) for name in COLUMNS]
        rows.append([one.method, one.protocol, *cells, *(NOT_MEASURED if n is None else f"{n:.1f}" for n in waits)])
    return text_table("changes", rows, heading="Changes", caption=", per cent; times in updates")
