"""Time of the embedded profile for a frame of 640x480, and its encoder in batches and image by image.

``python -m pytest benchmarks/speed/bench_perception.py --benchmark-only --benchmark-group-by=group``, one minute.
Numerical libraries run on one thread, as in a run.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from replica_files import write_replica

from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Frame
from su3d_bench.datasets.replica.frames import ReplicaFrames
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.perception.embedded.encoder import IMAGE_SIZE, EmbeddedEncoder
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception
from su3d_bench.runs.executors import one_thread
from su3d_bench.runs.frame_loop import ReadAhead

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


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, frames: list[Frame]) -> ReplicaFrames:
    return write_replica(tmp_path_factory.mktemp("files"), frames, N_FRAMES)


def note_rate(benchmark: BenchmarkFixture) -> None:
    if not benchmark.stats:  # with --benchmark-disable
        return
    benchmark.extra_info["frames_per_second"] = round(N_FRAMES / benchmark.stats["median"], 2)
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


def test_perception_of_files_read_ahead(
    benchmark: BenchmarkFixture, files: ReplicaFrames, perception: Perception
) -> None:
    """As in a run on recordings: two threads read the next frames meanwhile, here JPEG and 16-bit PNG."""
    benchmark.group = f"Embedded profile, {N_FRAMES} frames of 640x480"

    def perceive() -> None:
        with ReadAhead(files, N_FRAMES) as ahead:
            for _ in range(N_FRAMES):
                perception.detect(ahead.next_frame(), NEEDS, Timer())

    benchmark.pedantic(perceive, rounds=5, warmup_rounds=1)
    note_rate(benchmark)


def test_rendering_and_perception_of_a_room(benchmark: BenchmarkFixture, room: Rooms, perception: Perception) -> None:
    """As in a run on rooms: each frame is rendered on access."""
    benchmark.group = f"Embedded profile, {N_FRAMES} frames of 640x480"
    rendered = room.frames("living0", 1600 // N_FRAMES)

    def perceive() -> None:
        for i in range(N_FRAMES):
            perception.detect(rendered[i], NEEDS, Timer())

    benchmark.pedantic(perceive, rounds=5, warmup_rounds=1)
    note_rate(benchmark)


def test_perception_from_the_cache(
    benchmark: BenchmarkFixture, tmp_path: Path, room: Rooms, frames: list[Frame]
) -> None:
    benchmark.group = f"Embedded profile, {N_FRAMES} frames of 640x480"
    scene = room.info("living0", 1)
    cached = build_perception("embedded", PerceptionConfig(), scene=scene, cache_root=tmp_path, mesh=None)

    def perceive() -> None:
        for frame in frames:
            cached.detect(frame, NEEDS, Timer())

    benchmark.pedantic(perceive, rounds=5, warmup_rounds=1)
    note_rate(benchmark)


@pytest.mark.parametrize("n", [1, 32], ids=["one by one", "32 together"])
def test_encoder(benchmark: BenchmarkFixture, n: int) -> None:
    benchmark.group = "Embedded encoder, 64 crops"
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (64, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
    log_sizes = rng.normal(0, 1, (64, 2)).astype(np.float32)
    benchmark.pedantic(EmbeddedEncoder()._in_batches, args=(pixels, log_sizes, n), rounds=10, warmup_rounds=1)
