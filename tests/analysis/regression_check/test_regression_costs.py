"""Regression check of costs: all time of a method is measured, wherever it is spent."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import pytest
from painted import Collector
from painted_runs import see_painted
from places import SCENES

from su3d_bench.analysis.regression_check import (
    MIN_SHARE,
    Cost,
    Reference,
    check,
    compare_costs,
    learn,
)
from su3d_bench.cli.main import main
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.maps import Prediction
from su3d_bench.core.system.timing import MethodClock
from su3d_bench.core.types import Detections, Frame, SceneInfo
from su3d_bench.runs.finished import read_run, read_update_times

WORDS = ["run", "--scenes", f"{SCENES}/painted.py:Painted/a", "--methods", f"{__file__}:Delayed"]
WORDS += ["--protocols", "rooms-semantic", "--no-pictures", "--jobs", "1"]
DELAY_S = 0.15


class Delayed(Collector):
    """A collector that takes ``DELAY_S`` longer at the place given in the environment, with the same name and numbers.

    The costs that it reports itself are wrong.
    """

    name = "delayed"

    def __init__(self, config: Collector.Config) -> None:
        super().__init__(config)
        self._n_updates = 0
        self._delayed("made")

    def _delayed(self, where: str) -> None:
        if os.environ.get("PAINTED_DELAY") == where:
            time.sleep(DELAY_S)

    def start(self, scene: SceneInfo) -> None:
        super().start(scene)
        self._delayed("start")

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        super().update(frame, detections, timer)
        self._n_updates += 1
        self._delayed("outside")
        if self._n_updates <= 3:
            self._delayed("first")
        with timer.stage("segment"):
            self._delayed("named")

    def finish(self) -> Prediction:
        self._delayed("finish")
        return super().finish()

    @property
    def finish_costs(self) -> dict[str, float | int]:
        return {"finish_ms": 0.0, "n_things": 7}

    @property
    def losses(self) -> dict[str, int]:
        return {"frame": 0, "method_ms": 0, "n_lost": 3}

    def close(self) -> None:
        self._delayed("close")


def made_in(folder: Path, *words: str, delay: str = "") -> Path:
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        patch.setenv("PAINTED_DELAY", delay)
        assert main([*WORDS, *words, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_in(tmp_path_factory.mktemp("costs") / "run")


@pytest.fixture(scope="module")
def reference(made: Path) -> Reference:
    """The reference learned from the run, but with costs of an idle machine."""
    learnt = learn([read_run(made)], cost_limit=10.0)
    costs = {method: Cost(start=0.1, updates=0.1, finish=0.1, total=0.3) for method in learnt.costs}
    return learnt.model_copy(update={"costs": costs})


PLACES = {
    "outside": "updates after the first 3",
    "start": "start and first 3 updates",
    "finish": "finish",
}


@pytest.mark.parametrize("where", PLACES)
def test_cost_is_found_wherever_the_method_spends_it(where: str, tmp_path: Path, reference: Reference) -> None:
    run = read_run(made_in(tmp_path / "run", delay=where))
    found = [one for one in check(run, reference).findings if one.kind == "cost"]
    assert f"delayed / cost of {PLACES[where]}" in {one.where for one in found}
    (times,) = read_update_times(run, "delayed")
    of_maps = sum(one.finish_ms for one in times.maps)
    whole_ms = (times.start_ms or 0) + times.ms("map").sum() + of_maps + (times.close_ms or 0)
    assert whole_ms > 1e3 * DELAY_S


def test_requested_perception_time_is_excluded_except_in_other_threads() -> None:
    ready = threading.Event()
    clock = MethodClock()
    with clock.running("update"):
        with clock.perception():
            ready.wait(0.05)
        other = threading.Thread(target=lambda: _asked(clock, ready))
        other.start()
        other.join()
    spent = clock.take("update")
    assert spent.perception_ms >= 45
    assert spent.method_ms >= 45
    assert spent.total_ms == pytest.approx(spent.method_ms + spent.perception_ms)
    with clock.perception():
        pass
    assert clock.take("update").total_ms == 0


def _asked(clock: MethodClock, ready: threading.Event) -> None:
    with clock.perception():
        ready.wait(0.05)


COST = Cost(start=10, updates=100, finish=40, total=150)


def dearer(limit: float = 1.5, **parts: float) -> list[str]:
    """The parts of a cost that fail."""

    class Run:
        methods = ("m",)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("su3d_bench.analysis.regression_check.no_cost_reason", lambda run, method: None)
        patch.setattr("su3d_bench.analysis.regression_check.method_cost", lambda *_: COST.model_copy(update=parts))
        found, _ = compare_costs(Run(), {"m": COST}, 1.0, limit)  # type: ignore[arg-type]
    return [one.where.partition("cost of ")[2] for one in found]


def test_every_part_is_compared_with_the_limit_separately() -> None:
    assert dearer() == []
    assert dearer(updates=150, total=200) == []  # exactly the limit
    assert dearer(updates=151, total=201) == ["updates after the first 3"]
    assert dearer(finish=61, total=171) == ["finish"]
    assert dearer(total=226) == ["all stages"]
    assert dearer(updates=1000, total=1050) == ["updates after the first 3", "all stages"]


def test_growth_of_a_part_below_5_percent_of_the_total_is_ignored() -> None:
    least = MIN_SHARE * COST.total
    assert dearer(start=10 + least, total=157.5) == []
    assert dearer(start=10 + least + 0.1, total=157.6) == ["start and first 3 updates"]
    assert dearer(1.001, total=151) == []
    assert dearer(1.001, total=151.1) == ["all stages"]
