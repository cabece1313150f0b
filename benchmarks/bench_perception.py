"""What the embedded profile takes for a frame of 640x480, and its encoder in batches beside one image at a time.

``python -m pytest benchmarks/bench_perception.py --benchmark-only --benchmark-group-by=group``, half a minute. Nothing
comes from the perception cache; numerical libraries run on one thread, as in a run.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from su3d_bench.datasets.rooms import RoomOptions, Rooms
from su3d_bench.executors import one_thread
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.perception.embedded_encoder import IMAGE_SIZE, EmbeddedEncoder
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception
from su3d_bench.read_ahead import ReadAhead
from su3d_bench.timing import Timer
from su3d_bench.types import Frame

N_FRAMES = 8
NEEDS = OpenSU3D(OpenSU3D.Config()).needs


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    return Rooms(tmp_path_factory.mktemp("rooms"), RoomOptions(n_frames=1600))


@pytest.fixture(scope="module")
def frames(room: Rooms) -> list[Frame]:
    return list(room.frames("living0", 1600 // N_FRAMES))


@pytest.fixture(scope="module")
def perception(room: Rooms, frames: list[Frame]) -> Perception:
    config = PerceptionConfig(cache=False)
    made = build_perception("embedded", config, scene=room.info("living0", 1), cache_root=Path(), mesh=None)
    made.detect(frames[0], NEEDS, Timer())  # compiled, loaded
    return made


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_thread():
        yield


def note_rate(benchmark: BenchmarkFixture) -> None:
    benchmark.extra_info["frames_a_second"] = round(N_FRAMES / benchmark.stats["median"], 2)
    benchmark.extra_info["at_best"] = round(N_FRAMES / benchmark.stats["min"], 2)


def test_perception_of_frames_in_memory(
    benchmark: BenchmarkFixture, frames: list[Frame], perception: Perception
) -> None:
    benchmark.group = f"Embedded profile, {N_FRAMES} frames of 640x480"

    def perceive() -> None:
        for frame in frames:
            perception.detect(frame, NEEDS, Timer())

    benchmark.pedantic(perceive, rounds=5, warmup_rounds=1)
    note_rate(benchmark)


def test_perception_of_rendered_frames_read_ahead(
    benchmark: BenchmarkFixture, room: Rooms, perception: Perception
) -> None:
    """As in a run: two threads render the next frames meanwhile."""
    benchmark.group = f"Embedded profile, {N_FRAMES} frames of 640x480"
    rendered = room.frames("living0", 1600 // N_FRAMES)

    def perceive() -> None:
        with ReadAhead(rendered, N_FRAMES) as ahead:
            for _ in range(N_FRAMES):
                perception.detect(ahead.next_frame(), NEEDS, Timer())

    benchmark.pedantic(perceive, rounds=5, warmup_rounds=1)
    note_rate(benchmark)


@pytest.mark.parametrize("n", [1, 32], ids=["one by one", "32 together"])
def test_encoder(benchmark: BenchmarkFixture, n: int) -> None:
    benchmark.group = "Embedded encoder, 64 crops"
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (64, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
    log_sizes = rng.normal(0, 1, (64, 2)).astype(np.float32)
    benchmark.pedantic(EmbeddedEncoder()._in_batches, args=(pixels, log_sizes, n), rounds=10, warmup_rounds=1)
