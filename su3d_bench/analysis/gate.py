"""The gate for CI: a run against a reference that earlier runs of the same request taught.

A reference holds every number with the tolerance that the spread of the taught runs gives: none where they agree to
the last bit. What moves a number without being one (protocol, data, weights, settings) must not change at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.core.config import MOVES_NO_NUMBER
from su3d_bench.core.errors import ConfigError, StoreError, printable
from su3d_bench.metrics.costs import MAP, WARM_UP, pooled
from su3d_bench.reports.gate import Finding, Verdict
from su3d_bench.runs.finished import FinishedRun, read_update_times
from su3d_bench.store.atomic import read_json
from su3d_bench.store.records import NumbersRecord, ResultRecord

SPREADS = 2.0  # a value may leave the taught ones by this many times their range: 2 of 50 unchanged repeats would at 1
ACROSS_MACHINES = 0.02  # 2 points: what ONNX Runtime's and BLAS's kernels of other processors may move a headline value
# Where the calibrating work itself takes so many times the reference's on the same kind of processor, others used it.
BUSY = 1.5
COST_LIMIT = 1.3  # an update may cost so many times the reference's; `python benchmarks gate_repeats` has the scatter
# Settings that name what was asked for or move no number; scenes, methods and protocols are compared one by one.
NOT_COMPARED = frozenset({"scenes", "methods", "protocols", "perception.cache"}) | MOVES_NO_NUMBER
_SHARES = ("recall", "precision", "IoU", "F1", "F1-conceptgraphs", "mPrecision", "mF1", "mF1-conceptgraphs", "pAcc")
_OF_QUESTIONS = ("instance", "affordance", "property", "relative", "all", "answer", "objects")
_OF_LABELS = ("label n", "label n'", "well-merged", "well-merged n'")
HIGHER_IS_BETTER = frozenset(
    {"AP", "AP50", "AP25", "mAcc", "mIoU", "F-mIoU", "synonyms", "overall", *_SHARES, *_OF_QUESTIONS, *_OF_LABELS}
)


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Value(_Model):
    """A fraction, None where it is undefined, and by how much another run may differ from it."""

    value: float | None = Field(allow_inf_nan=False)
    tolerance: float = Field(default=0.0, ge=0, allow_inf_nan=False)


Values = Mapping[str, Value]


class ProtocolKey(_Model):
    version: int
    digest: str


class MethodResult(_Model):
    """One method under one protocol: its headline values, those of each scene, and all values of each class."""

    method: str
    protocol: str
    profile: str | None
    encoder_digest: str | None
    metrics: dict[str, Value]
    scenes: dict[str, dict[str, Value]]
    classes: dict[str, dict[str, Value]]


class Reference(_Model):
    """What a run is held against; ``costs``: a method's update over the calibrating piece of work.

    ``processor``: a digest of the processor's kind; byte-equality is promised on one kind alone. ``calibration_ms``:
    of that piece of work, None in references that older versions wrote.
    """

    schema_version: Literal[1] = 1
    hardware: str
    processor: str
    n_runs: int = Field(ge=1)
    across_machines: float = Field(ge=0, le=1)
    cost_limit: float = Field(gt=1)
    limit: int
    settings: dict[str, str]
    data_digests: dict[str, str]
    protocols: dict[str, ProtocolKey]
    results: tuple[MethodResult, ...] = Field(min_length=1)
    costs: dict[str, float]
    calibration_ms: float | None = Field(default=None, gt=0, allow_inf_nan=False)


def read_reference(path: Path) -> Reference:
    """The reference in ``path``; ``ConfigError`` where it is none."""
    try:
        return Reference.model_validate(read_json(path))
    except StoreError as error:
        raise ConfigError(
            f"{error.args[0].partition(';')[0]}; make a reference with su3d-bench check --learn RUN"
        ) from error
    except (ValidationError, RecursionError) as error:
        shown = printable(str(path), 200)
        raise ConfigError(
            f"{shown}: is no reference of this version; make one with su3d-bench check --learn RUN"
        ) from error


def learn(
    runs: Sequence[FinishedRun], across_machines: float = ACROSS_MACHINES, cost_limit: float = COST_LIMIT
) -> Reference:
    """A reference from complete ``runs`` of one request, which must agree in everything that is not a measurement."""
    first = runs[0]
    for run in runs:
        if run.is_incomplete:
            raise ConfigError(f"{run.name}: is incomplete; a reference is learnt from complete runs")
        if differing := next(_differing_keys(_settings(first), _settings(run)), None):
            raise ConfigError(f"{run.name}: differs from {first.name} in {differing[0]}; learn from repeats of one run")
        if (run.record.data_digests, run.protocols) != (first.record.data_digests, first.protocols):
            raise ConfigError(f"{run.name}: has other data or protocols than {first.name}; learn from repeats")
    tables = [run.results for run in runs]
    if any(set(table) != set(tables[0]) for table in tables):
        raise ConfigError(f"{first.name}: the runs hold different methods or protocols; learn from repeats of one run")
    costs = [update_costs(run) for run in runs]
    return Reference(
        hardware=first.record.hardware,
        processor=first.record.processor,
        n_runs=len(runs),
        across_machines=across_machines,
        cost_limit=cost_limit,
        limit=first.limit,
        settings=_settings(first),
        data_digests=dict(first.record.data_digests),
        protocols={name: ProtocolKey(version=key.version, digest=key.digest) for name, key in first.protocols.items()},
        results=tuple(_learn_result([table[key] for table in tables]) for key in tables[0]),
        costs={name: float(np.median([cost[name] for cost in costs if name in cost])) for name in costs[0]},
        calibration_ms=_median([milliseconds for run in runs if (milliseconds := calibration_of(run)) is not None]),
    )


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _learn_result(repeats: Sequence[ResultRecord]) -> MethodResult:
    first = repeats[0]
    numbers = [repeat.result for repeat in repeats if repeat.result is not None]
    if len(numbers) < len(repeats):
        raise ConfigError(f"{first.method} under {first.protocol}: was not scored; learn from runs with numbers")
    scenes = [{scene: _only(row, first.headline) for scene, row in result.per_scene.items()} for result in numbers]
    return MethodResult(
        method=first.method,
        protocol=first.protocol,
        profile=first.profile,
        encoder_digest=first.encoder_digest,
        metrics=_learn_values([_only(result.metrics, first.headline) for result in numbers]),
        scenes={scene: _learn_values([rows.get(scene, {}) for rows in scenes]) for scene in scenes[0]},
        classes={
            name: _learn_values([result.per_class.get(name, {}) for result in numbers]) for name in numbers[0].per_class
        },
    )


def _only(row: Mapping[str, float | None], names: Sequence[str]) -> dict[str, float | None]:
    return {name: row.get(name) for name in names}


def _learn_values(repeats: Sequence[Mapping[str, float | None]]) -> dict[str, Value]:
    return {name: _learn_value([repeat.get(name) for repeat in repeats]) for name in repeats[0]}


def _learn_value(repeats: Sequence[float | None]) -> Value:
    known = [value for value in repeats if value is not None]
    if not known:
        return Value(value=None, tolerance=0.0)
    spread = max(known) - min(known)
    return Value(value=known[0] if spread == 0 else math.fsum(known) / len(known), tolerance=SPREADS * spread)


def check(run: FinishedRun, reference: Reference) -> Verdict:
    """Everything in which ``run`` differs from ``reference``, failures and improvements."""
    is_same_machine = run.record.processor == reference.processor
    findings = [*_identity(run, reference)]
    table = run.results
    n_compared = 0
    for expected in reference.results:
        where = f"{expected.method} / {expected.protocol}"
        measured = table.get((expected.method, expected.protocol))
        if measured is None or measured.result is None:
            findings.append(Finding("missing", where, "the run has no score of it"))
            continue
        if measured.profile != expected.profile:
            findings.append(_changed(where, "profile", expected.profile, measured.profile))
        if measured.encoder_digest != expected.encoder_digest:
            findings.append(_changed(where, "encoder digest", expected.encoder_digest, measured.encoder_digest))
        findings += _numbers(where, expected, measured.result, None if is_same_machine else reference.across_machines)
        n_compared += len(expected.metrics)
    busy = _busy(run, reference) if is_same_machine else None
    findings += _costs(run, reference, is_judged=is_same_machine and busy is None)
    remarks = [busy] if busy else [] if is_same_machine else [_other_machine(run, reference)]
    return Verdict(run.name, tuple(findings), n_compared, tuple(remarks))


def _other_machine(run: FinishedRun, reference: Reference) -> str:
    return (
        f"another processor ({run.record.hardware}) than the reference's ({reference.hardware}): headline values are "
        f"compared within {100 * reference.across_machines:g} points, scenes and classes by presence, costs are not "
        "judged"
    )


def _busy(run: FinishedRun, reference: Reference) -> str | None:
    """Why costs say nothing of the code, where something else used the processor; None where they do."""
    now, before = calibration_of(run), reference.calibration_ms
    if now is None or before is None or now <= BUSY * before:
        return None
    return (
        f"the machine was busy: the calibrating work took {now:.3g} ms, {now / before:.1f} times the reference's, so "
        "costs are not judged; run it again alone"
    )


def _identity(run: FinishedRun, reference: Reference) -> Iterator[Finding]:
    if run.is_incomplete:
        yield Finding("missing", "run", "is incomplete: some scenes failed")
    if run.limit != reference.limit:
        yield _changed("run", "limit", reference.limit, run.limit)
    for key, before, now in _differing_keys(reference.settings, _settings(run)):
        yield _changed("settings", key, before, now)
    for scene, digest in reference.data_digests.items():
        if scene not in run.scenes:
            yield Finding("missing", scene, "the run does not have this scene")
        elif run.record.data_digests.get(scene) != digest:
            yield _changed(scene, "data digest", digest, run.record.data_digests.get(scene))
    for name, expected in reference.protocols.items():
        if name not in run.protocols:
            yield Finding("missing", name, "the run does not have this protocol")
            continue
        rules = run.protocols[name]
        if rules.version != expected.version:
            yield _changed(name, "protocol version", expected.version, rules.version)
        elif rules.digest != expected.digest:
            yield _changed(name, "protocol digest", expected.digest, rules.digest)


def _changed(where: str, what: str, before: object, now: object) -> Finding:
    return Finding("changed", where, f"{what} was {_short(before)}, now {_short(now)}")


def _short(value: object) -> str:
    text = printable(str(value), 200)
    return f"{text[:12]}..." if len(text) > 40 and " " not in text else text


def _numbers(where: str, expected: MethodResult, measured: NumbersRecord, across: float | None) -> Iterator[Finding]:
    """``across``: the tolerance of headline values of another machine; None on the same one."""
    yield from _compare(where, expected.metrics, measured.metrics, across)
    for kind, tables, rows in (
        ("scene", expected.scenes, measured.per_scene),
        ("class", expected.classes, measured.per_class),
    ):
        for name, values in tables.items():
            row = rows.get(name)
            if row is None:
                yield Finding(
                    "missing", f"{where} / {kind} {printable(name, 80)}", f"the run does not have this {kind}"
                )
            elif across is None:
                yield from _compare(f"{where} / {kind} {printable(name, 80)}", values, row, None)


def _compare(where: str, expected: Values, row: Mapping[str, float | None], across: float | None) -> Iterator[Finding]:
    for name, value in expected.items():
        tolerance = value.tolerance if across is None else max(across, value.tolerance)
        measured = row.get(name)
        if measured == value.value:
            continue
        if measured is None or value.value is None:
            yield Finding("regression", f"{where} / {name}", "is undefined in one of the two", value.value, measured)
        elif abs(measured - value.value) > tolerance:
            is_better = name in HIGHER_IS_BETTER and measured > value.value
            text = "is better than the reference" if is_better else "is worse than the reference"
            if name not in HIGHER_IS_BETTER:
                text = "differs from the reference"
            kind: Literal["better", "regression"] = "better" if is_better else "regression"
            yield Finding(kind, f"{where} / {name}", text, value.value, measured, tolerance)


def _costs(run: FinishedRun, reference: Reference, *, is_judged: bool) -> Iterator[Finding]:
    measured = update_costs(run) if reference.costs else {}
    for method, before in reference.costs.items():
        now = measured.get(method)
        if now is None:
            yield Finding("missing", f"{method} / cost of an update", "the run did not measure it", before)
        elif is_judged and now > reference.cost_limit * before:
            text = f"costs {now / before:.2f} times the reference; {reference.cost_limit:g} times are allowed"
            yield Finding("cost", f"{method} / cost of an update", text, before, now)


def update_costs(run: FinishedRun) -> dict[str, float]:
    """Median milliseconds of the map's part of an update over those of the calibrating work, a method; the median over
    scenes, each against its own calibration. Methods that update nothing are left out."""
    costs = {}
    for method in run.methods:
        ratios = []
        for times in read_update_times(run, method):
            steady = pooled([times], MAP, WARM_UP)
            if times.calibration_ms and len(steady) and steady.any():
                ratios.append(float(np.median(steady)) / times.calibration_ms)
        if ratios:
            costs[method] = float(np.median(ratios))
    return costs


def calibration_of(run: FinishedRun) -> float | None:
    """Median milliseconds of the calibrating work over scenes and methods; None where nothing was updated."""
    times = (times.calibration_ms for method in run.methods for times in read_update_times(run, method))
    return _median([time for time in times if time])


def _settings(run: FinishedRun) -> dict[str, str]:
    keys = {".".join(path): str(value) for path, value in run.settings.items()}
    return {key: value for key, value in sorted(keys.items()) if key not in NOT_COMPARED}


def _differing_keys(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    for key in [*before, *(key for key in now if key not in before)]:
        if before.get(key) != now.get(key):
            yield key, before.get(key, "not set"), now.get(key, "not set")
