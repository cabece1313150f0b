"""Error attribution: what each kind of error and each stage of the pipeline costs a run.

A run's maps are matched to the ground truth again, with the evaluators of its protocols; counts that differ from those
stored in the run are an error. ``report instances`` and the galleries of a page use the same iteration,
``matched_instances`` or ``Explained.matched``. The kinds of errors are defined in ``metrics.attribution``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis.sides import Side, check_comparable
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, counted, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.evaluation.scoring import with_confidences_of_files
from su3d_bench.evaluation.text_ground_truth import GroundTruthFiles
from su3d_bench.evaluation.texts import GivenTextEncoder, read_text_features
from su3d_bench.metrics.attribution.arrays import EXPLAINED, CorrectedScene, EvaluatedScene, SingleError
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of, plain_json
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.job import with_visible_truth
from su3d_bench.runs.verify import read_checked
from su3d_bench.store.predictions import read_prediction

TruthOf = Callable[[str], GroundTruth]  # ground-truth variant -> ground truth
JobCounts = Mapping[str, CorrectedScene]  # protocol -> counts of one scene and method


@dataclass(frozen=True)
class Matched:
    """One scene, method and protocol: what was scored, and how the protocol's evaluator matched it."""

    explained: Explained
    scene: str
    rules: ProtocolRules
    truth: GroundTruth
    prediction: Prediction
    evaluated: EvaluatedScene


def matched_instances(
    run: FinishedRun, methods: Sequence[Explained], scenes: Sequence[str]
) -> Iterator[tuple[str, Iterator[Matched]]]:
    """For each scene, the matched predictions of ``methods`` of ``run`` under each protocol that scored it."""
    encoder = cache(run.encoder)
    for scene in scenes:
        truth_of = cache(partial(truth_of_scene, run, scene))
        yield scene, (one for method in methods for one in method.matched(scene, truth_of, encoder))


def explained_of(run: FinishedRun, method: str, wanted: Sequence[str] = ()) -> Explained:
    """The protocols for attributing errors of ``method``: those ``wanted``, by default all that support it."""
    names, remarks = _protocols_of(run, wanted)
    return Explained(run, method, tuple(names), tuple(remarks))


@dataclass(frozen=True)
class Explained:
    """A method of a run, with its errors attributed under ``protocols``."""

    run: FinishedRun
    method: str
    protocols: tuple[str, ...]
    remarks: tuple[str, ...]

    @cached_property
    def _scores(self) -> Mapping[str, Mapping[str, SceneScore]]:
        return self.run.scores(self.method)

    @cached_property
    def _inputs(self) -> Inputs:
        return Inputs(self.run, self.method)

    def rules(self, protocol: str) -> ProtocolRules:
        """The rules of a protocol as applied to this method."""
        return self._inputs.rules(self.run.rules(protocol))

    def matched(self, scene: str, truth_of: TruthOf, encoder: Callable[[], Encoder]) -> Iterator[Matched]:
        """``scene`` as matched by the evaluators of the protocols that scored it."""
        for name in self.scored_under(scene):
            rules = self.rules(name)
            truth, prediction = self._inputs.of_scene(scene, rules, truth_of)
            if (reason := kind_incompatibility(rules, prediction)) is not None:
                raise PredictionError(f"{scene}: {reason}")
            look = EXPLAINED[rules.kind][1]
            evaluated = look(rules, truth, prediction, self._inputs.encoder(rules, prediction, encoder))
            yield Matched(self, scene, rules, truth, prediction, evaluated)

    def corrected(self, scene: str, evaluated: Mapping[str, EvaluatedScene]) -> JobCounts:
        """The counts of ``scene``, checked against those of the run, and the counts with its errors corrected."""
        corrected = {name: one.corrected() for name, one in evaluated.items()}
        for name, counts in corrected.items():
            self.check_same_counts(name, scene, counts.as_is)
        return corrected

    def errors(self, scene: str, protocol: str, evaluated: EvaluatedScene, n: int) -> tuple[int, Sequence[SingleError]]:
        """The number of errors in ``scene`` under ``protocol``, and the ``most`` errors that cost the run most."""
        scores = self._scores[protocol]
        others = [score.counts for name, score in scores.items() if name != scene]
        return evaluated.errors(self.rules(protocol), scores[scene].counts, others, n)

    def instance_ids(self, scene: str) -> Sequence[int]:
        """The ids of the method's instances; empty if they are numbered by position."""
        if self.run.data.truth_files is not None:
            return ()
        return getattr(self._inputs.of_map(scene), "ids", np.zeros(0, np.int64)).tolist()

    def check_same_counts(self, protocol: str, scene: str, formed: Counts) -> None:
        """Raise a ``PredictionError`` if the recomputed counts differ from those stored in the run."""
        stored = self._scores[protocol][scene].counts
        if type(stored) is type(formed) and all(
            np.array_equal(getattr(stored, each.name), getattr(formed, each.name)) for each in fields(formed)
        ):
            return
        raise PredictionError(
            f"{printable(scene, 100)}: {protocol}: the run's stored counts differ from those recomputed from its "
            "prediction; score it again"
        )

    def scored_under(self, scene: str) -> list[str]:
        """The protocols that scored ``scene``."""
        return [name for name in self.protocols if scene in self._scores[name]]


def _protocols_of(run: FinishedRun, wanted: Sequence[str]) -> tuple[list[str], list[str]]:
    """The protocols that support attribution, and remarks on the others; an unsupported ``wanted`` one is an error."""
    for name in wanted:
        run.check_protocol(name)
    chosen, remarks = [], []
    for name in wanted or run.protocols:
        rules = run.rules(name)
        if rules.kind in EXPLAINED:
            chosen.append(name)
        elif wanted:
            raise ConfigError(f"protocol '{name}' is of kind '{rules.kind}'; only instance and semantic are supported")
        else:
            remarks.append(f"{name} is of kind {rules.kind}, which has no error attribution")
    if not chosen:
        raise ConfigError(f"{run.name}: has no scores under a protocol of kind instance or semantic")
    return chosen, remarks


def method_of(run: FinishedRun, method: str | None) -> str:
    """``method``, or the only one of the run; ``ConfigError`` if it must be named or has no scores."""
    if method is None and len(run.methods) > 1:
        raise ConfigError(f"{run.name}: has several methods ({', '.join(run.methods)}); choose one with --method")
    chosen = method or run.methods[0]
    run.check_method(chosen)
    return chosen


def truth_of_scene(run: FinishedRun, scene: str, variant: str) -> GroundTruth:
    """The ground truth in the data of ``run``, which must be unchanged since the run."""
    truth: GroundTruth = run.dataset(scene).ground_truth(scene.partition("/")[2], variant)
    return truth


class Inputs:
    """Ground truth, maps and encoder of a method of a run, also for predictions made elsewhere."""

    def __init__(self, run: FinishedRun, method: str) -> None:
        self._run, self._method = run, method
        self._files = GroundTruthFiles(run)
        self.of_map = lru_cache(maxsize=1)(self._read_map)

    def rules(self, rules: ProtocolRules) -> ProtocolRules:
        """``rules`` as applied here: prediction files may supply confidences where a rule uses 1."""
        elsewhere = self._run.external.get(self._method)
        takes_files = elsewhere is not None and elsewhere.confidences == "file"
        return with_confidences_of_files(rules) if takes_files else rules

    def of_scene(self, scene: str, rules: ProtocolRules, truth_of: TruthOf) -> tuple[GroundTruth, Prediction]:
        if self._run.data.truth_files is not None:
            truth = self._files.truth(scene, rules)
            return truth, self._files.prediction(scene, self._method, rules, len(truth.points))
        truth = truth_of(rules.ground_truth)
        prediction = self.of_map(scene)
        if (part := self._run.truth_part(self._method)) is None:
            return truth, prediction
        first: str = self._run.dataset(scene).variants[0]
        return truth, with_visible_truth(part, rules, truth, prediction, lambda: truth_of(first).labels)

    def _read_map(self, scene: str) -> Prediction:
        return read_prediction(self._run.folder.job(scene, self._method).prediction)

    def encoder(self, rules: ProtocolRules, prediction: Prediction, own: Callable[[], Encoder]) -> Encoder | None:
        """The encoder that named the instances; None if they have labels."""
        if getattr(prediction, "labels", None) is not None:
            return None
        elsewhere = self._run.external.get(self._method)
        if elsewhere is None or elsewhere.texts is None:
            return own()
        path, digest = elsewhere.texts
        given = read_text_features(Path(path))
        assert given is not None
        texts = GivenTextEncoder(given, rules)
        if texts.digest != digest:
            raise DataError(f"{printable(path, 200)}: is not the text features file used to score {self._run.name}")
        return texts


SCHEMA = 1
Values = Mapping[str, float]


@dataclass(frozen=True)
class Cause:
    """``n`` errors of one kind (masks and instances, or points) and the gain in each metric when they are corrected."""

    n: int
    gains: Values


@dataclass(frozen=True)
class ProtocolAttribution:
    """Attribution under one protocol: ``values + sum of gains + overlap + rest = 1`` for each metric.

    ``rest`` is 1 minus the value with everything corrected, ``overlap`` what that gains beyond the sum of the gains.
    ``stages`` are values with one stage of the pipeline replaced by ground truth. ``n_scored`` is the number of points
    if points are counted.
    """

    protocol: str
    version: int
    kind: str
    scenes: tuple[str, ...]
    values: Values
    causes: Mapping[str, Cause]
    overlap: Values
    rest: Values
    stages: Mapping[str, Values]
    n_scored: int | None


@dataclass(frozen=True)
class RunAttribution:
    run: str
    method: str
    remarks: tuple[str, ...]
    protocols: tuple[ProtocolAttribution, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON values: fractions in full precision, null if undefined."""
        return {"schema": SCHEMA, **plain_json(asdict(self))}


def attribute(
    path: Path,
    *,
    method: str | None = None,
    protocols: Sequence[str] = (),
    oracle: Path | None = None,
) -> RunAttribution:
    """Error attribution of the run at ``path``, under each protocol of kind ``instance`` or ``semantic``.

    ``oracle``: a run of the same method on the same scenes with the profile ``oracle``, for the 2D mask stage.
    """
    run = read_checked(path)
    explained = explained_of(run, method_of(run, method), protocols)
    other = None
    if oracle is not None:
        other = Side(read_checked(oracle), explained.method)
        if other.run.record.profile != "oracle":
            raise ConfigError(
                f"{other.run.name}: has the profile '{printable(str(other.run.record.profile), 60)}'; --oracle takes a "
                "run made with --profile oracle"
            )
        other.run.check_method(other.method)
    walk = matched_instances(run, [explained], run.scenes)
    corrected = {
        scene: explained.corrected(scene, {one.rules.name: one.evaluated for one in found}) for scene, found in walk
    }
    return attribution_of(explained, corrected, other)


def attribution_of(
    explained: Explained, corrected: Mapping[str, JobCounts], other: Side | None = None
) -> RunAttribution:
    """The cost of the errors of all scenes; ``other`` is the side with ground-truth 2D masks."""
    side = Side(explained.run, explained.method)
    formed = []
    for name in explained.protocols:
        rules, of_scenes = explained.rules(name), {scene: one[name] for scene, one in corrected.items() if name in one}
        if of_scenes:
            formed.append(_form(rules, of_scenes, _oracle_values(rules, side, other, list(of_scenes))))
    if not formed:
        raise ConfigError(f"{side.name}: no scene is scored under {', '.join(explained.protocols)}")
    remarks = (*explained.remarks, *run_remarks(explained.run))
    return RunAttribution(explained.run.name, explained.method, remarks, tuple(formed))


def _oracle_values(rules: ProtocolRules, side: Side, other: Side | None, scenes: Sequence[str]) -> Values | None:
    """The metrics of the run with ground-truth 2D masks over the same scenes."""
    if other is None:
        return None
    if rules.name not in other.run.protocols:
        raise ConfigError(f"{other.run.name}: was not scored under {rules.name}; score it again with --protocols")
    scores = other.run.scores(other.method)[rules.name]
    missing = [scene for scene in scenes if scene not in scores]
    if missing:
        raise ConfigError(f"{other.name}: lacks {printable(missing[0], 100)}; the run must have the same scenes")
    check_comparable(side, other, rules.name, scenes)
    return _values(rules, [scores[scene].counts for scene in scenes])


def _form(
    rules: ProtocolRules, of_scenes: Mapping[str, CorrectedScene], with_true_masks: Values | None
) -> ProtocolAttribution:
    """The cost of the errors of the scenes under one protocol."""
    every = list(of_scenes.values())
    values, corrected = _values(rules, [one.as_is for one in every]), _values(rules, [one.all for one in every])
    causes = {}
    for kind in EXPLAINED[rules.kind][0]:
        after = _values(rules, [one.alone[kind] for one in every])
        n = sum(one.n.get(kind, 0) for one in every)
        causes[kind] = Cause(n, {name: after[name] - values[name] for name in values})
    labelled = [one.with_true_labels for one in every if one.with_true_labels is not None]
    stages = {} if len(labelled) < len(every) else {"labels": _values(rules, labelled)}
    if with_true_masks is not None:
        stages["2D masks"] = dict(with_true_masks)
    total = {name: sum(cause.gains[name] for cause in causes.values()) for name in values}
    n_scored = [one.n_scored for one in every if one.n_scored is not None]
    return ProtocolAttribution(
        protocol=rules.name,
        version=rules.version,
        kind=rules.kind,
        scenes=tuple(of_scenes),
        values=values,
        causes=causes,
        overlap={name: corrected[name] - values[name] - total[name] for name in values},
        rest={name: 1.0 - corrected[name] for name in values},
        stages=stages,
        n_scored=sum(n_scored) if n_scored else None,
    )


def _values(rules: ProtocolRules, counts: Sequence[Counts]) -> dict[str, float]:
    """The headline metrics of the scenes, as the protocol reports them."""
    reported = metric_of(rules).reported(counts)
    return {name: reported[name] for name in rules.headline}


def run_remarks(run: FinishedRun) -> list[str]:
    """Caveats to report with a run's numbers."""
    lines = run.elsewhere_lines()
    if run.record.is_partial:
        lines.append(f"PARTIAL: only the first {counted(run.limit, 'frame')} of each scene")
    if run.is_incomplete:
        lines.append("INCOMPLETE: scenes that failed are not in these numbers")
    return lines
