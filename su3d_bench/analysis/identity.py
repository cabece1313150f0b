"""Identity over time in a finished run: whether the instances of successive maps keep their ids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.analysis.rescoring import device_of, jobs_of
from su3d_bench.core import registry
from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray
from su3d_bench.formats.tables.table import NOT_MEASURED, Table, percent, text_table
from su3d_bench.human_eval.sources import chosen_of
from su3d_bench.metrics.identity import LabelFlips, Step, TrackCounts, count_tracks, label_flips, step_of, track_values
from su3d_bench.metrics.matching.labelling import class_index_of_ids, classes_of_prediction
from su3d_bench.metrics.matching.transfer import transfer_masks
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.tracked_points import LabelledPoints, PointCounts, count_points, labelled_points, point_values
from su3d_bench.runs.executors import Report
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import Part, SceneJob, build_method
from su3d_bench.runs.scene_data import SceneData
from su3d_bench.store.predictions import read_prediction

COLUMNS = ("HOTA", "DetA", "AssA", "LocA", "OWTA", "OWTA by object", "IDF1", "STQ", "AQ", "AQ by time", "SQ")
FLIPS = "changed ids"


@dataclass(frozen=True)
class Identity:
    """The values over all scenes of a method under an instance protocol's matching, as fractions; None with a
    ``reason`` if they cannot be measured. ``n_maps``: maps of all scenes."""

    method: str
    protocol: str
    values: Mapping[str, float] | None
    n_scenes: int
    n_maps: int
    reason: str = ""


@dataclass(frozen=True)
class _SceneCounts:
    """The counts of one scene under a method and a protocol."""

    tracks: TrackCounts
    points: PointCounts
    flips: LabelFlips
    n_maps: int


def identities(run: FinishedRun, methods: Sequence[str], protocols: Sequence[str], report: Report) -> list[Identity]:
    """Identity of each of ``methods`` under each of ``protocols`` of a run with intermediate maps.

    Each map is compared with the ground truth that the frames until then have shown. Raises as ``over_time``.
    """
    methods, rules, jobs, encoder = over_time(run, methods, protocols)
    reasons = {part.name: reason for part in jobs[0].methods if (reason := _reason_against(part))}
    counts: dict[tuple[str, str], list[_SceneCounts]] = {(method, one.name): [] for method in methods for one in rules}
    for job in jobs:
        scene = SceneData(job, report)
        for part in job.methods:
            for one in rules if part.name in methods else ():
                if part.name in reasons:
                    continue
                try:
                    counts[part.name, one.name].append(_counts(scene, part, one, encoder))
                except PredictionError as error:
                    reasons[part.name] = str(error)
    return [
        Identity(method, protocol, None, 0, 0, reasons[method]) if method in reasons else _joined(method, protocol, own)
        for (method, protocol), own in counts.items()
    ]


def over_time(
    run: FinishedRun, methods: Sequence[str], protocols: Sequence[str]
) -> tuple[Sequence[str], list[ProtocolRules], Sequence[SceneJob], Encoder]:
    """The chosen methods and instance protocols of a run with intermediate maps, its jobs and its encoder.

    Raises ``ConfigError`` for an unknown name, and for a run without intermediate maps or instance protocols.
    """
    methods = chosen_of(run, "method", methods, run.methods)
    rules = [run.rules(name) for name in chosen_of(run, "protocol", protocols, tuple(run.protocols))]
    rules = [one for one in rules if one.kind == "instance"]
    if not rules:
        raise ConfigError(f"{run.name}: has no instance protocol; run it with --extend --protocols homes-instance")
    jobs = jobs_of(run)
    if not jobs or not jobs[0].config.anytime_text:
        raise ConfigError(f"{run.name}: has no intermediate maps; run with --anytime-every N or --anytime SHARE...")
    return methods, rules, jobs, run.encoder(device_of(run))


def _reason_against(part: Part) -> str | None:
    """Why the identity of a method's instances cannot be measured; None if it can."""
    if not getattr(registry.load("method", part.target), "keeps_ids", False):
        return "its ids do not persist"
    return None if build_method(part).needs.frames else "it uses no frames, so its map does not change"


def _joined(method: str, protocol: str, counts: Sequence[_SceneCounts]) -> Identity:
    tracks, points = (
        TrackCounts.joined([each.tracks for each in counts]),
        PointCounts.joined([each.points for each in counts]),
    )
    n_compared, n_flips = (
        sum(int(getattr(each.flips, name).sum()) for each in counts) for name in ("is_compared", "is_flip")
    )
    values = track_values(tracks) | point_values(points)
    values[FLIPS] = n_flips / n_compared if n_compared else float("nan")
    return Identity(method, protocol, values, len(counts), sum(each.n_maps for each in counts))


def _counts(scene: SceneData, part: Part, rules: ProtocolRules, encoder: Encoder) -> _SceneCounts:
    """The maps of a scene over time, as steps of instances and of labelled points, on the points seen until then."""
    maps, truth, first_shown = scene.maps_over_time(part, rules.ground_truth)
    true_class = class_index_of_ids(rules, truth.semantic)
    instance = np.where(true_class >= 0, truth.instance, 0).astype(np.int64)
    is_present = np.bincount(true_class[true_class >= 0], minlength=len(rules.classes)) > 0
    cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    steps, labelled = list[Step](), list[LabelledPoints]()
    for path, n_shown in maps:
        prediction = read_prediction(path)
        if not isinstance(prediction, Instances) or len(prediction.ids) != len(prediction.scores):
            raise PredictionError("its maps have no ids")
        is_seen: BoolArray = first_shown < n_shown
        masks = transfer_masks(prediction.points, prediction, truth.points, cap_m, voxel_m)
        classes = classes_of_prediction(rules, prediction, encoder, is_present)
        whole = labelled_points(true_class, instance, masks, classes, prediction.ids, prediction.scores)
        labelled.append(LabelledPoints(*(values[is_seen] for values in vars(whole).values())))
        steps.append(step_of(instance, masks, prediction.ids, is_seen))
    is_thing = np.array([entry.name not in rules.stuff for entry in rules.classes])
    return _SceneCounts(count_tracks(steps), count_points(labelled, is_thing), label_flips(steps), len(maps))


def identity_table(found: Sequence[Identity]) -> Table:
    """A table of all values, in per cent."""
    rows = [["method", "protocol", "maps", *COLUMNS, FLIPS]]
    for one in found:
        values = one.values or {}
        cells = [percent(values[name]) if name in values else NOT_MEASURED for name in (*COLUMNS, FLIPS)]
        rows.append([one.method, one.protocol, str(one.n_maps), *cells])
    notes = dict.fromkeys(f"; {one.method}: not measured: {one.reason}" for one in found if one.reason)
    return text_table("identity", rows, heading="Identity over time", caption=f", per cent{''.join(notes)}")
