"""Delay of updates of OpenSU3D by a snapshot that is computed meanwhile, with 0.5 and 5 million points in the map.

    python -m pytest benchmarks/speed/bench_snapshot.py --benchmark-only -s

The wall of ``bench_update``, and a session whose updates include perception. The benchmark is the call that forks;
printed are the updates before it, the first one after it, which copies the pages that it changes, and on the wall those
until the map is ready.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from bench_update import filled
from pytest_benchmark.fixture import BenchmarkFixture
from wall import view

import su3d_bench as su3d
from su3d_bench.core.system.timing import Timer
from su3d_bench.datasets.homes.dataset import Homes
from su3d_bench.online.snapshots import AsOf, PendingSnapshot
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.opensu3d.tracking import View
from su3d_bench.opensu3d.voxel_map import NO_INSTANCE

MAX_UPDATES = 400


@pytest.mark.parametrize("n_points", [500_000, 5_000_000])
def test_snapshot_beside_updates(benchmark: BenchmarkFixture, n_points: int) -> None:
    benchmark.group = "snapshot, fork"
    method = filled(OpenSU3D(), n_points)
    frame, detections = view()

    def update_ms() -> float:
        start = time.perf_counter()
        method.update(frame, detections, Timer())
        return (time.perf_counter() - start) * 1e3

    alone = np.median([update_ms() for _ in range(22)][2:])
    for scene_id in np.setdiff1d(method._map.ids, [NO_INSTANCE, *method._table]).tolist():
        method._table[scene_id].append(View(0, 0))  # so that all points are clustered
    calls, first, beside = [], [], []

    def fork() -> PendingSnapshot:
        start = time.perf_counter()
        pending = PendingSnapshot(method, AsOf())
        calls.append((time.perf_counter() - start) * 1e3)
        first.append(update_ms())
        return pending

    for _ in range(5):
        fork().cancel()
    pending = fork()
    while not pending.is_done and len(beside) < MAX_UPDATES:
        beside.append(update_ms())
    assert len(pending.result().prediction.points) > 0
    benchmark.pedantic(lambda: PendingSnapshot(method, AsOf()).cancel(), rounds=5)
    delay = np.median(calls) + np.median(first) - alone
    print(
        f"\n{n_points:,} points: update alone {alone:.1f} ms; fork {np.median(calls):.1f} ms, first update after it "
        f"{np.median(first):.1f} ms: delay {delay:.1f} ms; {len(beside)} updates beside it {np.median(beside):.1f} ms"
    )


def test_snapshot_in_a_session(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    benchmark.group = "snapshot, session"
    home = Homes(tmp_path)
    all_frames = home.frames("test0", 40)
    frames = [all_frames[k] for k in range(31)]
    calls, first = [], []
    with su3d.session("opensu3d", home.info("test0", 40), settings={"perception.cache": False}) as session:

        def push_ms(k: int) -> float:
            start = time.perf_counter()
            session.push(frames[k])
            return (time.perf_counter() - start) * 1e3

        push_ms(0)
        filled(session._method, 5_000_000)
        alone = np.median([push_ms(k) for k in range(1, 16)])
        for k in range(16, 31):
            start = time.perf_counter()
            pending = session.snapshot(wait=False)
            calls.append((time.perf_counter() - start) * 1e3)
            first.append(push_ms(k))
            pending.cancel()
        benchmark.pedantic(lambda: session.snapshot(wait=False).cancel(), rounds=5)
    delay = np.median(calls) + np.median(first) - alone
    print(f"\nsession, 5,000,000 points: update alone {alone:.1f} ms; delay {delay:.1f} ms")
