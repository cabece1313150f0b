"""Decompression bombs: every reader of compressed, shared or run-length data rejects them with little memory.

Memory is measured as peak resident memory, under an address-space limit that no reader may reach.
"""

from __future__ import annotations

import bz2
import gzip
import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from damage import bounded_addresses, lacked_memory, peak_bytes, reset_peak
from decompression_bombs import (
    MIB,
    Member,
    deflated,
    gzip_of,
    jpeg_of_scans,
    npy_head,
    npz_of_zeros,
    png_of_zeros,
    zip_of,
)

from su3d_bench.core.errors import DataError, PredictionError, StoreError, Su3dError
from su3d_bench.core.files.atomic import DAMAGE, read_arrays
from su3d_bench.evaluation.texts import read_text_features
from su3d_bench.formats.arrays import MAX_MEMBERS, run_members
from su3d_bench.formats.images import decode_colour, decode_depth
from su3d_bench.formats.numpy_files import read_npz
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.formats.pickles import read_pickle_file
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.metrics.scoring import unpack_scores
from su3d_bench.predictions.formats import READERS
from su3d_bench.store.predictions import read_prediction

MAX_GROWN = 320 * MIB
LARGEST_BOMB = 4 * MIB


def refused(read: Callable[[], object], *kinds: type[Exception]) -> str:
    """The message of the error of ``kinds`` that ``read`` raises, with little memory."""
    with bounded_addresses(4 * MAX_GROWN):
        before = reset_peak()
        with pytest.raises(kinds or (Su3dError,)) as caught:
            read()
        grown = peak_bytes() - before
    assert not lacked_memory(caught.value), caught.value
    assert grown < MAX_GROWN, f"{grown >> 20} MiB: {caught.value}"
    return str(caught.value)


def kept(folder: Path, name: str, content: bytes) -> Path:
    assert len(content) < LARGEST_BOMB
    path = folder / name
    path.write_bytes(content)
    return path


def bz2_npz() -> bytes:
    """An archive of a kilobyte with a gibibyte, in a compression that ``zipfile`` unpacks without a limit."""
    packer = bz2.BZ2Compressor()
    parts = [packer.compress(npy_head((1 << 20, 1024)))]
    parts += [packer.compress(bytes(64 * MIB)) for _ in range(8)]
    return zip_of([Member("pred_masks.npy", b"".join([*parts, packer.flush()]), 1 << 17, zipfile.ZIP_BZIP2)])


def lying_npz() -> bytes:
    """A member with a small declared size and a longer stream."""
    return zip_of([Member("pred_masks.npy", deflated(npy_head((10, 10)), 1500), 228)])


def shared_npz() -> bytes:
    """Members that share the same bytes, each of a plausible size."""
    content = npz_of_zeros("00000", 100)
    at = content.index(b"PK\x01\x02")
    entry = content[at : content.index(b"PK\x05\x06")]
    names = [f"{k:05}".encode() for k in range(500)]
    directory = b"".join(entry.replace(b"00000", name) for name in names)
    end = struct.pack("<HHHHLLH", 0, 0, len(names), len(names), len(directory), at, 0)
    return content[:at] + directory + b"PK\x05\x06" + end


NPZ = {
    "zeros": lambda: npz_of_zeros("pred_masks", 2500),
    "bz2": bz2_npz,
    "lying": lying_npz,
    "shared": shared_npz,
}


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.proof] * (kind == "bz2")) for kind in NPZ])
def test_npz_bomb_is_rejected_by_each_of_its_readers(tmp_path: Path, kind: str) -> None:
    content = NPZ[kind]()
    path = kept(tmp_path, "scene0001_00.npz", content)
    refused(lambda: read_npz(path), PredictionError)
    refused(lambda: READERS["maskclustering"].read(tmp_path, "scene0001_00"), PredictionError)
    refused(lambda: read_arrays(path), *DAMAGE)
    refused(lambda: read_prediction(path), StoreError)
    refused(lambda: unpack_scores(content), DataError)
    refused(lambda: read_text_features(path), DataError)


def test_torch_archive_with_a_pickle_bomb_is_rejected(tmp_path: Path) -> None:
    n = 1500 * MIB
    packed = deflated(b"\x80\x02B" + struct.pack("<I", n), 1500, last=b".")
    path = kept(tmp_path, "a.pt", zip_of([Member("a/data.pkl", packed, n + 8)]))
    assert "unpacks to more than" in refused(lambda: read_torch(path), PredictionError)


@pytest.mark.parametrize(
    ("first", "n", "byte", "result"),
    [
        (b"\x80\x04\x8e" + struct.pack("<Q", 1500 * MIB), 1500, 0, "unpacks to more than"),  # one payload
        (b"\x80\x04N", 64, 0x94, "takes too many operations"),  # memoised again and again
    ],
)
def test_gzipped_pickle_bomb_is_rejected(tmp_path: Path, first: bytes, n: int, byte: int, result: str) -> None:
    path = kept(tmp_path, "a.pkl.gz", gzip_of(first, n, byte, b"."))
    assert result in refused(lambda: read_pickle_file(path), PredictionError)


def a_map_of_one_cloud(n_objects: int) -> bytes:
    """A map whose objects are references to a single one."""
    cloud = np.zeros((100_000, 3), np.float64).tobytes()
    array = b"cnumpy.core.numeric\n_frombuffer\n(B" + struct.pack("<I", len(cloud)) + cloud
    array += (
        b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8\x89\x88tR(K\x03X\x01\x00\x00\x00<NNNtb" + b"J\xa0\x86\x01\x00K\x03\x86"
    )
    array += b"X\x01\x00\x00\x00CtR"
    one = b"}X\x06\x00\x00\x00pcd_np" + array + b"sq\x01"
    return b"\x80\x04}X\x07\x00\x00\x00objects](" + one + b"h\x01" * (n_objects - 1) + b"esq\x02."


def test_objects_that_share_one_cloud_count_once_per_reference(tmp_path: Path) -> None:
    path = tmp_path / "pcd_x.pkl.gz"
    path.write_bytes(gzip.compress(a_map_of_one_cloud(3), 1))
    assert len(READERS["conceptgraphs"].read(path, "pcd_x").content.points) == 300_000  # type: ignore[union-attr]
    path.write_bytes(gzip.compress(a_map_of_one_cloud(2_000), 1))
    printed = refused(lambda: READERS["conceptgraphs"].read(path, "pcd_x"), PredictionError)
    assert "unpacks to more than" in printed


@pytest.mark.parametrize(
    ("decode", "content"),
    [
        (decode_colour, lambda: png_of_zeros(9900, 9900)),
        (decode_depth, lambda: png_of_zeros(9900, 9900, 16, 0)),
        (decode_colour, lambda: jpeg_of_scans(9900, 9900, 1)),
        (decode_colour, lambda: jpeg_of_scans(2000, 2000, 500)),
    ],
    ids=["colour", "depth", "jpeg", "scans"],
)
def test_image_bomb_is_rejected_before_decoding(
    decode: Callable[[bytes, str], object], content: Callable[[], bytes]
) -> None:
    made = content()
    assert len(made) < LARGEST_BOMB
    assert "not a readable" in refused(lambda: decode(made, "here"), DataError)


@pytest.mark.parametrize("n", [MAX_MEMBERS + 1, 99_999_999])
def test_run_length_masks_have_a_total_limit(n: int, tmp_path: Path) -> None:
    assert "points in total" in refused(lambda: run_members(10**8, f"1 {n}", "here"), PredictionError)
    for k in range(8):
        (tmp_path / f"{k}.json").write_text(f'{{"length": 100000000, "counts": "1 {MAX_MEMBERS // 4}"}}')
    (tmp_path / "scene0001_00.txt").write_text("".join(f"{k}.json 3 1.0\n" for k in range(8)))
    printed = refused(lambda: READERS["scannet-text"].read(tmp_path, "scene0001_00"), PredictionError)
    assert "points in total" in printed


def test_member_is_read_completely_and_its_checksum_is_verified(tmp_path: Path) -> None:
    values = np.arange(300_000, dtype=np.int64)
    stream = io.BytesIO()
    np.savez_compressed(stream, a=values)
    path = kept(tmp_path, "a.npz", stream.getvalue())
    np.testing.assert_array_equal(read_npz(path)["a"], values)
    np.testing.assert_array_equal(read_arrays(path)["a"], values)
    content = bytearray(stream.getvalue())
    content[14] ^= 1  # a bit of the checksum in the member's own header
    at = content.index(b"PK\x01\x02") + 16
    content[at] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(PredictionError, match="not a complete zip archive"):
        read_npz(path)


def test_compressed_point_bomb_is_rejected(tmp_path: Path) -> None:
    n = 50_000_000
    packed = bytes([0, 0]) + bytes([7 << 5, 255, 0]) * (3 * n // 264 + 1)
    lines = ["VERSION 0.7", "FIELDS x y z", "SIZE 1 1 1", "TYPE U U U", "COUNT 1 1 1", f"WIDTH {n}", "HEIGHT 1"]
    head = "\n".join([*lines, f"POINTS {n}", "DATA binary_compressed", ""]).encode()
    path = kept(tmp_path, "a.pcd", head + struct.pack("<II", len(packed), 3 * n) + packed)
    assert "unpacks to more than" in refused(lambda: read_pcd_points(path), DataError)
