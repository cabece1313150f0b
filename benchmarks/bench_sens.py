"""What reading a ``.sens`` recording costs, beside a reader that loads the whole file first.

Both decode with the same functions, so the difference is what has to be read and kept to get at a frame. One recording
has 5,000 frames of small images, the other images of ScanNet's sizes but 300 frames, to fit a temporary folder.
"""

from __future__ import annotations

import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from su3d_bench.datasets.image_files import UInt16Array, decode_colour
from su3d_bench.datasets.sens import SensFile
from su3d_bench.datasets.sens_header import SensHeader, parse_header
from su3d_bench.datasets.sens_write import SensFrame, colour_content, depth_content, write_sens
from su3d_bench.types import UInt8Array

N_DIFFERENT = 20  # images; the file repeats them
RECORD = struct.Struct("<16f4Q")


class Reader(Protocol):
    def __len__(self) -> int: ...

    def colour(self, i: int) -> UInt8Array: ...

    def depth(self, i: int) -> UInt16Array: ...


class WholeFile:
    """A recording that was read whole and cut into frames."""

    def __init__(self, path: Path, where: str) -> None:
        content = path.read_bytes()
        self._header, n_frames, at = parse_header(content, where)
        self._where, self._images = where, []
        for _ in range(n_frames):
            *_, n_colour, n_depth = RECORD.unpack_from(content, at)
            colour = content[at + RECORD.size : at + RECORD.size + n_colour]
            at += RECORD.size + n_colour + n_depth
            self._images.append((colour, content[at - n_depth : at]))

    def __len__(self) -> int:
        return len(self._images)

    def colour(self, i: int) -> UInt8Array:
        return decode_colour(self._images[i][0], self._where)

    def depth(self, i: int) -> UInt16Array:
        raw = zlib.decompress(self._images[i][1])
        return np.frombuffer(raw, "<u2").reshape(self._header.depth_height, self._header.depth_width)


READERS: dict[str, Callable[[Path, str], Reader]] = {"seeking": SensFile, "whole": WholeFile}


@dataclass(frozen=True)
class Kind:
    """A recording: frames, and width and height of its images."""

    n_frames: int
    colour: tuple[int, int]
    depth: tuple[int, int]


SMALL, FULL = Kind(5_000, (320, 240), (160, 120)), Kind(300, (1296, 968), (640, 480))


@pytest.fixture(scope="module", params=[SMALL, FULL], ids=["5000-small", "300-full"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    kind: Kind = request.param
    path = tmp_path_factory.mktemp("recording") / f"{kind.n_frames} frames of {kind.colour[0]}x{kind.colour[1]}.sens"
    matrix = np.eye(4)
    header = SensHeader("Sensor", matrix, matrix, matrix, matrix, "jpeg", "zlib", *kind.colour, *kind.depth, 1000.0)
    images = [stored_images(kind, seed) for seed in range(N_DIFFERENT)]
    write_sens(path, header, (SensFrame(matrix, i, i, *images[i % N_DIFFERENT]) for i in range(kind.n_frames)))
    yield path
    path.unlink()


def stored_images(kind: Kind, seed: int) -> tuple[bytes, bytes]:
    """Colour as JPEG and depth packed: smooth with some noise, as a camera has them."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 6, kind.colour[0]), np.linspace(0, 6, kind.colour[1]))
    waves = np.stack([np.sin(x + seed), np.cos(y * x), np.sin(y)], 2) * 90 + 128 + rng.normal(0, 8, (*x.shape, 3))
    x, y = np.meshgrid(np.linspace(0, 6, kind.depth[0]), np.linspace(0, 6, kind.depth[1]))
    depth = 2_000 + 500 * np.sin(x + y) + rng.normal(0, 3, x.shape)
    colour = colour_content(np.clip(waves, 0, 255).astype(np.uint8), "jpeg")
    return colour, depth_content(depth.astype(np.uint16), "zlib")


def read_frames(file: Reader, indices: Iterable[int]) -> None:
    for i in indices:
        file.colour(i)
        file.depth(i)


def note_memory(benchmark: BenchmarkFixture, recording: Path, reader: str, stride: int) -> None:
    """Put the file's size and the peak of the memory that the reading takes beside the times."""
    tracemalloc.start()
    file = READERS[reader](recording, "bench")
    read_frames(file, range(0, len(file), stride))
    benchmark.extra_info["peak_mb"] = round(tracemalloc.get_traced_memory()[1] / 1e6, 1)
    benchmark.extra_info["file_mb"] = round(recording.stat().st_size / 1e6, 1)
    tracemalloc.stop()


@pytest.mark.parametrize("reader", READERS)
def test_open(benchmark: BenchmarkFixture, recording: Path, reader: str) -> None:
    benchmark.group = f"{recording.stem}: open"
    benchmark.pedantic(READERS[reader], args=(recording, "bench"), rounds=10, warmup_rounds=1)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("stride", [10_000, 100, 20], ids=["the first", "every 100th", "every 20th"])
def test_open_and_read(benchmark: BenchmarkFixture, recording: Path, reader: str, stride: int) -> None:
    def open_and_read() -> None:
        file = READERS[reader](recording, "bench")
        read_frames(file, range(0, len(file), stride))

    benchmark.group = f"{recording.stem}: open and read one frame in {stride}"
    benchmark.pedantic(open_and_read, rounds=10, warmup_rounds=1)
    note_memory(benchmark, recording, reader, stride)


def test_frames_in_turn(benchmark: BenchmarkFixture, recording: Path) -> None:
    """Each frame from both readers one after the other, so that a busy machine is busy for both."""
    benchmark.group = f"{recording.stem}: 200 frames of opened recordings, by both readers in turn"
    files = {name: open_file(recording, "bench") for name, open_file in READERS.items()}
    times_ms: dict[str, list[float]] = {name: [] for name in READERS}

    def read_in_turn() -> None:
        for i in range(200):
            for name in sorted(files, reverse=i % 2 == 0):
                started = time.perf_counter()
                read_frames(files[name], [i])
                times_ms[name].append((time.perf_counter() - started) * 1e3)

    benchmark.pedantic(read_in_turn, rounds=1)
    benchmark.extra_info |= {f"{name}_ms": round(float(np.median(times)), 3) for name, times in times_ms.items()}


@pytest.mark.parametrize("n_threads", [1, 2, 4])
def test_threads_share_an_opened_recording(benchmark: BenchmarkFixture, recording: Path, n_threads: int) -> None:
    benchmark.group = f"{recording.stem}: 200 frames by threads"
    file = SensFile(recording, "bench")
    with ThreadPoolExecutor(n_threads) as pool:
        benchmark.pedantic(
            lambda: list(pool.map(lambda i: read_frames(file, [i]), range(200))), rounds=3, warmup_rounds=1
        )
