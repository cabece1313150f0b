"""Files of torch.save are read exactly without torch, and memory is limited."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import assert_same, traced
from places import CASES

from su3d_bench.core.errors import PredictionError
from su3d_bench.formats.torch_files import SparseTensor, read_torch
from su3d_bench.predictions.formats import READERS

FILES = CASES / "torch_files"  # written by torch 2.13.0
MASKS = np.arange(36).reshape(12, 3) % 5 < 2
SIX = np.arange(6, dtype="<f4").tobytes()
EXPECTED: dict[str, Any] = {
    "openmask3d_masks.pt": MASKS.astype(np.float16),
    "tensor.pt": MASKS,
    "strided.pt": np.arange(24, dtype=np.float32).reshape(4, 6).T[1:5:2, ::3],
    "openyolo3d.pt": (MASKS, np.array([0.75, 0.5, 0.25], np.float32)),
    "open3dis.pth": {
        "ins": [
            {"length": 12, "counts": np.array([1, 2, 6, 2, 11, 2])},
            {"length": 12, "counts": np.array([4, 1])},
        ],
        "conf": np.array([0.5, 0.25], np.float32),
        "final_class": np.array([3, 0]),
    },
    "sam3d.pth": np.array([-1, 0, 0, 1, 2, 2, -1, 1]),
}


def archive(tmp_path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """A zip archive with the layout of torch.save."""
    path = tmp_path / "made.pt"
    with zipfile.ZipFile(path, "w", compression) as target:
        for name, content in members.items():
            target.writestr(name, content)
    return path


def number(value: int) -> bytes:
    return b"\x8a\x08" + struct.pack("<q", value)


def numbers(*values: int) -> bytes:
    return b"(" + b"".join(number(value) for value in values) + b"t"


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def storage(n: int, kind: str = "FloatStorage", key: str = "0") -> bytes:
    return b"(" + text("storage") + b"ctorch\n" + kind.encode() + b"\n" + text(key) + text("cpu") + number(n) + b"tQ"


def tensor(
    shape: tuple[int, ...], strides: tuple[int, ...], *, offset: int = 0, n: int = 6, kind: str = "FloatStorage"
) -> bytes:
    """The pickle of one tensor, as written by torch."""
    place = number(offset) + numbers(*shape) + numbers(*strides)
    rebuild, hooks = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(", b"\x89ccollections\nOrderedDict\n)RtR."
    return rebuild + storage(n, kind) + place + hooks


@pytest.mark.parametrize("name", EXPECTED)
def test_stored_torch_files_are_read_exactly(name: str) -> None:
    assert_same(read_torch(FILES / name), EXPECTED[name])


def test_sparse_tensor_of_torch_is_read_with_indices_and_values() -> None:
    sparse = read_torch(FILES / "openins3d.pt")
    assert isinstance(sparse, SparseTensor) and sparse.shape == (12, 3)
    dense = np.zeros(sparse.shape)
    dense[tuple(sparse.indices)] = sparse.values
    np.testing.assert_array_equal(dense, MASKS)


@pytest.mark.parametrize("is_zip", [True, False], ids=["zip", "older form"])
def test_files_of_the_installed_torch_are_read_exactly(tmp_path: Path, is_zip: bool) -> None:
    import torch

    rng, path = np.random.default_rng(0), tmp_path / "a"
    arrays: list[Any] = [
        *(rng.random((7, 5)).astype(np.float16), rng.random((2, 3, 4)), rng.integers(-9, 9, 11), rng.random(9) < 0.5),
        *(rng.integers(0, 255, (3, 3)).astype(np.uint8), np.zeros((0, 4), np.float32), np.array(2.5)),
    ]
    for array in arrays:
        whole = torch.from_numpy(np.array(array))
        turned = whole.permute(tuple(reversed(range(whole.ndim))))
        value = [array, whole, whole[1:] if whole.ndim else whole, {"of": turned, "device": torch.device("cpu")}]
        torch.save(value, path, _use_new_zipfile_serialization=is_zip)
        read: Any = read_torch(path)
        assert_same([*read[:3], read[3]["of"]], [array, array, array[1:] if array.ndim else array, array.T])
    half = torch.from_numpy(rng.random((3, 4)).astype(np.float32)).to(torch.bfloat16)
    torch.save({"a": torch.nn.Parameter(half), "size": half.shape}, path, _use_new_zipfile_serialization=is_zip)
    assert_same(read_torch(path), {"a": half.to(torch.float32).numpy(), "size": (3, 4)})


@pytest.mark.parametrize(
    ("shape", "strides", "offset", "expected"),
    [
        ((2, 3), (3, 1), 0, [[0, 1, 2], [3, 4, 5]]),
        ((3, 2), (1, 3), 0, [[0, 3], [1, 4], [2, 5]]),
        ((2,), (2,), 1, [1, 3]),
        ((3,), (0,), 4, [4, 4, 4]),
        ((0, 9), (9, 1), 0, np.zeros((0, 9))),
        ((), (), 5, 5),
    ],
)
def test_views_within_their_storage_are_read_and_other_members_ignored(
    tmp_path: Path, shape: tuple[int, ...], strides: tuple[int, ...], offset: int, expected: Any
) -> None:
    members = {"a/data.pkl": tensor(shape, strides, offset=offset), "a/data/0": SIX, "../../evil": b"x", "a/b": b""}
    np.testing.assert_array_equal(read_torch(archive(tmp_path, members)), np.array(expected))
    assert not list(tmp_path.parent.glob("evil"))


FAULTS = {
    "beyond": tensor((7,), (1,)),
    "offset beyond": tensor((1,), (1,), offset=6),
    "fewer strides": tensor((2, 3), (1,)),
    "negative stride": tensor((2,), (-1,), offset=1),
    "repeated": tensor((10**12,), (0,)),
    "larger storage": tensor((6,), (1,), n=10**12),
    "quantised": tensor((6,), (1,), kind="QInt8Storage"),
    "dimensions": tensor((1,) * 9, (1,) * 9),
    "path": b"\x80\x02" + storage(6, key="../../x") + b".",
    "two sizes": b"\x80\x02(" + storage(6) + storage(5) + b"t.",
    "no storage": b"\x80\x02K\x01Q.",
    "call": b"\x80\x02cposix\nsystem\n" + text("true") + b"\x85R.",
    "load": b"\x80\x02ctorch.storage\n_load_from_bytes\nC\x00\x85R.",
    "sparse": b"\x80\x02ctorch._utils\n_rebuild_sparse_tensor\nK\x01\x85R.",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_invalid_archive_content_is_a_one_line_error(tmp_path: Path, fault: str) -> None:
    path = archive(tmp_path, {"a/data.pkl": FAULTS[fault], "a/data/0": SIX})
    with traced(2_000_000), pytest.raises(PredictionError) as caught:
        read_torch(path)
    assert str(caught.value).startswith(f"{path}: ") and str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("indices", "shape"), [([[0, 1], [0, 5]], (2, 3)), ([[0, -1], [0, 1]], (2, 3)), ([[0, 1]], (2, 3))]
)
def test_sparse_tensor_with_invalid_indices_is_rejected(
    tmp_path: Path, indices: list[list[int]], shape: tuple[int, ...]
) -> None:
    array = np.array(indices, "<i8")
    view = tensor(array.shape, (array.shape[1], 1), n=array.size, kind="LongStorage")[2:-1]
    values = tensor((2,), (1,), n=2)[2:-1].replace(text("0"), text("1"))
    layout = b"ctorch.serialization\n_get_layout\n" + text("torch.sparse_coo") + b"\x85R"
    pickled = b"\x80\x02ctorch._utils\n_rebuild_sparse_tensor\n(" + layout + b"(" + view + values + numbers(*shape)
    members = {"a/data.pkl": pickled + b"ttR.", "a/data/0": array.tobytes(), "a/data/1": np.ones(2, "<f4").tobytes()}
    archive(tmp_path, members)
    with pytest.raises(PredictionError, match="sparse tensor"):
        READERS["openins3d"].read(tmp_path, "made")


def test_files_not_from_torch_save_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "made.pt"
    for content in (b"", b"PK", b"hello world", bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(PredictionError, match=r"made\.pt: not a file of torch\.save"):
            read_torch(path)
    for members in ({"word/document.xml": b"x"}, {"a/data.pkl": b"N.", "b/data.pkl": b"N."}):
        with pytest.raises(PredictionError, match=r"not one of torch\.save"):
            read_torch(archive(tmp_path, members))
    with pytest.raises(PredictionError, match="is not little-endian"):
        read_torch(archive(tmp_path, {"a/data.pkl": tensor((6,), (1,)), "a/data/0": SIX, "a/byteorder": b"big"}))
    zeros = bytes(40 << 20)
    packed = {"a/data.pkl": tensor((1,), (1,), n=len(zeros) // 4), "a/data/0": zeros}
    with pytest.raises(PredictionError, match="storages are larger than the file"):
        read_torch(archive(tmp_path, packed, zipfile.ZIP_DEFLATED))
    with pytest.raises(PredictionError, match="encrypted or has an unsupported compression"):
        read_torch(archive(tmp_path, {"a/data.pkl": b"N." * 100}, zipfile.ZIP_BZIP2))
    with pytest.raises(PredictionError, match="cannot be read"):
        read_torch(tmp_path)
