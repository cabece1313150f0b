"""What a method costs, as the gate judges it: its whole wall time, measured around it, over a fixed piece of work.

Perception is what the harness ran between the method's calls or for it; how a method calls its own stages is not asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import counted, printable
from su3d_bench.metrics.costs import MAP, WARM_UP, UpdateTimes
from su3d_bench.reports.gate import Compared, Finding
from su3d_bench.runs.finished import FinishedRun, read_update_times

# Where the calibrating work itself takes so many times the reference's on the same kind of processor, others used it,
# or what is checked slows it: which of them, nobody can tell from inside, so that it excuses a method so far only.
BUSY = 1.5
MOST_EXCUSED = 2.0
MOST = 1e12  # calibrating pieces of work: many years
# A part of the whole time must grow by more than this share of all, and by more than one calibrating piece of work: a
# single call that waited for the processor shows no cost.
LEAST_SHARE = 0.05
LEAST = 1.0

Part = Literal["start", "updates", "finish", "whole"]
SHOWN: Mapping[Part, str] = {
    "start": f"start and the first {WARM_UP} updates",
    "updates": f"the updates after {WARM_UP}",
    "finish": "finish",
    "whole": "all together",
}


class Cost(BaseModel):
    """Times of a method over all scenes, over the calibrating piece of work of each.

    ``start``: before the fourth update, what the method did before the first included; ``updates``: the others, as
    their median times their number; ``finish``: every map and what follows; ``whole``: everything, no median taken.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: float = Field(ge=0, le=MOST, allow_inf_nan=False)
    updates: float = Field(ge=0, le=MOST, allow_inf_nan=False)
    finish: float = Field(ge=0, le=MOST, allow_inf_nan=False)
    whole: float = Field(gt=0, le=MOST, allow_inf_nan=False)

    @classmethod
    def middle(cls, costs: list[Cost]) -> Cost:
        """The median of the costs of repeats, part by part."""
        return cls(**{part: float(np.median([getattr(cost, part) for cost in costs])) for part in SHOWN})


def method_cost(run: FinishedRun, method: str, most_calibration_ms: float = np.inf) -> Cost | None:
    """The cost of a method over the scenes with enough updates; None where ``why_no_cost`` says so.

    ``most_calibration_ms``: more than that of the calibrating work is not believed.
    """
    if why_no_cost(run, method) is not None:
        return None
    timed = [times for times in read_update_times(run, method) if len(times) > WARM_UP]
    scenes = [_of_scene(times, most_calibration_ms) for times in timed]
    return Cost(**{part: min(sum(scene[part] for scene in scenes), MOST) for part in SHOWN})


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
        "whole": times.start_ms + ms.sum() + finish_ms,
    }
    return {part: float(value) / unit_ms for part, value in parts.items()}


def why_no_cost(run: FinishedRun, method: str) -> str | None:
    """Why a run says nothing of the cost of ``method``; None where it does."""
    if method in run.made_elsewhere:
        return "was made elsewhere and brings no times"
    timed = read_update_times(run, method)
    n_most = max((len(times) for times in timed), default=0)
    if n_most <= WARM_UP:
        what = f"has {counted(n_most, 'update')} a scene at most" if n_most else "looks at no frame"
        return f"{what}, and a cost is learnt from {WARM_UP + 1} on"
    measured = [times for times in timed if len(times) > WARM_UP]
    if any("method_ms" not in times.columns or None in (times.start_ms, times.close_ms) for times in measured):
        return "was timed by an older version, which did not measure around the method; run it again"
    if not all(times.calibration_ms and times.maps for times in measured):
        return "was run without the calibrating work; run it again"
    return None if any(times.ms(MAP).any() for times in measured) else "took no time at all"


def calibration_of(run: FinishedRun) -> float | None:
    """Median milliseconds of the calibrating work over scenes and methods; None where nothing was updated."""
    every = [times.calibration_ms for method in run.methods for times in read_update_times(run, method)]
    known = [milliseconds for milliseconds in every if milliseconds]
    return float(np.median(known)) if known else None


def cost_findings(
    run: FinishedRun, costs: Mapping[str, Cost], calibration_ms: float | None, limit: float, *, is_judged: bool
) -> Iterator[Finding]:
    """What costs more than ``limit`` times the reference's ``costs``; of each method whether the run measured it."""
    for method, before in costs.items():
        where = f"{printable(method, 80)} / cost"
        if method not in run.methods:
            yield Finding("missing", where, "the run does not have this method")
            continue
        if (reason := why_no_cost(run, method)) is not None:
            yield Finding("missing", where, f"the run did not measure it: it {reason}")
            continue
        now = method_cost(run, method, np.inf if calibration_ms is None else MOST_EXCUSED * calibration_ms)
        if is_judged and now is not None:
            yield from _dearer(where, before, now, limit)


def cost_numbers(
    run: FinishedRun, costs: Mapping[str, Cost], calibration_ms: float | None, limit: float
) -> Iterator[Compared]:
    """Each part of the cost of every method that the run measured, beside the reference's."""
    most = np.inf if calibration_ms is None else MOST_EXCUSED * calibration_ms
    for method, before in costs.items():
        now = method_cost(run, method, most) if method in run.methods else None
        if now is not None:
            where = f"{printable(method, 80)} / cost"
            for part, shown in SHOWN.items():
                yield Compared(where, shown, getattr(before, part), getattr(now, part), times=limit)


def _dearer(where: str, before: Cost, now: Cost, limit: float) -> Iterator[Finding]:
    for part, shown in SHOWN.items():
        was, cost = getattr(before, part), getattr(now, part)
        least = LEAST if part == "whole" else max(LEAST, LEAST_SHARE * before.whole)
        if cost > limit * was and cost - was > least:
            times = f"{cost / was:.2f} times" if was else "what was nothing in"
            text = f"costs {times} the reference; {limit:g} times are allowed"
            yield Finding("cost", f"{where} of {shown}", text, was, cost)


def busy_remark(run: FinishedRun, calibration_ms: float | None) -> str | None:
    """That the calibrating work was slow; None where it was not."""
    now = calibration_of(run)
    if now is None or calibration_ms is None or now <= BUSY * calibration_ms:
        return None
    return (
        f"the calibrating work took {now:.3g} ms, {now / calibration_ms:.1f} times the reference's: others used "
        f"the processor, or what is checked slows it; that excuses {MOST_EXCUSED:g} times the cost at most"
    )
