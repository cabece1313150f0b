"""``.sens`` recordings: results of the original readers, random access, and every kind of damage."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import outcomes, traced, truncations
from places import CASES

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import UInt8Array
from su3d_bench.datasets.scannet.sens import (
    ColourCompression,
    DepthCompression,
    SensFile,
    SensFrame,
    SensHeader,
    write_sens,
)
from su3d_bench.formats.images import UInt16Array, jpeg_bytes, png_bytes

TOY, RAW_TOY = CASES / "sens01_toy.sens", CASES / "sens02_toy_raw.sens"
WHERE = "scannet/scene0000_00"
START_OF_SIZES = 80  # in a frame record
N_HEADER = 4 + 8 + len("StructureSensor") + 256 + 8 + 16 + 4 + 8


def colour_content(rgb: UInt8Array, compression: ColourCompression) -> bytes:
    """A colour image (H, W, 3) RGB as stored in a ``.sens`` file."""
    if compression == "raw":
        return rgb.tobytes()
    return jpeg_bytes(rgb) if compression == "jpeg" else png_bytes(rgb)


def depth_content(values: UInt16Array, compression: DepthCompression) -> bytes:
    """A depth image (H, W) as stored in a ``.sens`` file."""
    raw = values.astype("<u2").tobytes()
    return zlib.compress(raw) if compression == "zlib" else raw


@pytest.fixture(scope="module")
def expected() -> dict[str, np.ndarray]:
    with np.load(CASES / "sens01_toy.npz") as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def recorded() -> dict[str, object]:
    recorded: dict[str, object] = json.loads((CASES / "sens01_toy.json").read_text())
    return recorded


def opened(path: Path, content: bytes) -> SensFile:
    path.unlink(missing_ok=True)  # some file systems wait for the disk when a file is overwritten
    path.write_bytes(content)
    return SensFile(path, WHERE)


def header(**changes: object) -> SensHeader:
    """A header for colour images of 8x6 and depth images of 4x3."""
    matrix = np.array([[10.0, 0, 3.5, 0], [0, 10.0, 2.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    base = SensHeader("Sensor", matrix, np.eye(4), matrix, np.eye(4), "jpeg", "zlib", 8, 6, 4, 3, 1000.0)
    return replace(base, **changes)  # type: ignore[arg-type]


def frames(header: SensHeader, n: int) -> Iterator[SensFrame]:
    """Frames of random images, each different."""
    rng = np.random.default_rng(0)
    for i in range(n):
        pose = np.eye(4)
        pose[:3, 3] = i
        rgb = rng.integers(0, 256, (header.colour_height, header.colour_width, 3), np.uint8)
        values = rng.integers(0, 1 << 16, (header.depth_height, header.depth_width), np.uint16)
        colour = colour_content(rgb, header.colour_compression)
        yield SensFrame(pose, 33_333 * i, 33_333 * i + 7, colour, depth_content(values, header.depth_compression))


def stored_frame(file: SensFile, i: int) -> bytes:
    """Frame ``i`` of a recording as stored."""
    pose, colour_time, depth_time = file.records()[i].tolist()[:3]
    return SensFrame(np.array(pose), colour_time, depth_time, file.colour_bytes(i), file.depth_bytes(i)).stored


# ---------------------------------------------------------------- results of the original readers


def test_toy_recording_is_read_like_the_original_readers(expected: dict[str, np.ndarray]) -> None:
    file = SensFile(TOY, WHERE)
    assert len(file) == 4
    for i in range(4):
        np.testing.assert_array_equal(file.depth(i), expected["depth"][i])
        np.testing.assert_array_equal(file.colour(i), expected["decoded_color_pil"][i])
    np.testing.assert_array_equal(file.poses(), expected["pose"])
    assert file.depth(0).dtype == np.uint16 and file.colour(0).dtype == np.uint8
    for name, key in (("intrinsic", "K"), ("extrinsic", "E")):
        for ours, theirs in (("colour", "color"), ("depth", "depth")):
            np.testing.assert_array_equal(getattr(file.header, f"{name}_{ours}"), expected[f"{key}_{theirs}"])


def test_toy_recording_has_its_time_stamps(recorded: dict[str, list[list[int]]]) -> None:
    file = SensFile(TOY, WHERE)
    records = file.records()
    assert [[row["colour_timestamp"], row["depth_timestamp"]] for row in records] == recorded["timestamps"]
    assert file.timestamp_s(1) - file.timestamp_s(0) == pytest.approx(0.033333, abs=1e-9)


@pytest.mark.parametrize("path", [TOY, RAW_TOY], ids=["jpeg", "raw"])
def test_rewritten_recording_is_identical_to_the_byte(tmp_path: Path, path: Path, recorded: dict[str, object]) -> None:
    file = SensFile(path, WHERE)
    end = path.read_bytes()[N_HEADER + sum(len(stored_frame(file, i)) for i in range(len(file))) :]
    write_sens(tmp_path / "again.sens", file.header, (stored_frame(file, i) for i in range(len(file))), end)
    content = (tmp_path / "again.sens").read_bytes()
    assert content == path.read_bytes()
    if path == TOY:
        assert hashlib.sha256(content).hexdigest() == recorded["sha256_sens"]
    assert os.listdir(tmp_path) == ["again.sens"]


# ---------------------------------------------------------------- reading and writing


@pytest.mark.parametrize("colour", ["raw", "png", "jpeg"])
@pytest.mark.parametrize("depth", ["raw", "zlib"])
def test_every_compression_round_trips(tmp_path: Path, colour: str, depth: str) -> None:
    made = header(colour_compression=colour, depth_compression=depth)
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (6, 8, 3), np.uint8)
    values = np.array([[0, 1, 255, 256], [65535, 65534, 1000, 2], [7, 8, 9, 10]], np.uint16)
    frame = SensFrame(
        np.eye(4), 0, 0, colour_content(rgb, made.colour_compression), depth_content(values, made.depth_compression)
    )
    write_sens(tmp_path / "a.sens", made, [frame.stored])
    file = SensFile(tmp_path / "a.sens", WHERE)
    np.testing.assert_array_equal(file.depth(0), values)
    if colour == "jpeg":
        stored = cv2.imdecode(np.frombuffer(frame.colour, np.uint8), cv2.IMREAD_COLOR)
        assert stored is not None
        np.testing.assert_array_equal(file.colour(0), stored[:, :, ::-1])
    else:
        np.testing.assert_array_equal(file.colour(0), rgb)


def test_frames_are_read_in_any_order_from_several_threads(tmp_path: Path) -> None:
    in_order = [frame.stored for frame in frames(header(), 12)]
    write_sens(tmp_path / "a.sens", header(), in_order)
    file, order = SensFile(tmp_path / "a.sens", WHERE), [7, 0, 11, 3, 3, 10, 1, 5]
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(lambda i: stored_frame(file, i), order)) == [in_order[i] for i in order]


# ---------------------------------------------------------------- damage


def behind_name(content: bytes, offset: int, new: bytes) -> bytes:
    """``content`` with ``new`` at ``offset`` behind the name of the sensor."""
    at = 12 + len("StructureSensor") + offset
    return content[:at] + new + content[at + len(new) :]


def test_each_header_fault_is_one_line_with_its_value(tmp_path: Path) -> None:
    toy = TOY.read_bytes()
    faults = {
        b"": "has 0 bytes, too few for a .sens file",
        struct.pack("<I", 3) + toy[4:]: "not a .sens file of version 4 (version field: 3)",
        toy[:4] + struct.pack("<Q", 10**15) + toy[12:]: "byte 4: the header with a sensor name of 1000000000000000",
        toy[: N_HEADER - 1]: "byte 4: the header with a sensor name of 15 bytes does not fit into the file",
        behind_name(toy, 256, struct.pack("<i", -1)): "colour compression -1; known: 0 (raw), 1 (png), 2 (jpeg)",
        behind_name(toy, 260, struct.pack("<i", 9)): "depth compression 9; known: 0 (raw), 1 (zlib)",
        behind_name(toy, 264, struct.pack("<2I", 2**32 - 1, 2**32 - 1)): "colour images of 4294967295x4294967295",
        behind_name(toy, 280, struct.pack("<f", float("nan"))): "the depth shift is nan",
        behind_name(toy, 284, struct.pack("<Q", 10**12)): "states 1000000000000 frames of 96 or more bytes, but only",
        behind_name(toy, 284, struct.pack("<Q", 3)): "2973 bytes follow the last frame",
        toy + b"\0": "expected none or 264 bytes of motion data in 2 records; the file is too long",
    }
    for content, message in faults.items():
        with pytest.raises(DataError) as caught:
            opened(tmp_path / "bad.sens", content)
        assert str(caught.value).startswith(f"{WHERE}: bad.sens: "), str(caught.value)
        assert message in str(caught.value), str(caught.value)


def with_frame(tmp_path: Path, **changes: bytes) -> SensFile:
    """A recording of three frames, the second with other images."""
    first, second, third = frames(header(), 3)
    changed = replace(second, **changes)  # type: ignore[arg-type]
    write_sens(tmp_path / "bad.sens", header(), [first.stored, changed.stored, third.stored])
    return SensFile(tmp_path / "bad.sens", WHERE)


def jpeg(width: int, height: int) -> bytes:
    return colour_content(np.zeros((height, width, 3), np.uint8), "jpeg")


@pytest.mark.parametrize(
    ("colour", "message"),
    [
        (b"\xff\xd8\xff" + bytes(50), "not a JPEG image"),
        (jpeg(16, 6), "is 16x6; expected 8x6, as in the header"),
        (jpeg(8, 6)[:-2], "not a readable JPEG image"),
    ],
)
def test_invalid_colour_image_is_named_with_frame_and_byte(tmp_path: Path, colour: bytes, message: str) -> None:
    file = with_frame(tmp_path, colour=colour)
    place = rf"{WHERE}: bad\.sens: frame 1 at byte \d+: colour"
    with pytest.raises(DataError, match=f"{place}.*{message}"):
        file.colour(1)
    assert file.colour(0).shape == file.colour(2).shape and file.depth(1).shape == (3, 4)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (zlib.compress(bytes(24))[:-1], "decompression stops after 24 bytes"),
        (zlib.compress(bytes(23)), "has 23 bytes, expected 24"),
        (zlib.compress(bytes(20 << 20), 9), "decompresses to more than the 24 bytes of an image"),
    ],
)
def test_invalid_depth_image_is_named_and_decompression_stops(tmp_path: Path, depth: bytes, message: str) -> None:
    file = with_frame(tmp_path, depth=depth)
    with traced(1 << 20), pytest.raises(DataError, match=rf"{WHERE}: bad\.sens: frame 1 at byte \d+: depth.*{message}"):
        file.depth(1)


def test_oversized_depth_image_is_rejected_before_it_is_read(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"frame 1 of 3 at byte \d+: images of"):
        with_frame(tmp_path, depth=bytes(2 << 20))


@pytest.mark.parametrize(
    ("at", "number"),
    [
        (START_OF_SIZES, 2**64 - 1),  # bytes of a colour image
        (START_OF_SIZES + 8, 2**63),  # of a depth image
        (-8, 2**64 - 1),  # frames
        (-8, 200),
    ],
)
def test_excessive_header_sizes_allocate_nothing(tmp_path: Path, at: int, number: int) -> None:
    toy = bytearray(TOY.read_bytes())
    toy[N_HEADER + at : N_HEADER + at + 8] = struct.pack("<Q", number)
    with traced(1 << 20), pytest.raises(DataError, match=rf"^{WHERE}: bad\.sens: "):
        opened(tmp_path / "bad.sens", bytes(toy))


def test_missing_file_folder_and_pipe_are_data_errors(tmp_path: Path) -> None:
    (tmp_path / "folder.sens").mkdir()
    os.mkfifo(tmp_path / "pipe.sens")
    for name in ("none.sens", "folder.sens", "pipe.sens"):
        with pytest.raises(DataError, match=rf"{name}: cannot be read: "):
            SensFile(tmp_path / name, WHERE)


@pytest.mark.parametrize("path", [TOY, pytest.param(RAW_TOY, marks=pytest.mark.proof)], ids=["jpeg", "raw"])
def test_recording_truncated_anywhere_is_rejected(tmp_path: Path, path: Path) -> None:
    content = path.read_bytes()
    n_read, n_refused = outcomes(
        lambda copy: opened(tmp_path / "cut.sens", copy), truncations(content), must_name=f"{WHERE}: cut.sens"
    )
    assert (n_read, n_refused) == (1, len(content) - 1)  # without the motion data block the recording is complete
