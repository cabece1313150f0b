"""The gate's verdict for a pull request: Markdown, JUnit XML, GitHub annotations, plain lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

from su3d_bench.core.errors import printable
from su3d_bench.core.printing import one_line
from su3d_bench.reports.tables.formats import markup_free
from su3d_bench.reports.tables.model import NOT_MEASURED


@dataclass(frozen=True)
class Finding:
    """A difference; every kind but ``better`` fails. ``reference`` and ``measured`` are fractions, or costs."""

    kind: Literal["regression", "missing", "changed", "cost", "better"]
    where: str
    text: str
    reference: float | None = None
    measured: float | None = None
    tolerance: float | None = None

    @property
    def is_failure(self) -> bool:
        return self.kind != "better"


@dataclass(frozen=True)
class Verdict:
    """All findings of one run; ``n_compared`` headline values were looked at."""

    run: str
    findings: tuple[Finding, ...]
    n_compared: int
    remarks: tuple[str, ...]

    @property
    def failures(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.is_failure)

    @property
    def is_passed(self) -> bool:
        return not self.failures


MAX_ROWS = 60  # a comment on a pull request may hold 65,536 characters


def headline(verdict: Verdict) -> str:
    """One line: passed or failed, with counts."""
    n_better = len(verdict.findings) - len(verdict.failures)
    better = f", {n_better} better" if n_better else ""
    if verdict.is_passed:
        return f"passed: {verdict.n_compared} headline values are as the reference has them{better}"
    n_failed = len(verdict.failures)
    return f"failed: {n_failed} difference{'s' if n_failed != 1 else ''} from the reference{better}"


def plain_lines(verdict: Verdict) -> list[str]:
    """The headline, then one line a finding, failures first."""
    return [headline(verdict), *(f"{_mark(row)} {row.where}: {_sentence(row)}" for row in _ordered(verdict))]


def markdown(verdict: Verdict) -> str:
    """A comment for a pull request: the headline, a table of findings, remarks."""
    lines = [f"**su3d-bench {headline(verdict)}**", ""]
    rows = _ordered(verdict)
    if rows:
        lines += ["| | where | reference | now | |", "|---|---|---|---|---|"]
        for row in rows[:MAX_ROWS]:
            cells = (_mark(row), row.where, _number(row, row.reference), _number(row, row.measured), row.text)
            lines.append("| " + " | ".join(map(markup_free, cells)) + " |")
        if len(rows) > MAX_ROWS:
            lines.append(f"| | and {len(rows) - MAX_ROWS} more | | | |")
        lines.append("")
    return "\n".join([*lines, *(f"- {markup_free(remark)}" for remark in verdict.remarks)]).rstrip("\n") + "\n"


def junit_xml(verdict: Verdict) -> str:
    """A test case a finding, failed or not, and one for all values that are as they were."""
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
    """Workflow commands: an error a failure, a notice an improvement; GitHub shows ten of a kind."""
    return [
        f"::{'error' if row.is_failure else 'notice'} title=su3d-bench::{_workflow(f'{row.where}: {_sentence(row)}')}"
        for row in _ordered(verdict)
    ] + [f"::notice title=su3d-bench::{_workflow(headline(verdict))}"]


def _ordered(verdict: Verdict) -> Sequence[Finding]:
    return sorted(verdict.findings, key=lambda finding: not finding.is_failure)


def _mark(finding: Finding) -> str:
    return "FAIL" if finding.is_failure else "better"


def _sentence(finding: Finding) -> str:
    if finding.reference is None and finding.measured is None:
        return finding.text
    numbers = f"{_number(finding, finding.reference)} -> {_number(finding, finding.measured)}"
    allowed = "" if not finding.tolerance else f", tolerance {100 * finding.tolerance:.4g} points"
    return f"{finding.text} ({numbers}{allowed})"


def _number(finding: Finding, value: float | None) -> str:
    """Fractions in per cent, as many digits as tell two values apart; costs as ratios."""
    if value is None:
        return NOT_MEASURED
    if finding.kind in ("cost", "missing"):
        return f"{value:.3g}"
    other = finding.measured if value == finding.reference else finding.reference
    digits = next((n for n in (1, 2, 4, 8) if other is None or f"{100 * value:.{n}f}" != f"{100 * other:.{n}f}"), 12)
    return f"{100 * value:.{digits}f}"


def _workflow(text: str) -> str:
    """Text as workflow commands take it: on one line, percent signs encoded."""
    return one_line(text).replace("%", "%25")
