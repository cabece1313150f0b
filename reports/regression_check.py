"""The verdict of the regression check: Markdown for pull requests, JUnit XML, GitHub annotations, plain lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

from su3d_bench.core.errors import counted, printable, some
from su3d_bench.core.safe_output import one_line
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, text_table
from su3d_bench.reports.tables import formats as tables
from su3d_bench.reports.tables.formats import markup_free


@dataclass(frozen=True)
class Finding:
    """A difference; every kind but ``better`` fails. ``reference`` and ``measured`` are fractions, or costs.

    ``group``: the name under which many similar findings are summarised.
    """

    kind: Literal["regression", "missing", "changed", "cost", "better"]
    where: str
    text: str
    reference: float | None = None
    measured: float | None = None
    tolerance: float | None = None
    group: str = ""

    @property
    def is_failure(self) -> bool:
        return self.kind != "better"


@dataclass(frozen=True)
class Compared:
    """A number and its reference: a fraction that may differ by ``tolerance``, or a cost that may grow by the factor
    ``times``; ``where`` as in a finding."""

    where: str
    name: str
    reference: float | None
    measured: float | None
    tolerance: float = 0.0
    times: float | None = None

    @property
    def limit(self) -> str:
        if self.times is not None:
            return f"{self.times:g} times"
        return f"{100 * self.tolerance:.4g} points" if self.tolerance else "equal"


@dataclass(frozen=True)
class Verdict:
    """All findings of one run; ``numbers`` are the ``n_compared`` compared headline values, and costs."""

    run: str
    findings: tuple[Finding, ...]
    n_compared: int
    remarks: tuple[str, ...]
    numbers: tuple[Compared, ...] = ()

    @property
    def failures(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.is_failure)

    @property
    def is_passed(self) -> bool:
        return not self.failures


SCENES = "scenes"  # the group of missing scenes
MAX_LISTED_SIMILAR = 4  # findings of a group that are listed individually
MAX_NAMES = 8  # named per group
MAX_ROWS = 60  # comments on pull requests are limited to 65,536 characters


def headline(verdict: Verdict) -> str:
    """Return one line: passed or failed, with counts."""
    n_better = len(verdict.findings) - len(verdict.failures)
    better = f", {n_better} better" if n_better else ""
    if verdict.is_passed:
        values = counted(verdict.n_compared, "headline value")
        are, them = ("matches", "its") if verdict.n_compared == 1 else ("match", "their")
        return f"passed: {values} {are} {them} reference{better}"
    return f"failed: {counted(len(verdict.failures), 'difference')} from the reference{better}"


def plain_parts(verdict: Verdict) -> list[Table | Prose]:
    """Return the headline, each number with its reference, then one line per finding or group, failures first."""
    lines = plain_lines(verdict)
    return [Prose((lines[0],)), *_numbers(verdict), *([Prose(tuple(lines[1:]))] if lines[1:] else [])]


def _numbers(verdict: Verdict) -> list[Table | Prose]:
    if not verdict.numbers:
        return []
    marks = {row.where: _mark(row) for row in verdict.findings}
    rows = []
    for one in verdict.numbers:
        is_cost = one.times is not None
        mark = marks.get(f"{one.where} of {one.name}" if is_cost else f"{one.where} / {one.name}", "")
        pair = (one.reference, one.measured)
        values = [_shown(value, pair, is_cost=is_cost) for value in pair]
        rows.append([one.where, one.name, *values, one.limit, mark])
    rows.insert(0, ["method", "number", "reference", "now", "limit", "verdict"])
    return [text_table("check", rows if any(row[-1] for row in rows[1:]) else [row[:-1] for row in rows])]


def plain_lines(verdict: Verdict) -> list[str]:
    """Return the headline, then one line per finding or group, failures first."""
    return [headline(verdict), *(f"{_mark(row)} {row.where}: {_sentence(row)}" for row in _merged(verdict))]


def markdown(verdict: Verdict) -> str:
    """Return a comment for a pull request: the headline, a table of findings, each number, remarks."""
    lines = [f"**su3d-bench {headline(verdict)}**", ""]
    rows = _merged(verdict)
    if rows:
        lines += ["| | where | reference | now | |", "|---|---|---|---|---|"]
        for row in rows[:MAX_ROWS]:
            cells = (_mark(row), row.where, _number(row, row.reference), _number(row, row.measured), row.text)
            lines.append("| " + " | ".join(map(markup_free, cells)) + " |")
        if len(rows) > MAX_ROWS:
            lines.append(f"| | and {len(rows) - MAX_ROWS} more | | | |")
        lines.append("")
    lines += [tables.markdown([part]) for part in _numbers(verdict)]
    return "\n".join([*lines, *(f"- {markup_free(remark)}" for remark in verdict.remarks)]).rstrip("\n") + "\n"


def junit_xml(verdict: Verdict) -> str:
    """Return one test case per finding, failed or not, and one for all compared values."""
    suite = ElementTree.Element("testsuite", name="su3d-bench check")
    suite.set("tests", str(len(verdict.findings) + 1))
    suite.set("failures", str(len(verdict.failures)))
    ElementTree.SubElement(
        suite, "testcase", classname="su3d-bench", name=f"{verdict.n_compared} headline values compared"
    )
    for row in _ordered(verdict):
        case = ElementTree.SubElement(
            suite, "testcase", classname=f"su3d-bench.{row.kind}", name=printable(row.where, 300)
        )
        if row.is_failure:
            ElementTree.SubElement(case, "failure", message=printable(_sentence(row), 600))
        else:
            ElementTree.SubElement(case, "system-out").text = printable(_sentence(row), 600)
    ElementTree.indent(suite)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(suite, encoding="unicode") + "\n"


def github_lines(verdict: Verdict) -> list[str]:
    """Return workflow commands: errors for failures, notices for improvements; GitHub shows ten of each."""
    return [
        f"::{'error' if row.is_failure else 'notice'} title=su3d-bench::{_workflow(f'{row.where}: {_sentence(row)}')}"
        for row in _merged(verdict)
    ] + [f"::notice title=su3d-bench::{_workflow(headline(verdict))}"]


def _ordered(verdict: Verdict) -> Sequence[Finding]:
    """Return the findings, failures first, and among them missing scenes first."""
    return sorted(verdict.findings, key=lambda one: (not one.is_failure, one.group != SCENES))


def _merged(verdict: Verdict) -> list[Finding]:
    """Return the ordered findings, with large groups summarised."""
    alike: dict[tuple[str, ...], list[Finding]] = {}
    for n, one in enumerate(_ordered(verdict)):
        alike.setdefault((one.kind, one.group, one.text) if one.group else (str(n),), []).append(one)
    return [one for ones in alike.values() for one in (ones if len(ones) <= MAX_LISTED_SIMILAR else [_as_one(ones)])]


def _as_one(alike: Sequence[Finding]) -> Finding:
    """Return one finding for several with the same group and text, with their names."""
    first = alike[0]
    names = some([one.where.removeprefix(f"{first.group.rpartition(' / ')[0]} / ") for one in alike], MAX_NAMES)
    return Finding(first.kind, first.group, f"{first.text} ({len(alike)}: {names})")


def _mark(finding: Finding) -> str:
    return "FAIL" if finding.is_failure else "better"


def _sentence(finding: Finding) -> str:
    if finding.reference is None and finding.measured is None:
        return finding.text
    numbers = f"{_number(finding, finding.reference)} -> {_number(finding, finding.measured)}"
    allowed = "" if not finding.tolerance else f", tolerance {100 * finding.tolerance:.4g} points"
    return f"{finding.text} ({numbers}{allowed})"


def _number(finding: Finding, value: float | None) -> str:
    pair = (finding.reference, finding.measured)
    return _shown(value, pair, is_cost=finding.kind in ("cost", "missing"))


def _shown(value: float | None, pair: tuple[float | None, float | None], *, is_cost: bool) -> str:
    """Format fractions in per cent, with enough digits to distinguish the ``pair``; costs as ratios."""
    if value is None:
        return NOT_MEASURED
    if is_cost:
        return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"
    one, other = pair
    if one is None or other is None or one == other:
        return f"{100 * value:.1f}"
    digits = next((n for n in (1, 2, 4, 8) if f"{100 * one:.{n}f}" != f"{100 * other:.{n}f}"), 12)
    return f"{100 * value:.{digits}f}"


def _workflow(text: str) -> str:
    """Return text for a workflow command: on one line, percent signs encoded."""
    return one_line(text).replace("%", "%25")
