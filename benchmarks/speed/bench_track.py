"""Time to track a view of OpenSU3D as the number of instances in the map grows from 200 to 5,000.

    python -m pytest benchmarks/speed/bench_track.py --benchmark-only

A 1200x680 image of 24 masks at 1.5 to 3.5 m, whose instances are always in the map. The others are plates of 0.2 m with
100 points: ``elsewhere``, or ``in the box`` of the view's points, where no pixel sees them. A round is three updates
per size, in random order; the exponent and its 95 % interval are of the shortest stage ``track`` of the three.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from wall import VOXEL_M, view

from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame
from su3d_bench.numerics.statistics import growth_exponent
from su3d_bench.opensu3d.pipeline import OpenSU3D

SIZES = np.geomspace(200, 5000, 12).astype(int)
ROUNDS = 20
PLATE = (np.stack(np.meshgrid(np.arange(10), np.arange(10), [0]), axis=-1).reshape(-1, 3) + 0.5) * VOXEL_M


def masks_at_several_distances() -> tuple[Frame, Detections]:
    frame, detections = view()
    depth_m = np.full_like(frame.depth_m, 1.5)
    depth_m[detections.masks[::8].any(axis=0)] = 3.5
    return replace(frame, depth_m=depth_m), detections


def filled(n_instances: int, shift_m: float, frame: Frame, detections: Detections) -> OpenSU3D:
    """The view's instances, then the others: plates at 1.7 to 3.3 m, shifted sideways."""
    method = OpenSU3D()
    method.update(frame, detections, Timer())
    generator = np.random.default_rng(0)
    for one in range(method._next_id, n_instances + 1):
        corner = generator.uniform((-1.4, -0.7, 1.7), (1.2, 0.5, 3.3))
        method._map.insert(PLATE + corner + [shift_m * one, 0, 0], np.full(len(PLATE), one, np.int32))
    method._next_id = n_instances + 1
    return method


@pytest.mark.parametrize(("where", "shift_m"), [("elsewhere", 10.0), ("in the box", 0.0)])
def test_track(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture[str], where: str, shift_m: float) -> None:
    benchmark.group = "36 updates of maps of 200 to 5,000 instances"
    frame, detections = masks_at_several_distances()
    methods = [filled(n, shift_m, frame, detections) for n in SIZES]
    generator = np.random.default_rng(0)
    sizes, track_ms = list[int](), list[float]()

    def one_round() -> None:
        for k in generator.permutation(len(SIZES)):
            timers = [Timer() for _ in range(3)]
            for timer in timers:
                methods[k].update(frame, detections, timer)
            sizes.append(SIZES[k])
            track_ms.append(min(timer.take()["track"] for timer in timers))

    benchmark.pedantic(one_round, rounds=ROUNDS, warmup_rounds=1)
    assert [method.n_instances for method in methods] == SIZES.tolist()  # every mask got its instance again
    if benchmark.stats is None:  # one round without timing
        return
    x, y = (np.array(values[len(SIZES) :], np.float64) for values in (sizes, track_ms))
    growth = growth_exponent(x, y)
    assert growth is not None
    found = {f"track, {n:,} instances": f"{np.median(y[x == n]):.2f} ms" for n in (SIZES[0], SIZES[-1])}
    found["exponent"] = f"{growth.exponent:z.2f} [{growth.low:z.2f}, {growth.high:z.2f}]"
    benchmark.extra_info |= found
    with capsys.disabled():
        print(f"\n{where}: {found}")
