"""The three formats of ScanNet++'s ``depth.bin``, and LZ4 blocks written by the package of that name."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from places import CASES

from su3d_bench.core.errors import DataError
from su3d_bench.datasets.scannetpp.images import DepthFile, NotLz4, millimetres, unpacked_block

CASE = json.loads((CASES / "scannetpp_lz4.json").read_text())
SHAPE = (192, 256)


def image(number: int) -> np.ndarray:
    values = np.arange(SHAPE[0] * SHAPE[1], dtype=np.uint16).reshape(SHAPE) % np.uint16(5000)
    return values + np.uint16(number)


def raw(content: bytes) -> bytes:
    pack = zlib.compressobj(wbits=-15)
    return pack.compress(content) + pack.flush()


def opened(path: Path, content: bytes, n: int = 4) -> DepthFile:
    path.write_bytes(content)
    return DepthFile(path, "here", frozenset(range(n)))


@pytest.mark.parametrize("case", [*CASE["blocks"], CASE["image"]])
def test_lz4_blocks_of_the_package_are_unpacked(case: tuple[str, int, int]) -> None:
    block, n_bytes, checksum = base64.b64decode(case[0]), case[1], case[2]
    assert zlib.crc32(unpacked_block(block, n_bytes)) == checksum
    for wrong in (n_bytes - 1, n_bytes + 1):
        with pytest.raises(NotLz4):
            unpacked_block(block, wrong)


@pytest.mark.parametrize("block", [b"", b"\xf0", b"\x10", b"\x04a\x00\x00", b"\x14a\x02\x00", b"\xff" * 40])
def test_invalid_block_is_rejected(block: bytes) -> None:
    with pytest.raises(NotLz4):
        unpacked_block(block, 100)


def test_image_of_the_release_is_read(tmp_path: Path) -> None:
    block = base64.b64decode(CASE["image"][0])
    values = opened(tmp_path / "depth.bin", 2 * (len(block).to_bytes(4, "little") + block)).values(1)
    assert values.shape == SHAPE and zlib.crc32(values.astype("<u2").tobytes()) == CASE["image"][2]


def test_single_stream_is_read_in_any_order(tmp_path: Path) -> None:
    metres = b"".join((image(k).astype(np.float32) / np.float32(1000)).astype("<f4").tobytes() for k in range(4))
    depth = opened(tmp_path / "depth.bin", raw(metres))
    for number in (0, 3, 1, 2, 0):
        expected = millimetres(image(number).astype(np.float32) / np.float32(1000))
        np.testing.assert_array_equal(depth.values(number), expected)
    with pytest.raises(DataError, match=r"^here: depth.bin: has fewer images, but not frame 4"):
        depth.values(4)


@pytest.mark.parametrize("content", [b"nothing of the kind", raw(b"\0" * 1000), raw(b"\0" * 4 * 49152)[:-3]])
def test_unknown_format_is_one_line(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(DataError, match=r"^here: depth.bin: (is not in any format|ends within an image)"):
        opened(tmp_path / "depth.bin", content).values(1)
