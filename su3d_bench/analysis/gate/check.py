"""Everything in which a run differs from a reference."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Literal

from su3d_bench.analysis.gate.reference import (
    MethodResult,
    Reference,
    Value,
    Values,
    busy_remark,
    cost_findings,
    cost_numbers,
    differing_keys,
    settings_of,
    why_no_cost,
)
from su3d_bench.core.english import plural
from su3d_bench.core.errors import printable
from su3d_bench.metrics.protocols.kinds import GroundingRules, PanopticRules, PresenceQuestionRules
from su3d_bench.reports.gate import SCENES, Compared, Finding, Verdict
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.runs.verify import wrong_files
from su3d_bench.store.records import NumbersRecord

_SHARES = ("recall", "precision", "IoU", "F1", "F1-conceptgraphs", "mPrecision", "mF1", "mF1-conceptgraphs", "pAcc")
_OF_QUESTIONS = ("instance", "affordance", "property", "relative", "all", "answer", "objects")
_OF_BOXES = ("centroid", "class", "recall25", "recall50", "precision25", "precision50")
_OF_LABELS = ("label n", "label n'", "well-merged", "well-merged n'")
_JUDGED = (*_OF_QUESTIONS, *_OF_LABELS)
_OF_SEGMENTS = PanopticRules.values_of_metric["panopticapi"]
# whether yes is said too often or too seldom depends on where one stands
_OF_PRESENCE = tuple(name for name in PresenceQuestionRules.values_of_metric["pope"] if "yes-rate" not in name)
HIGHER_IS_BETTER = frozenset(
    {
        *("AP", "AP50", "AP25", "mAcc", "mIoU", "F-mIoU", "synonyms", "overall"),
        *GroundingRules.values_of_metric["scanrefer"], *_SHARES, *_OF_BOXES, *_JUDGED, *_OF_SEGMENTS, *_OF_PRESENCE,
    }
)  # fmt: skip


def _is_better_higher(name: str) -> bool:
    return re.sub(r"^top-\d+ ", "", name) in HIGHER_IS_BETTER


def check(run: FinishedRun, reference: Reference) -> Verdict:
    """Everything in which ``run`` differs from ``reference``, failures and improvements."""
    is_same_machine = run.record.processor == reference.processor
    findings = [*_identity(run, reference)]
    findings += [Finding("changed", where, fault) for where, fault in wrong_files(run)]
    table = run.results
    across = None if is_same_machine else reference.across_machines
    numbers: list[Compared] = []
    for expected in reference.results:
        where = f"{printable(expected.method, 80)} / {printable(expected.protocol, 80)}"
        measured = table.get((expected.method, expected.protocol))
        if measured is None or measured.result is None:
            findings.append(Finding("missing", where, "the run has no score of it"))
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
    costs, limit = reference.costs, reference.cost_limit
    findings += cost_findings(run, costs, reference.calibration_ms, limit, is_judged=is_same_machine)
    findings += _costs_not_learnt(run, reference)
    n_values = len(numbers)
    if is_same_machine:
        numbers += cost_numbers(run, costs, reference.calibration_ms, limit)
    return Verdict(run.name, tuple(findings), n_values, tuple(_remarks(run, reference)), tuple(numbers))


def _remarks(run: FinishedRun, reference: Reference) -> Iterator[str]:
    """What was not judged, and why."""
    if run.record.processor != reference.processor:
        yield _other_machine(run, reference)
    elif (busy := busy_remark(run, reference.calibration_ms)) is not None:
        yield busy
    yield from run.elsewhere_lines()
    known = {result.method for result in reference.results}
    others = [*(method for method in run.methods if method not in known)]
    others += [name for name in run.protocols if name not in reference.protocols]
    if others:
        yield f"the reference does not know, so that nothing holds: {', '.join(printable(name, 80) for name in others)}"
    for method in run.methods:
        if method in known and method not in reference.costs and (reason := why_no_cost(run, method)):
            yield f"{printable(method, 80)}: no cost is judged: it {reason}"


def _costs_not_learnt(run: FinishedRun, reference: Reference) -> Iterator[Finding]:
    known = {result.method for result in reference.results}
    for method in run.methods:
        if method in known and method not in reference.costs and why_no_cost(run, method) is None:
            text = "the reference holds none and the run measured it; learn a new reference"
            yield Finding("missing", f"{printable(method, 80)} / cost", text)


def _unknown(where: str, kind: str, known: Collection[str], measured: Collection[str]) -> Iterator[Finding]:
    """A finding for whatever the run has and the reference has not."""
    for name in measured:
        if name not in known:
            text = f"the reference does not have this {kind}; learn a new one"
            here = f"{where} / {kind} {printable(name, 80)}"
            yield Finding("changed", here, text, group=_several(where, kind))


def _several(where: str, kind: str) -> str:
    return f"{where} / {plural(kind)}"


def _other_machine(run: FinishedRun, reference: Reference) -> str:
    here, there = (printable(hardware, 120) for hardware in (run.record.hardware, reference.hardware))
    which = f"another processor ({here}) than the reference's ({there})"
    if here == there:
        which = f"another processor of the same name as the reference's ({here}), with other instruction sets"
    return (
        f"{which}: headline values are compared within "
        f"{100 * reference.across_machines:g} points, scenes and classes by presence, costs are not judged"
    )


def _identity(run: FinishedRun, reference: Reference) -> Iterator[Finding]:
    if run.is_incomplete:
        yield Finding("missing", "run", "is incomplete: some scenes failed")
    if run.limit != reference.limit:
        yield _changed("run", "limit", reference.limit, run.limit)
    for key, before, now in differing_keys(reference.settings, settings_of(run)):
        yield _changed("settings", key, before, now)
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
    """Every number that differs, or that one of the two lacks.

    ``across``: the tolerance of headline values of another machine; None on the same one. Where the scenes differ,
    which fails, what is formed over all of them is not compared.
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
    """What differs in the values of each scene or class; on another machine whether they are there."""
    for name, values in tables.items():
        row, here = rows.get(name), f"{where} / {kind} {printable(name, 80)}"
        found: Iterable[Finding] = ()
        if row is None:
            found = [Finding("missing", here, f"the run does not have this {kind}")]
        elif across is None:
            found = _compare(here, values, row, None)
        yield from (replace(finding, group=_several(where, kind)) for finding in found)


def _tolerance(value: Value, across: float | None) -> float:
    return value.tolerance if across is None else max(across, value.tolerance)


def _compare(where: str, expected: Values, row: Mapping[str, float | None], across: float | None) -> Iterator[Finding]:
    for name, value in expected.items():
        tolerance = _tolerance(value, across)
        measured = row.get(name)
        if measured == value.value:
            continue
        if measured is None or value.value is None:
            yield Finding(
                "regression",
                f"{where} / {printable(name, 80)}",
                "is undefined in one of the two",
                value.value,
                measured,
            )
        elif abs(measured - value.value) > tolerance:
            is_better = _is_better_higher(name) and measured > value.value
            text = "is better than the reference" if is_better else "is worse than the reference"
            if not _is_better_higher(name):
                text = "differs from the reference"
            kind: Literal["better", "regression"] = "better" if is_better else "regression"
            yield Finding(kind, f"{where} / {printable(name, 80)}", text, value.value, measured, tolerance)
