"""What the gate found: one line a difference, and what it means for the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


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
        return tuple(one for one in self.findings if one.is_failure)

    @property
    def is_passed(self) -> bool:
        return not self.failures
