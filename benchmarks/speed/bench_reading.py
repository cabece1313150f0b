"""Cost of reading a frame: one of Replica's, and recordings in ScanNet's ``.sens`` format.

``python -m pytest benchmarks/speed/bench_reading.py --benchmark-only --benchmark-group-by=group``, one minute and 50 MB
of disk. Ours reads as in a run, with two threads ahead of the consumer. Compared with, in one thread: for
Replica, OpenCV's plain reading of both files; for ``.sens``, a reader that loads it whole like ScanNet's published
Python reader (SensReader/python/SensorData.py at commit 0459a70: struct for each byte, zlib, Pillow under
imageio), and the fastest simple one: it slices the file and decodes with OpenCV. All readers decode the same images
in full. ``peak_mb`` is the peak of Python and NumPy memory, including the file in memory.
"""

from __future__ import annotations

import io
import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pytest_benchmark.fixture import BenchmarkFixture
from replica_files import SCALE, write_replica

from su3d_bench.core.system.timing import calibration_ms
from su3d_bench.core.types import Float32Array, Frame, UInt8Array
from su3d_bench.datasets.replica.frames import ReplicaFrames
from su3d_bench.datasets.rooms.dataset import RoomOptions, Rooms
from su3d_bench.datasets.scannet.sens import FRAME_RECORD, SensFile, SensFrame, SensHeader, header_bytes, write_sens
from su3d_bench.formats.images import jpeg_bytes
from su3d_bench.runs.frame_loop import ReadAhead

Images = tuple[UInt8Array, np.ndarray]  # colour (H, W, 3) and depth (H, W) of a frame
N_REPLICA, N_SENS, N_DIFFERENT = 24, 48, 6  # frames to read; distinct images
UPDATE_S = 0.06  # of a map
N_LONG = 5_578  # frames of scene0000_00
LONG_STRIDE = 100
COLOUR, DEPTH = (1296, 968), (640, 480)  # ScanNet's sizes
IDENTITY = np.eye(4)
HEADER = SensHeader("StructureSensor", IDENTITY, IDENTITY, IDENTITY, IDENTITY, "jpeg", "zlib", *COLOUR, *DEPTH, 1000.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("replica")


@pytest.fixture(scope="module")
def replica(folder: Path) -> ReplicaFrames:
    """Frames of a room at Replica's size, in its files."""
    room = Rooms(folder, RoomOptions(width=1200, height=680, n_frames=800))
    views = room.frames("living0", 800 // N_DIFFERENT)
    return write_replica(folder, [views[i] for i in range(N_DIFFERENT)], N_REPLICA)


class PlainReplica(Sequence[tuple[UInt8Array, Float32Array]]):
    """The same files, read as by most programs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __len__(self) -> int:
        return N_REPLICA

    def __getitem__(self, i: int) -> tuple[UInt8Array, Float32Array]:  # type: ignore[override]
        import cv2

        bgr = cv2.imread(str(self._folder / f"results/frame{i:06d}.jpg"))
        depth = cv2.imread(str(self._folder / f"results/depth{i:06d}.png"), cv2.IMREAD_UNCHANGED)
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), depth.astype(np.float32) / SCALE


def read_ahead(frames: Sequence[Frame] | Sequence[Images], n_threads: int) -> None:
    with ReadAhead(frames, len(frames), n_threads=n_threads) as ahead:
        for _ in range(len(frames)):
            ahead.next_frame()


def read_all(frames: Sequence[object]) -> None:
    for i in range(len(frames)):
        frames[i]


@pytest.mark.parametrize("how", ["plain imread, 1 thread", "ours, 1 thread", "ours, 2 threads ahead"])
def test_replica_frames(benchmark: BenchmarkFixture, folder: Path, replica: ReplicaFrames, how: str) -> None:
    benchmark.group = f"{N_REPLICA} Replica frames of 1200x680, JPEG and 16-bit PNG"
    benchmark.name = how
    plain = PlainReplica(folder)
    work: dict[str, Callable[[], None]] = {
        "plain imread, 1 thread": lambda: read_all(plain),
        "ours, 1 thread": lambda: read_all(replica),
        "ours, 2 threads ahead": lambda: read_ahead(replica, 2),
    }
    benchmark.pedantic(work[how], rounds=7, warmup_rounds=1)
    if not benchmark.stats:  # with --benchmark-disable
        return
    benchmark.extra_info["ms_per_frame"] = round(benchmark.stats["median"] / N_REPLICA * 1e3, 2)
    benchmark.extra_info["best_ms"] = round(benchmark.stats["min"] / N_REPLICA * 1e3, 2)


def test_what_an_update_waits_for_its_frame(benchmark: BenchmarkFixture, replica: ReplicaFrames) -> None:
    """Between two frames the calling thread sorts and sums, for the duration of a slow map update."""
    benchmark.group = f"{N_REPLICA} Replica frames of 1200x680 read ahead of a pipeline"
    benchmark.name = "frames and updates"
    waits_ms: list[float] = []

    def run() -> None:
        with ReadAhead(replica, N_REPLICA) as ahead:
            for _ in range(N_REPLICA):
                started = time.perf_counter()
                ahead.next_frame()
                waits_ms.append((time.perf_counter() - started) * 1e3)
                while time.perf_counter() - started < waits_ms[-1] / 1e3 + UPDATE_S:
                    calibration_ms()

    benchmark.pedantic(run, rounds=3, warmup_rounds=1)
    benchmark.extra_info["update_ms"] = UPDATE_S * 1e3
    benchmark.extra_info["median_wait_ms"] = round(float(np.median(waits_ms)), 2)


@dataclass(frozen=True)
class Stored:
    """One frame as stored by a whole-file reader."""

    colour: bytes
    depth: bytes


HEADER_PARTS = struct.Struct("<IQ"), struct.Struct("<64f2i4IfQ")


class PublishedReader:
    """Reads everything at once, byte by byte through ``struct``; decoding by Pillow."""

    def __init__(self, path: Path) -> None:
        self.frames: list[Stored] = []
        with path.open("rb") as file:
            for _ in range(_n_frames(file)):
                np.asarray(struct.unpack("f" * 16, file.read(64)), dtype=np.float32).reshape(4, 4)
                struct.unpack("2Q", file.read(16))
                n_colour, n_depth = struct.unpack("2Q", file.read(16))
                colour = b"".join(struct.unpack("c" * n_colour, file.read(n_colour)))
                depth = b"".join(struct.unpack("c" * n_depth, file.read(n_depth)))
                self.frames.append(Stored(colour, depth))

    def images(self, i: int) -> Images:
        colour = np.asarray(Image.open(io.BytesIO(self.frames[i].colour)))
        return colour, np.frombuffer(zlib.decompress(self.frames[i].depth), np.uint16).reshape(DEPTH[::-1])


class SlicingReader:
    """Reads everything at once and cuts it into frames; decoding by OpenCV."""

    def __init__(self, path: Path) -> None:
        self.frames: list[Stored] = []
        with path.open("rb") as file:
            n = _n_frames(file)
            content = file.read()
        at = 0
        for _ in range(n):
            n_colour, n_depth = struct.unpack_from("2Q", content, at + 80)
            middle = at + 96 + n_colour
            self.frames.append(Stored(content[at + 96 : middle], content[middle : middle + n_depth]))
            at = middle + n_depth

    def images(self, i: int) -> Images:
        import cv2

        bgr = cv2.imdecode(np.frombuffer(self.frames[i].colour, np.uint8), cv2.IMREAD_COLOR)
        depth = np.frombuffer(zlib.decompress(self.frames[i].depth), np.uint16).reshape(DEPTH[::-1])
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), depth


def _n_frames(file: io.BufferedReader) -> int:
    start, rest = HEADER_PARTS
    _, n_name = start.unpack(file.read(start.size))
    file.read(n_name)
    return int(rest.unpack(file.read(rest.size))[-1])


class Chosen(Sequence[Images]):
    """The images of frames ``indices`` of an open recording."""

    def __init__(self, file: SensFile, indices: Sequence[int]) -> None:
        self._file, self._indices = file, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> Images:  # type: ignore[override]
        i = self._indices[position]
        return self._file.colour(i), self._file.depth(i)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    path = tmp_path_factory.mktemp("recording") / "scan.sens"
    images = [stored_images(seed) for seed in range(N_DIFFERENT)]
    write_sens(path, HEADER, (SensFrame(IDENTITY, i, i, *images[i % N_DIFFERENT]).stored for i in range(N_SENS)))
    yield path
    path.unlink()


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """As many frames as scene0000_00; images that will not be read are holes in the file."""
    path = tmp_path_factory.mktemp("recording") / "long.sens"
    colour, depth = stored_images(0)
    record = np.zeros((), FRAME_RECORD)
    record["camera_to_world"], record["colour_bytes"], record["depth_bytes"] = IDENTITY, len(colour), len(depth)
    with path.open("wb") as file:
        file.write(header_bytes(HEADER, N_LONG))
        for i in range(N_LONG):
            file.write(record.tobytes())
            if i % LONG_STRIDE == 0:
                file.write(colour + depth)
            else:
                file.seek(len(colour) + len(depth), io.SEEK_CUR)
        file.truncate()
    yield path
    path.unlink()


def stored_images(seed: int) -> tuple[bytes, bytes]:
    """Smooth images with a little noise: about half a megabyte per frame, as in ScanNet's recordings on average."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 6, COLOUR[0]), np.linspace(0, 6, COLOUR[1]))
    waves = np.stack([np.sin(x + seed), np.cos(y * x), np.sin(y)], 2) * 90 + 128 + rng.normal(0, 3, (*x.shape, 3))
    x, y = np.meshgrid(np.linspace(0, 6, DEPTH[0]), np.linspace(0, 6, DEPTH[1]))
    depth = 2_000 + 500 * np.sin(x + y) + rng.normal(0, 1, x.shape)
    colour = jpeg_bytes(np.clip(waves, 0, 255).astype(np.uint8))
    return colour, zlib.compress(depth.astype("<u2").tobytes())


def with_published(path: Path, indices: Iterable[int]) -> None:
    file = PublishedReader(path)
    for i in indices:
        file.images(i)


def with_slicing(path: Path, indices: Iterable[int]) -> None:
    file = SlicingReader(path)
    for i in indices:
        file.images(i)


def with_ours(path: Path, indices: range) -> None:
    read_ahead(Chosen(SensFile(path, "bench"), indices), 2)


READERS: dict[str, Callable[[Path, range], None]] = {
    "ours, 2 threads ahead": with_ours,
    "whole file, as published": with_published,
    "whole file, sliced, OpenCV": with_slicing,
}


def test_the_readers_agree(recording: Path) -> None:
    """The published reader uses another JPEG decoder: colours may differ by rounding, depth may not."""
    ours, published, sliced = SensFile(recording, "bench"), PublishedReader(recording), SlicingReader(recording)
    assert np.array_equal(ours.colour(7), sliced.images(7)[0])
    assert np.abs(ours.colour(7).astype(int) - published.images(7)[0]).max() <= 8
    assert np.array_equal(ours.depth(7), sliced.images(7)[1])
    assert np.array_equal(ours.depth(7), published.images(7)[1])


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("stride", [1, 10, 20])
def test_sens(benchmark: BenchmarkFixture, recording: Path, reader: str, stride: int) -> None:
    indices = range(0, N_SENS, stride)
    what = "every frame" if stride == 1 else f"one frame in {stride}"
    benchmark.group = f".sens, {N_SENS} frames of 1296x968 and 640x480: open and read {what}"
    benchmark.name = reader
    benchmark.extra_info |= peaks(recording, lambda: READERS[reader](recording, indices))
    benchmark.pedantic(READERS[reader], args=(recording, indices), rounds=3)


def test_long_sens(benchmark: BenchmarkFixture, long_recording: Path) -> None:
    """Reports memory: a reader that loads the whole file would need the size of the file."""
    indices = range(0, N_LONG, LONG_STRIDE)
    benchmark.group = f".sens, {N_LONG} frames of 1296x968 and 640x480: open and read one frame in {LONG_STRIDE}"
    benchmark.name = "ours, 2 threads ahead"
    benchmark.extra_info |= peaks(long_recording, lambda: with_ours(long_recording, indices))
    benchmark.pedantic(with_ours, args=(long_recording, indices), rounds=3)


def peaks(path: Path, read: Callable[[], None]) -> dict[str, float]:
    """The peak memory of ``read``, apart from the size of the file; also serves as warm-up."""
    tracemalloc.start()
    read()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"peak_mb": round(peak / 1e6, 1), "file_mb": round(path.stat().st_size / 1e6, 1)}
