"""Cost of rendering a frame of 640 x 480: a home with four samples per pixel, mirrors and glass, beside a room.

``python -m pytest benchmarks/speed/bench_rendering.py --benchmark-only --benchmark-group-by=group``, two minutes. Both
are rendered at the same number of evenly spaced frames of their trajectories; the target is 1.5 times the room's time.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from su3d_bench.datasets.homes.dataset import Homes
from su3d_bench.datasets.procedural.dataset import GeneratedScenes
from su3d_bench.datasets.rooms.dataset import Rooms

N_FRAMES = 20
SCENES = {"room": (Rooms, "living0"), "home": (Homes, "test1")}


@pytest.mark.benchmark(group="rendering a frame")
@pytest.mark.parametrize("kind", SCENES)
def test_rendering(kind: str, benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    make, scene = SCENES[kind]
    dataset: GeneratedScenes = make(tmp_path)
    built = dataset.built(scene)
    poses = built.trajectory[:: len(built.trajectory) // N_FRAMES]
    built.renderer.render(poses[0])  # compiles

    def render() -> None:
        for pose in poses:
            built.renderer.render(pose)

    benchmark.pedantic(render, rounds=3)
    if benchmark.stats is not None:
        benchmark.extra_info["ms per frame"] = round(1000 * benchmark.stats.stats.median / len(poses), 1)
