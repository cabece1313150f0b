"""Why a run's numbers are not perfect: what each kind of error costs, and what each stage of the pipeline does.

Predictions are taken from the run folder and scored again; counts that differ from those of the run are refused. What
the kinds of errors are is said in ``metrics.attribution`` and ``metrics.attribution_semantic``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis.inputs import Inputs, TruthOf, method_of, truth_of_scene
from su3d_bench.analysis.sides import Side, refuse_unlike
from su3d_bench.core.errors import ConfigError, PredictionError, counted, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.attribution.arrays import EXPLAINED, LookedAt, MendedScene
from su3d_bench.metrics.attribution.singles import SingleError
from su3d_bench.metrics.fitness import why_not_scorable
from su3d_bench.metrics.metric import Counts, SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of, plain_json
from su3d_bench.runs.finished import FinishedRun, read_run

SCHEMA = 1
Values = Mapping[str, float]
MendedJob = Mapping[str, MendedScene]  # of a scene under a method, by protocol


@dataclass(frozen=True)
class Cause:
    """``n`` errors of one kind (masks and instances, or points) and the gain in each metric when they are mended."""

    n: int
    gains: Values


@dataclass(frozen=True)
class ProtocolAttribution:
    """Of one protocol: ``values + sum of gains + overlap + rest = 1`` for each metric.

    ``rest`` is 1 less the value with everything mended, ``overlap`` what that gives beyond the sum of the gains.
    ``stages`` are values with one stage of the pipeline replaced by the truth. ``n_scored`` points where points are
    counted.
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
        """Plain values, fractions in full precision, null where undefined."""
        return {"schema": SCHEMA, **plain_json(asdict(self))}


def attribute(
    path: Path,
    *,
    method: str | None = None,
    protocols: Sequence[str] = (),
    oracle: Path | None = None,
) -> RunAttribution:
    """Where the run at ``path`` loses its points, under each protocol of kind ``instance`` or ``semantic``.

    ``oracle``: a run of the same method on the same scenes with the profile ``oracle``, for the stage of the 2D masks.
    """
    run = read_run(path)
    explained = explained_of(run, method_of(run, method), protocols)
    other = None if oracle is None else Side(_oracle_run(oracle), explained.method)
    if other is not None:
        other.run.check_method(other.method)
    encoder = cache(run.encoder)
    mended = {}
    for scene in run.scenes:
        truth_of = cache(partial(truth_of_scene, run, scene))
        mended[scene] = explained.mend(scene, truth_of, encoder)
    return explained.form(mended, other)


def explained_of(run: FinishedRun, method: str, wanted: Sequence[str] = ()) -> Explained:
    """The protocols under which the errors of ``method`` are explained: those ``wanted``, else all that can be."""
    names, remarks = _protocols_of(run, wanted)
    return Explained(run, method, tuple(names), tuple(remarks))


@dataclass(frozen=True)
class Explained:
    """A method of a run, whose errors are explained under ``protocols``."""

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

    def _rules(self, protocol: str) -> ProtocolRules:
        return self._inputs.rules(self.run.rules(protocol))

    def mend(self, scene: str, truth_of: TruthOf, encoder: Callable[[], Encoder]) -> MendedJob:
        """The counts of ``scene`` as they are and with its errors mended, by protocol; of those that scored it."""
        return self.mended(scene, self.look_at(scene, truth_of, encoder))

    def look_at(self, scene: str, truth_of: TruthOf, encoder: Callable[[], Encoder]) -> Mapping[str, LookedAt]:
        """``scene`` as the evaluators of the protocols that scored it see it."""
        looked_at: dict[str, LookedAt] = {}
        for name in self.scored_under(scene):
            rules, truth, prediction, naming = self.scored(name, scene, truth_of, encoder)
            looked_at[name] = EXPLAINED[rules.kind][1](rules, truth, prediction, naming)
        return looked_at

    def mended(self, scene: str, looked_at: Mapping[str, LookedAt]) -> MendedJob:
        """The counts of ``scene``, which must be those of the run, and those with its errors mended."""
        mended = {name: one.mended() for name, one in looked_at.items()}
        for name, counts in mended.items():
            self.refuse_other_counts(name, scene, counts.as_is)
        return mended

    def errors(self, scene: str, protocol: str, looked_at: LookedAt, most: int) -> tuple[int, Sequence[SingleError]]:
        """How many errors ``scene`` has under ``protocol``, and the ``most`` that cost the run most."""
        scores = self._scores[protocol]
        others = [score.counts for name, score in scores.items() if name != scene]
        return looked_at.errors(self._rules(protocol), scores[scene].counts, others, most)

    def instance_ids(self, scene: str) -> Sequence[int]:
        """How the method numbers its instances; nothing where their places are their numbers."""
        if self.run.data.truth_files is not None:
            return ()
        return getattr(self._inputs.of_map(scene), "ids", np.zeros(0, np.int64)).tolist()

    def headline(self, protocol: str) -> tuple[str, ...]:
        """The metrics in which errors under ``protocol`` are told."""
        return tuple(self._rules(protocol).headline)

    def refuse_other_counts(self, protocol: str, scene: str, formed: Counts) -> None:
        """A ``PredictionError`` where what is explained is not what the run's own number is of."""
        stored = self._scores[protocol][scene].counts
        if type(stored) is type(formed) and all(
            np.array_equal(getattr(stored, each.name), getattr(formed, each.name)) for each in fields(formed)
        ):
            return
        raise PredictionError(
            f"{printable(scene, 100)}: {protocol}: the counts of the run are not those that its prediction gives here; "
            "score it again"
        )

    def scored_under(self, scene: str) -> list[str]:
        """The protocols that scored ``scene``."""
        return [name for name in self.protocols if scene in self._scores[name]]

    def scored(
        self, protocol: str, scene: str, truth_of: TruthOf, encoder: Callable[[], Encoder]
    ) -> tuple[ProtocolRules, GroundTruth, Prediction, Encoder | None]:
        """What a scene was scored from under a protocol: the rules, the truth, the map and what named its instances."""
        rules = self._rules(protocol)
        truth, prediction = self._inputs.of_scene(scene, rules, truth_of)
        if (reason := why_not_scorable(rules, prediction)) is not None:
            raise PredictionError(f"{scene}: {reason}")
        return rules, truth, prediction, self._inputs.encoder(rules, prediction, encoder)

    def form(self, mended: Mapping[str, MendedJob], other: Side | None = None) -> RunAttribution:
        """What the errors of all scenes cost; ``other`` is the side with perfect 2D masks."""
        side = Side(self.run, self.method)
        gathered = {name: _Gathered(self._rules(name)) for name in self.protocols}
        for scene, of_scene in mended.items():
            for name, counts in of_scene.items():
                gathered[name].add(scene, counts)
        explained = [counted for counted in gathered.values() if counted.scenes]
        formed = tuple(
            counted.form(_oracle_values(counted.rules, side, other, counted.scenes)) for counted in explained
        )
        if not formed:
            raise ConfigError(f"{side.name}: no scene is scored under {', '.join(self.protocols)}; nothing to explain")
        return RunAttribution(self.run.name, self.method, (*self.remarks, *_remarks(self.run)), formed)


def _protocols_of(run: FinishedRun, wanted: Sequence[str]) -> tuple[list[str], list[str]]:
    """The protocols that can be explained, and remarks on the others; one that is named and cannot is an error."""
    for name in wanted:
        run.check_protocol(name)
    chosen, remarks = [], []
    for name in wanted or run.protocols:
        rules = run.rules(name)
        if rules.kind in EXPLAINED:
            chosen.append(name)
        elif wanted:
            raise ConfigError(f"protocol '{name}' is of kind '{rules.kind}'; only instance and semantic are explained")
        else:
            remarks.append(f"{name} is of kind {rules.kind}, which is not explained")
    if not chosen:
        raise ConfigError(f"{run.name}: was scored under no protocol of kind instance or semantic; nothing to explain")
    return chosen, remarks


def _oracle_run(path: Path) -> FinishedRun:
    run = read_run(path)
    if run.record.profile != "oracle":
        raise ConfigError(
            f"{run.name}: has the profile '{printable(str(run.record.profile), 60)}'; --oracle takes a run made with "
            "--profile oracle"
        )
    return run


def _oracle_values(rules: ProtocolRules, side: Side, other: Side | None, scenes: Sequence[str]) -> Values | None:
    """The metrics of the run with perfect 2D masks over the same scenes."""
    if other is None:
        return None
    if rules.name not in other.run.protocols:
        raise ConfigError(f"{other.run.name}: was not scored under {rules.name}; score it again with --protocols")
    scores = other.run.scores(other.method)[rules.name]
    missing = [scene for scene in scenes if scene not in scores]
    if missing:
        raise ConfigError(f"{other.name}: lacks {printable(missing[0], 100)}; the run must have the same scenes")
    refuse_unlike(side, other, rules.name, scenes)
    return _values(rules, [scores[scene].counts for scene in scenes])


@dataclass
class _Gathered:
    """The counts of scene after scene under one protocol: as they are, mended, with the truth's labels."""

    rules: ProtocolRules
    scenes: list[str] = field(default_factory=list)
    as_is: list[Counts] = field(default_factory=list)
    all: list[Counts] = field(default_factory=list)
    alone: dict[str, list[Counts]] = field(default_factory=dict)
    labelled: list[Counts | None] = field(default_factory=list)
    n: Counter[str] = field(default_factory=Counter)
    n_scored: int | None = None

    def add(self, scene: str, mended: MendedScene) -> None:
        if mended.n_scored is not None:
            self.n_scored = (self.n_scored or 0) + mended.n_scored
        self.scenes.append(scene)
        self.as_is.append(mended.as_is)
        self.all.append(mended.all)
        self.labelled.append(mended.with_true_labels)
        self.n.update(mended.n)
        for kind, counts in mended.alone.items():
            self.alone.setdefault(kind, []).append(counts)

    def form(self, with_true_masks: Values | None) -> ProtocolAttribution:
        values, mended = _values(self.rules, self.as_is), _values(self.rules, self.all)
        causes = {}
        for kind in EXPLAINED[self.rules.kind][0]:
            after = _values(self.rules, self.alone[kind])
            causes[kind] = Cause(self.n[kind], {name: after[name] - values[name] for name in values})
        labelled = [counts for counts in self.labelled if counts is not None]
        stages = {} if len(labelled) < len(self.labelled) else {"labels": _values(self.rules, labelled)}
        if with_true_masks is not None:
            stages["2D masks"] = dict(with_true_masks)
        total = {name: sum(cause.gains[name] for cause in causes.values()) for name in values}
        return ProtocolAttribution(
            protocol=self.rules.name,
            version=self.rules.version,
            kind=self.rules.kind,
            scenes=tuple(self.scenes),
            values=values,
            causes=causes,
            overlap={name: mended[name] - values[name] - total[name] for name in values},
            rest={name: 1.0 - mended[name] for name in values},
            stages=stages,
            n_scored=self.n_scored,
        )


def _values(rules: ProtocolRules, counts: Sequence[Counts]) -> dict[str, float]:
    """The headline metrics of the scenes, as the protocol reports them."""
    reported = metric_of(rules).reported(counts)
    return {name: reported[name] for name in rules.headline}


def _remarks(run: FinishedRun) -> list[str]:
    lines = run.elsewhere_lines()
    if run.record.is_partial:
        lines.append(f"PARTIAL: only the first {counted(run.limit, 'frame')} of each scene")
    if run.is_incomplete:
        lines.append("INCOMPLETE: scenes that failed are not in these numbers")
    return lines
