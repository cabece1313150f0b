"""Identity over time in a finished run: whether the instances of successive maps keep their ids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.analysis.rescoring import device_of, jobs_of
from su3d_bench.core import registry
from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray
from su3d_bench.formats.tables.table import NOT_MEASURED, Table, percent, text_table
from su3d_bench.metrics.identity import LabelFlips, Step, TrackCounts, count_tracks, label_flips, step_of, track_values
from su3d_bench.metrics.matching.labelling import class_index_of_ids, classes_of_prediction
from su3d_bench.metrics.matching.transfer import transfer_masks
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.tracked_points import LabelledPoints, PointCounts, count_points, labelled_points, point_values
from su3d_bench.runs.executors import Report
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import Part, SceneJob
from su3d_bench.runs.scene import maps_over_time
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


def identities(run: FinishedRun, methods: Sequence[str], protocols: Sequence[str], report: Report) -> list[Identity]:
    """Identity of each of ``methods`` under each of ``protocols`` of a run with intermediate maps.

    Each map is compared with the ground truth that the frames until then have shown. Raises ``ConfigError`` for a run
    without intermediate maps or instance protocols.
    """
    rules = [run.rules(name) for name in protocols or run.protocols]
    rules = [one for one in rules if one.kind == "instance"]
    if not rules:
        raise ConfigError(f"{run.name}: identity needs an instance protocol, such as homes-instance")
    jobs = jobs_of(run)
    if not jobs or not jobs[0].config.anytime_text:
        raise ConfigError(f"{run.name}: has no intermediate maps; run with --anytime-every N or --anytime SHARE...")
    encoder = run.encoder(device_of(run))
    return [_identity(jobs, method, one, encoder, report) for method in methods or run.methods for one in rules]


def _identity(
    jobs: Sequence[SceneJob], method: str, rules: ProtocolRules, encoder: Encoder, report: Report
) -> Identity:
    parts = [next(part for part in job.methods if part.name == method) for job in jobs]
    if not getattr(registry.load("method", parts[0].target), "keeps_ids", False):
        return Identity(method, rules.name, None, 0, 0, "its ids do not persist")
    tracks, points, flips, n_maps = list[TrackCounts](), list[PointCounts](), list[LabelFlips](), 0
    is_thing = np.array([entry.name not in rules.stuff for entry in rules.classes])
    for job, part in zip(jobs, parts, strict=True):
        try:
            found = list(_steps(job, part, rules, encoder, report))
        except PredictionError as error:
            return Identity(method, rules.name, None, 0, 0, str(error))
        steps, labelled = [step for step, _ in found], [one for _, one in found]
        tracks.append(count_tracks(steps))
        flips.append(label_flips(steps))
        points.append(count_points(labelled, is_thing))
        n_maps += len(found)
    n_compared, n_flips = (sum(int(getattr(one, name).sum()) for one in flips) for name in ("is_compared", "is_flip"))
    values = track_values(TrackCounts.joined(tracks)) | point_values(PointCounts.joined(points))
    values[FLIPS] = n_flips / n_compared if n_compared else float("nan")
    return Identity(method, rules.name, values, len(jobs), n_maps)


def _steps(
    job: SceneJob, part: Part, rules: ProtocolRules, encoder: Encoder, report: Report
) -> Iterator[tuple[Step, LabelledPoints]]:
    """Each map of a scene as a step of instances and of labelled points, on the points seen until then."""
    maps, truth, first_shown = maps_over_time(job, part, rules.ground_truth, report)
    true_class = class_index_of_ids(rules, truth.semantic)
    instance = np.where(true_class >= 0, truth.instance, 0).astype(np.int64)
    for path, n_shown in maps:
        prediction = read_prediction(path)
        if not isinstance(prediction, Instances) or len(prediction.ids) != len(prediction.scores):
            raise PredictionError("its maps have no ids")
        is_seen: BoolArray = first_shown < n_shown
        cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
        masks = transfer_masks(prediction.points, prediction, truth.points, cap_m, voxel_m)
        classes = classes_of_prediction(rules, prediction, encoder, np.bincount(
            true_class[true_class >= 0], minlength=len(rules.classes)) > 0)  # fmt: skip
        whole = labelled_points(true_class, instance, masks, classes, prediction.ids, prediction.scores)
        shown = LabelledPoints(*(values[is_seen] for values in vars(whole).values()))
        yield step_of(instance, masks, prediction.ids, is_seen), shown


def identity_table(found: Sequence[Identity]) -> Table:
    """A table of all values, in per cent."""
    rows = [["method", "protocol", "maps", *COLUMNS, FLIPS]]
    for one in found:
        values = one.values or {}
        cells = [percent(values[name]) if name in values else NOT_MEASURED for name in (*COLUMNS, FLIPS)]
        rows.append([one.method, one.protocol, str(one.n_maps), *cells])
    notes = dict.fromkeys(f"; {one.method}: not measured: {one.reason}" for one in found if one.reason)
    return text_table("identity", rows, heading="Identity over time", caption=f", per cent{''.join(notes)}")
