"""Why a run's numbers are not perfect: what each kind of error costs, and what each stage of the pipeline does.

Predictions are taken from the run folder and scored again; counts that differ from those of the run are refused. What
the kinds of errors are is said in ``metrics.attribution`` and ``metrics.attribution_semantic``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from su3d_bench.analysis.matched import Explained, MendedJob, explained_of, matched_instances, method_of
from su3d_bench.analysis.sides import Side, refuse_unlike
from su3d_bench.core.errors import ConfigError, counted, printable
from su3d_bench.metrics.attribution.arrays import EXPLAINED, MendedScene
from su3d_bench.metrics.metric import Counts
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of, plain_json
from su3d_bench.runs.finished import FinishedRun, read_run

SCHEMA = 1
Values = Mapping[str, float]


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
    walk = matched_instances(run, [explained], run.scenes)
    mended = {scene: explained.mended(scene, {one.rules.name: one.looked_at for one in found}) for scene, found in walk}
    return attribution_of(explained, mended, other)


def attribution_of(explained: Explained, mended: Mapping[str, MendedJob], other: Side | None = None) -> RunAttribution:
    """What the errors of all scenes cost; ``other`` is the side with perfect 2D masks."""
    side = Side(explained.run, explained.method)
    gathered = {name: _Gathered(explained.rules(name)) for name in explained.protocols}
    for scene, of_scene in mended.items():
        for name, counts in of_scene.items():
            gathered[name].add(scene, counts)
    scored = [counted for counted in gathered.values() if counted.scenes]
    formed = tuple(counted.form(_oracle_values(counted.rules, side, other, counted.scenes)) for counted in scored)
    if not formed:
        raise ConfigError(f"{side.name}: no scene is scored under {', '.join(explained.protocols)}; nothing to explain")
    remarks = (*explained.remarks, *run_remarks(explained.run))
    return RunAttribution(explained.run.name, explained.method, remarks, formed)


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


def run_remarks(run: FinishedRun) -> list[str]:
    """What must be known of a run beside its numbers."""
    lines = run.elsewhere_lines()
    if run.record.is_partial:
        lines.append(f"PARTIAL: only the first {counted(run.limit, 'frame')} of each scene")
    if run.is_incomplete:
        lines.append("INCOMPLETE: scenes that failed are not in these numbers")
    return lines
