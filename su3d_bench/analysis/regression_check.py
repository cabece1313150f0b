"""Regression check of a run against a reference: every number with a tolerance learned from repeats of the run.

A tolerance comes from the spread of the repeats: zero if they agree to the last bit. Whatever determines the numbers
(protocol, data, weights, settings) must not change at all.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from su3d_bench.analysis.rescoring import rescored
from su3d_bench.core.config import NEUTRAL_SETTINGS
from su3d_bench.core.digests import NUMERIC_PACKAGES
from su3d_bench.core.english import plural
from su3d_bench.core.errors import ConfigError, StoreError, counted, printable
from su3d_bench.core.files.atomic import read_json
from su3d_bench.metrics.costs import MAP, WARM_UP, UpdateTimes
from su3d_bench.metrics.protocols.kinds import GroundingRules, PanopticRules, PresenceQuestionRules
from su3d_bench.reports.regression_check import SCENES, Compared, Finding, Verdict
from su3d_bench.runs.finished import FinishedRun, read_update_times
from su3d_bench.runs.verify import examine
from su3d_bench.store.records import ROUNDING, NumbersRecord, ResultRecord

# If the calibration workload takes this many times the reference's time on the same kind of processor, other processes
# used it or the checked code slows it. The two cannot be told apart, so the slowdown is only allowed for up to a limit.
BUSY = 1.5
MAX_EXCUSED = 2.0
MAX_CALIBRATION = 1e12  # calibration workloads: many years
# A part of the total time must grow by more than this share of the total, and by more than one calibration workload: a
# single call that waited for the processor is not a regression.
MIN_SHARE = 0.05
MIN_COST_LIMIT = 1.0

Part = Literal["start", "updates", "finish", "total"]
SHOWN: Mapping[Part, str] = {
    "start": f"start and first {WARM_UP} updates",
    "updates": f"updates after the first {WARM_UP}",
    "finish": "finish",
    "total": "all stages",
}


class Cost(BaseModel):
    """Times of a method summed over all scenes, each in units of its scene's calibration workload.

    ``start``: setup and the first ``WARM_UP`` updates; ``updates``: the others, as their median times their number;
    ``finish``: every map and what follows; ``total``: everything, without medians.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: float = Field(ge=0, le=MAX_CALIBRATION, allow_inf_nan=False)
    updates: float = Field(ge=0, le=MAX_CALIBRATION, allow_inf_nan=False)
    finish: float = Field(ge=0, le=MAX_CALIBRATION, allow_inf_nan=False)
    total: float = Field(gt=0, le=MAX_CALIBRATION, allow_inf_nan=False)

    @classmethod
    def middle(cls, costs: list[Cost]) -> Cost:
        """The median of the costs of repeats, per part."""
        return cls(**{part: float(np.median([getattr(cost, part) for cost in costs])) for part in SHOWN})


def method_cost(run: FinishedRun, method: str, most_calibration_ms: float = np.inf) -> Cost | None:
    """The cost of a method over the scenes with enough updates; None if ``no_cost_reason`` has a reason.

    ``most_calibration_ms``: the time of the calibration workload is capped at this value.
    """
    if no_cost_reason(run, method) is not None:
        return None
    timed = [times for times in read_update_times(run, method) if len(times) > WARM_UP]
    scenes = [_of_scene(times, most_calibration_ms) for times in timed]
    return Cost(**{part: min(sum(scene[part] for scene in scenes), MAX_CALIBRATION) for part in SHOWN})


def _of_scene(times: UpdateTimes, most_calibration_ms: float) -> dict[Part, float]:
    assert times.start_ms is not None and times.close_ms is not None and times.calibration_ms
    unit_ms = min(times.calibration_ms, most_calibration_ms)
    ms = times.ms(MAP)
    finish_ms = sum(max(0.0, one.finish_ms - one.perception_ms) for one in times.maps) + times.close_ms
    steady = ms[WARM_UP:]
    parts: dict[Part, float] = {
        "start": times.start_ms + ms[:WARM_UP].sum(),
        "updates": np.median(steady) * len(steady),
        "finish": finish_ms,
        "total": times.start_ms + ms.sum() + finish_ms,
    }
    return {part: float(value) / unit_ms for part, value in parts.items()}


def no_cost_reason(run: FinishedRun, method: str) -> str | None:
    """Why a run has no cost of ``method``; None if it has one."""
    if method in run.external:
        return "was evaluated from predictions made elsewhere, which have no times"
    timed = read_update_times(run, method)
    n_most = max((len(times) for times in timed), default=0)
    if n_most <= WARM_UP:
        what = f"has at most {counted(n_most, 'update')} per scene" if n_most else "uses no frames"
        return f"{what}; measuring the cost takes at least {WARM_UP + 1} updates"
    measured = [times for times in timed if len(times) > WARM_UP]
    if any("method_ms" not in times.columns or None in (times.start_ms, times.close_ms) for times in measured):
        return "was timed by an older version, which did not measure around the method; run it again"
    if not all(times.calibration_ms and times.maps for times in measured):
        return "was run without the calibration workload; run it again"
    return None if any(times.ms(MAP).any() for times in measured) else "took no time at all"


def calibration_of(run: FinishedRun) -> float | None:
    """Median milliseconds of the calibration workload over scenes and methods; None if there were no updates."""
    every = [times.calibration_ms for method in run.methods for times in read_update_times(run, method)]
    known = [milliseconds for milliseconds in every if milliseconds]
    return float(np.median(known)) if known else None


def compare_costs(
    run: FinishedRun, costs: Mapping[str, Cost], calibration_ms: float | None, limit: float
) -> tuple[list[Finding], list[Compared]]:
    """Findings on costs that exceed ``limit`` times the reference's or were not measured, and all compared parts."""
    findings, numbers = list[Finding](), list[Compared]()
    most = np.inf if calibration_ms is None else MAX_EXCUSED * calibration_ms
    for method, before in costs.items():
        where = f"{printable(method, 80)} / cost"
        if method not in run.methods:
            findings.append(Finding("missing", where, "the run does not have this method"))
            continue
        if (reason := no_cost_reason(run, method)) is not None:
            findings.append(Finding("missing", where, f"the run did not measure it: it {reason}"))
            continue
        now = method_cost(run, method, most)
        for part, shown in SHOWN.items():
            was, cost = getattr(before, part), getattr(now, part)
            numbers.append(Compared(where, shown, was, cost, times=limit))
            least = MIN_COST_LIMIT if part == "total" else max(MIN_COST_LIMIT, MIN_SHARE * before.total)
            if cost > limit * was and cost - was > least:
                times = f"takes {cost / was:.2f} times as long as" if was else "takes time, but none in"
                text = f"{times} the reference; at most {limit:g} times as long is allowed"
                findings.append(Finding("cost", f"{where} of {shown}", text, was, cost))
    return findings, numbers


def busy_remark(run: FinishedRun, calibration_ms: float | None) -> str | None:
    """A remark that the calibration workload was slow; None if it was not."""
    now = calibration_of(run)
    if now is None or calibration_ms is None or now <= BUSY * calibration_ms:
        return None
    return (
        f"the calibration workload took {now:.3g} ms, {now / calibration_ms:.1f} times the reference's: the processor "
        f"was busy, or the checked code slows it; costs are corrected for this by at most a factor of {MAX_EXCUSED:g}"
    )


SCHEMA: Literal[2] = 2
SPREADS = 2.0  # tolerance in ranges of the learned values: with 1, 2 of 50 unchanged repeats would fail
ACROSS_MACHINES = 0.02  # 2 points: effect of ONNX Runtime and BLAS kernels of other processors on a headline value
COST_LIMIT = 1.3  # maximum slowdown factor of a method; `python benchmarks regression_check_repeats` has the scatter
MAX_COST_LIMIT = 1000.0
# Settings that state the request or change no number; scenes, methods and protocols are compared one by one.
NOT_COMPARED = frozenset({"scenes", "methods", "protocols", "perception.cache"}) | NEUTRAL_SETTINGS


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Value(_Model):
    """A fraction, None if undefined, and by how much another run may differ from it."""

    value: float | None = Field(allow_inf_nan=False)
    tolerance: float = Field(default=0.0, ge=0, le=SPREADS * (1 + ROUNDING), allow_inf_nan=False)


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
    metrics: dict[str, Value] = Field(min_length=1)
    scenes: dict[str, dict[str, Value]] = Field(min_length=1)
    classes: dict[str, dict[str, Value]]

    @model_validator(mode="after")
    def _can_fail(self) -> Self:
        """Reject a reference without numbers: every run without numbers would pass it."""
        if all(value.value is None for value in self.metrics.values()):
            raise ValueError(f"{self.method} under {self.protocol} has no value")
        return self


class Reference(_Model):
    """What a run is compared with; ``costs``: per method, in units of the calibration workload.

    ``processor``: digest of the processor's kind; byte-equality is only promised on one kind. ``calibration_ms``: time
    of the calibration workload. ``weights``: see ``weights_of``; None in references of earlier versions.
    """

    schema_version: Literal[2]
    hardware: str
    processor: str
    n_runs: int = Field(ge=1)
    machine_tolerance: float = Field(ge=0, le=1)
    cost_limit: float | None = Field(gt=1, le=MAX_COST_LIMIT)  # None: above COST_LIMIT there is a remark
    limit: int = Field(ge=0)
    settings: dict[str, str]
    weights: dict[str, str] | None = None
    data_digests: dict[str, str] = Field(min_length=1)
    protocols: dict[str, ProtocolKey] = Field(min_length=1)
    results: tuple[MethodResult, ...] = Field(min_length=1)
    costs: dict[str, Cost]
    calibration_ms: float | None = Field(default=None, gt=0, allow_inf_nan=False)


def read_reference(path: Path) -> Reference:
    """The reference in ``path``; ``ConfigError`` if it is not one."""
    try:
        return Reference.model_validate(read_json(path))
    except StoreError as error:
        raise ConfigError(
            f"{error.args[0].partition(';')[0]}; create a reference with su3d-bench check --build-from RUN"
        ) from error
    except (ValidationError, RecursionError) as error:
        what = _fault(error) if isinstance(error, ValidationError) else "is nested too deeply"
        raise ConfigError(
            f"{printable(str(path), 200)}: is not a reference of this version: {what}; create one with su3d-bench "
            "check --build-from RUN"
        ) from error


def _fault(error: ValidationError) -> str:
    first = error.errors()[0]
    key = printable(".".join(map(str, first["loc"])), 120)
    what = str(first.get("ctx", {}).get("error", first["msg"]))
    return printable(f"{key}: {what}" if key else what, 240)


def learn(
    runs: Sequence[FinishedRun], machine_tolerance: float = ACROSS_MACHINES, cost_limit: float | None = None
) -> Reference:
    """A reference from complete repeats of one run, which must agree in everything that is not a measurement."""
    first = runs[0]
    for run in runs:
        if run.is_incomplete:
            raise ConfigError(f"{run.name}: is incomplete; a reference can only be learned from complete runs")
        if differing := next(differing_keys(settings_of(first), settings_of(run)), None):
            raise ConfigError(f"{run.name}: differs from {first.name} in {differing[0]}; learn from repeats of one run")
        inputs = [(one.record.data_digests, one.protocols, weights_of(one)) for one in (run, first)]
        if inputs[0] != inputs[1]:
            raise ConfigError(f"{run.name}: has other data, protocols, weights or packages than {first.name}")
    examined = [examine(run, with_maps=True) for run in runs]
    for run, faults in examined:
        for where, fault in faults:
            raise ConfigError(f"{run.name}: {where}: {fault}; run its command again")
    tables = [run.results for run, _ in examined]
    if any(set(table) != set(tables[0]) for table in tables):
        raise ConfigError(f"{first.name}: the runs have different methods or protocols; learn from repeats of one run")
    known = {method: [cost for run in runs if (cost := method_cost(run, method))] for method in first.methods}
    calibrations = [milliseconds for run in runs if (milliseconds := calibration_of(run)) is not None]
    return Reference(
        schema_version=SCHEMA,
        hardware=first.record.hardware,
        processor=first.record.processor,
        n_runs=len(runs),
        machine_tolerance=machine_tolerance,
        cost_limit=cost_limit,
        limit=first.limit,
        settings=settings_of(first),
        weights=weights_of(first),
        data_digests=dict(first.record.data_digests),
        protocols={name: ProtocolKey(version=key.version, digest=key.digest) for name, key in first.protocols.items()},
        results=tuple(_learn_result([table[key] for table in tables]) for key in tables[0]),
        costs={method: Cost.middle(costs) for method, costs in known.items() if costs},
        calibration_ms=float(np.median(calibrations)) if calibrations else None,
    )


def _learn_result(repeats: Sequence[ResultRecord]) -> MethodResult:
    first = repeats[0]
    numbers = [repeat.result for repeat in repeats if repeat.result is not None]
    if len(numbers) < len(repeats):
        raise ConfigError(f"{first.method} under {first.protocol}: was not scored; learn from runs with numbers")
    if all(result.metrics.get(name) is None for result in numbers for name in first.headline):
        raise ConfigError(
            f"{first.method} under {first.protocol}: has no value to compare with; learn without this protocol"
        )
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
    values = {}
    for name in repeats[0]:
        known = [value for repeat in repeats if (value := repeat.get(name)) is not None]
        spread = max(known) - min(known) if known else 0.0
        middle = None if not known else known[0] if spread == 0 else math.fsum(known) / len(known)
        values[name] = Value(value=middle, tolerance=SPREADS * spread)
    return values


def settings_of(run: FinishedRun) -> dict[str, str]:
    """The settings that must equal those of the reference."""
    keys = {".".join(path): str(value) for path, value in run.settings.items()}
    return {key: value for key, value in sorted(keys.items()) if key not in NOT_COMPARED}


def weights_of(run: FinishedRun) -> dict[str, str]:
    """SHA-256 of every weight file that the run recorded and of other files of its methods; versions of packages."""
    weights = {f"package {name}": text for name, text in run.record.packages.items() if name in NUMERIC_PACKAGES}
    weights |= {f"{model}/{name}": sha for model, files in run.record.models.items() for name, sha in files.items()}
    for job in run.folder.jobs():
        step = job.completion_records().get("predict")
        inputs = {} if step is None else step.key
        weights |= {f"{job.path.name}/{name}": sha for name, sha in inputs.items() if name.startswith("input.")}
    return weights


def differing_keys(before: Mapping[str, str], now: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """Each key that differs, with its old and new value."""
    for key in [*before, *(key for key in now if key not in before)]:
        if before.get(key) != now.get(key):
            yield key, before.get(key, "not set"), now.get(key, "not set")


_SHARES = ("recall", "precision", "IoU", "F1", "F1-conceptgraphs", "mPrecision", "mF1", "mF1-conceptgraphs", "pAcc")
_OF_QUESTIONS = ("instance", "affordance", "property", "relative", "all", "answer", "objects")
_OF_BOXES = ("centroid", "class", "recall25", "recall50", "precision25", "precision50")
_OF_LABELS = ("label n", "label n'", "well-merged", "well-merged n'")
_JUDGED = (*_OF_QUESTIONS, *_OF_LABELS)
_OF_SEGMENTS = PanopticRules.values_of_metric["panopticapi"]
# yes-rate has no direction: it can be too high or too low
_OF_PRESENCE = tuple(name for name in PresenceQuestionRules.values_of_metric["pope"] if "yes-rate" not in name)
HIGHER_IS_BETTER = frozenset(
    {
        *("AP", "AP50", "AP25", "mAcc", "mIoU", "F-mIoU", "synonyms", "overall"),
        *GroundingRules.values_of_metric["scanrefer"], *_SHARES, *_OF_BOXES, *_JUDGED, *_OF_SEGMENTS, *_OF_PRESENCE,
    }
)  # fmt: skip


def check(
    run: FinishedRun,
    reference: Reference,
    *,
    recompute: bool = False,
    progress: Callable[[str, int, int], None] = lambda scene, n_done, n_all: None,
) -> Verdict:
    """Everything in which the counts of ``run`` differ from ``reference``, both failures and improvements.

    ``recompute``: also score its maps again and compare these scores with its counts.
    """
    is_same_machine = run.record.processor == reference.processor
    findings, (run, faults) = [*_identity(run, reference)], examine(run, with_maps=True)
    findings += [Finding("changed", where, fault) for where, fault in faults]
    if faults:  # whatever such records say is not compared
        return Verdict(run.name, tuple(findings), 0, (), ())
    if recompute:
        findings += [Finding("changed", "maps", fault) for _, _, fault in rescored(run, progress) if fault is not None]
    table = run.results
    across = None if is_same_machine else reference.machine_tolerance
    numbers: list[Compared] = []
    for expected in reference.results:
        where = f"{printable(expected.method, 80)} / {printable(expected.protocol, 80)}"
        measured = table.get((expected.method, expected.protocol))
        if measured is None or measured.result is None:
            findings.append(Finding("missing", where, "the run has no score for it"))
            continue
        if measured.profile != expected.profile:
            findings.append(_changed(where, "profile", expected.profile, measured.profile))
        if measured.encoder_digest != expected.encoder_digest:
            findings.append(_changed(where, "encoder digest", expected.encoder_digest, measured.encoder_digest))
        findings += _unknown(where, "value", expected.metrics, measured.headline)
        findings += compared(where, expected, measured.result, across)
        numbers += [
            Compared(where, name, value.value, measured.result.metrics.get(name), tolerance=_tolerance(value, across))
            for name, value in expected.metrics.items()
        ]
    costs, limit = reference.costs, reference.cost_limit or COST_LIMIT
    dearer, of_costs = compare_costs(run, costs, reference.calibration_ms, limit)
    remarks = [*_remarks(run, reference)]
    slower = [one for one in dearer if one.kind == "cost"] if is_same_machine else []
    findings += [one for one in dearer if one.kind != "cost"]
    if reference.cost_limit is None:
        remarks += [f"{one.where}: {one.text}; passes because no --cost-limit is set" for one in slower]
    else:
        findings += slower
    methods = {result.method for result in reference.results}
    for method in run.methods:
        if method in methods and method not in costs:
            if (reason := no_cost_reason(run, method)) is not None:
                remarks.append(f"{printable(method, 80)}: cost not checked: it {reason}")
            else:
                text = "the run has a cost, but the reference has none; learn a new reference"
                findings.append(Finding("missing", f"{printable(method, 80)} / cost", text))
    shown = (*numbers, *of_costs) if is_same_machine else tuple(numbers)
    return Verdict(run.name, tuple(findings), len(numbers), tuple(remarks), shown)


def _remarks(run: FinishedRun, reference: Reference) -> Iterator[str]:
    """Remarks on what was not checked, and why."""
    if run.record.processor != reference.processor:
        here, there = (printable(hardware, 120) for hardware in (run.record.hardware, reference.hardware))
        which = f"the processor ({here}) is not the reference's ({there})"
        if here == there:
            which = f"the processor has the same name as the reference's ({here}), but other instruction sets"
        yield (
            f"{which}: headline values are compared within {100 * reference.machine_tolerance:g} points, scenes and "
            "classes only for presence, costs are not checked"
        )
    elif (busy := busy_remark(run, reference.calibration_ms)) is not None:
        yield busy
    yield from run.elsewhere_lines()
    known = {result.method for result in reference.results}
    others = [*(method for method in run.methods if method not in known)]
    others += [name for name in run.protocols if name not in reference.protocols]
    if others:
        yield f"not in the reference, so not checked: {', '.join(printable(name, 80) for name in others)}"


def _unknown(where: str, kind: str, known: Collection[str], measured: Collection[str]) -> Iterator[Finding]:
    """One finding for each name that the run has and the reference does not."""
    for name in measured:
        if name not in known:
            text = f"the reference does not have this {kind}; learn a new reference"
            here = f"{where} / {kind} {printable(name, 80)}"
            yield Finding("changed", here, text, group=f"{where} / {plural(kind)}")


def _identity(run: FinishedRun, reference: Reference) -> Iterator[Finding]:
    if run.is_incomplete:
        yield Finding("missing", "run", "is incomplete: some scenes failed")
    if run.limit != reference.limit:
        yield _changed("run", "limit", reference.limit, run.limit)
    for key, before, now in differing_keys(reference.settings, settings_of(run)):
        yield _changed("settings", key, before, now)
    for key, before, now in differing_keys(reference.weights or {}, weights_of(run)):
        if reference.weights is not None:
            yield _changed("run", key, before, now)
    for scene, digest in reference.data_digests.items():
        if scene not in run.scenes:
            yield Finding("missing", printable(scene, 80), "the run does not have this scene", group=SCENES)
        elif run.record.data_digests.get(scene) != digest:
            yield _changed(scene, "data digest", digest, run.record.data_digests.get(scene))
    yield from _unknown("run", "scene", reference.data_digests, run.scenes)
    for name, expected in reference.protocols.items():
        if name not in run.protocols:
            yield Finding("missing", printable(name, 80), "the run does not have this protocol")
            continue
        rules = run.protocols[name]
        if rules.version != expected.version:
            yield _changed(name, "protocol version", expected.version, rules.version)
        elif rules.digest != expected.digest:
            yield _changed(name, "protocol digest", expected.digest, rules.digest)


def _changed(where: str, what: str, before: object, now: object) -> Finding:
    text = f"{printable(what, 200)} was {_short(before)}, now {_short(now)}"
    return Finding("changed", printable(where, 200), text)


def _short(value: object) -> str:
    text = printable(str(value), 200)
    return f"{text[:12]}..." if len(text) > 40 and " " not in text else text


def compared(where: str, expected: MethodResult, measured: NumbersRecord, across: float | None) -> Iterator[Finding]:
    """Findings for every number that differs, or that only one of the two has.

    ``across``: tolerance of headline values from another machine; None on the same one. If the scenes differ (itself a
    failure), values over all scenes are not compared.
    """
    if expected.scenes.keys() == measured.per_scene.keys():
        yield from _compare(where, expected.metrics, measured.metrics, across)
        yield from _rows(where, "class", expected.classes, measured.per_class, across)
        if across is None:
            yield from _unknown(where, "class", expected.classes, measured.per_class)
    yield from _unknown(where, "scene", expected.scenes, measured.per_scene)
    yield from _rows(where, "scene", expected.scenes, measured.per_scene, across)


def _rows(
    where: str,
    kind: str,
    tables: Mapping[str, Values],
    rows: Mapping[str, Mapping[str, float | None]],
    across: float | None,
) -> Iterator[Finding]:
    """Findings for values of scenes or classes that differ; on another machine, only for missing ones."""
    for name, values in tables.items():
        row, here = rows.get(name), f"{where} / {kind} {printable(name, 80)}"
        found: Iterable[Finding] = ()
        if row is None:
            found = [Finding("missing", here, f"the run does not have this {kind}")]
        elif across is None:
            found = _compare(here, values, row, None)
        yield from (replace(finding, group=f"{where} / {plural(kind)}") for finding in found)


def _tolerance(value: Value, across: float | None) -> float:
    return value.tolerance if across is None else max(across, value.tolerance)


def _compare(where: str, expected: Values, row: Mapping[str, float | None], across: float | None) -> Iterator[Finding]:
    for name, value in expected.items():
        tolerance = _tolerance(value, across)
        measured = row.get(name)
        if measured == value.value:
            continue
        if measured is None or value.value is None:
            text = "is undefined in one of the two"
            yield Finding("regression", f"{where} / {printable(name, 80)}", text, value.value, measured)
        elif abs(measured - value.value) > tolerance:
            has_direction = re.sub(r"^top-\d+ ", "", name) in HIGHER_IS_BETTER
            is_better = has_direction and measured > value.value
            text = f"is {'better' if is_better else 'worse'} than" if has_direction else "differs from"
            kind: Literal["better", "regression"] = "better" if is_better else "regression"
            here = f"{where} / {printable(name, 80)}"
            yield Finding(kind, here, f"{text} the reference", value.value, measured, tolerance)
