"""Files of torch.save are read without torch, to the last value, and no archive makes the reader hold too much."""

from __future__ import annotations

import io
import os
import pickle
import struct
import sys
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import N_DAMAGES, damages, outcomes, truncations
from places import CASES
from same_values import assert_same

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.files import unpacking
from su3d_bench.formats.numpy_files import read_npy, read_npz
from su3d_bench.formats.torch_files import SparseTensor, read_torch, torch_kind

FILES = CASES / "torch_files"  # written by torch 2.13.0
MASKS = np.arange(36).reshape(12, 3) % 5 < 2
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
KINDS = {
    "openmask3d_masks.pt": "array",
    "tensor.pt": "tensor",
    "strided.pt": "tensor",
    "openyolo3d.pt": "tuple",
    "openins3d.pt": "sparse",
    "open3dis.pth": "dict",
    "sam3d.pth": "array",
}


def read_any(path: Path) -> Any:
    return read_torch(path)


def archive(tmp_path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """A zip archive laid out as torch.save does it."""
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
    """The pickle of one tensor in the words of torch."""
    place = number(offset) + numbers(*shape) + numbers(*strides)
    return (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n("
        + storage(n, kind)
        + place
        + b"\x89ccollections\nOrderedDict\n)RtR."
    )


SIX = np.arange(6, dtype="<f4").tobytes()


# ---- what is read


@pytest.mark.parametrize("name", EXPECTED)
def test_files_that_torch_wrote_are_read_to_the_last_value(name: str) -> None:
    assert_same(read_torch(FILES / name), EXPECTED[name])


def test_a_sparse_tensor_that_torch_wrote_holds_its_indices_and_values() -> None:
    sparse = read_torch(FILES / "openins3d.pt")
    assert isinstance(sparse, SparseTensor) and sparse.shape == (12, 3)
    dense = np.zeros(sparse.shape)
    dense[tuple(sparse.indices)] = sparse.values
    np.testing.assert_array_equal(dense, MASKS)


@pytest.mark.parametrize(("name", "kind"), KINDS.items())
def test_the_ends_of_a_file_tell_what_it_holds(name: str, kind: str) -> None:
    assert torch_kind(FILES / name) == kind


def test_reading_needs_no_torch(tmp_path: Path) -> None:
    import subprocess

    code = (
        "import sys; sys.modules['torch'] = None\nfrom pathlib import Path\n"
        "from su3d_bench.formats.torch_files import read_torch\n"
        f"assert read_torch(Path({str(FILES / 'tensor.pt')!r})).shape == (12, 3)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": ""})


def test_what_torch_writes_today_is_read_to_the_last_value(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: the committed files alone prove the layout")
    rng = np.random.default_rng(0)
    arrays: dict[str, Any] = {
        "f16": rng.random((7, 5)).astype(np.float16),
        "f64": rng.random((2, 3, 4)),
        "i64": rng.integers(-9, 9, 11),
        "u8": rng.integers(0, 255, (3, 3)).astype(np.uint8),
        "bool": rng.random(9) < 0.5,
        "u16": rng.integers(0, 65535, 4).astype(np.uint16),
        "empty": np.zeros((0, 4), np.float32),
        "point": np.array(2.5),
    }
    for name, array in arrays.items():
        whole = torch.from_numpy(np.array(array))
        turned = whole.permute(tuple(reversed(range(whole.ndim))))
        for value in (array, whole, torch.nn.Parameter(whole) if whole.is_floating_point() else whole):
            torch.save(value, tmp_path / name)
            assert_same(read_torch(tmp_path / name), array)
        torch.save(
            [whole, whole[1:] if whole.ndim else whole, {"of": turned, "device": torch.device("cpu")}], tmp_path / name
        )
        first, second, named = read_any(tmp_path / name)
        assert_same([first, second, named["of"]], [array, array[1:] if array.ndim else array, array.T])
    torch.save({"size": torch.zeros(3, 4).shape, "type": 1.5}, tmp_path / "mixed")
    assert read_torch(tmp_path / "mixed") == {"size": (3, 4), "type": 1.5}


def test_torch_reads_the_committed_files_as_we_do() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: the committed files alone prove the layout")
    from numpy._core.multiarray import _reconstruct

    plain = [_reconstruct, np.ndarray, np.dtype, *(type(np.dtype(kind)) for kind in ("f2", "f4", "i8"))]
    with torch.serialization.safe_globals(plain):
        for name, expected in EXPECTED.items():
            assert_same(as_arrays(torch.load(FILES / name, weights_only=True)), expected)


def as_arrays(value: Any) -> Any:
    """What torch read, with arrays in place of its tensors."""
    if isinstance(value, dict):
        return {key: as_arrays(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(as_arrays(one) for one in value)
    return value if isinstance(value, np.ndarray | int | float | str) else value.numpy()


def test_storages_of_the_other_byte_order_are_read_in_theirs(tmp_path: Path) -> None:
    big = np.arange(6, dtype=">f4").tobytes()
    pickled = tensor((2, 3), (3, 1))
    path = archive(tmp_path, {"a/data.pkl": pickled, "a/byteorder": b"big", "a/data/0": big})
    np.testing.assert_array_equal(read_any(path), np.arange(6).reshape(2, 3))
    path = archive(tmp_path, {"a/data.pkl": pickled, "a/byteorder": b"middle", "a/data/0": big})
    with pytest.raises(PredictionError, match="byteorder is b'middle'; expected little or big"):
        read_torch(path)


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
def test_views_within_their_storage_are_read(
    tmp_path: Path, shape: tuple[int, ...], strides: tuple[int, ...], offset: int, expected: Any
) -> None:
    path = archive(tmp_path, {"a/data.pkl": tensor(shape, strides, offset=offset), "a/data/0": SIX})
    np.testing.assert_array_equal(read_any(path), np.array(expected))


def test_other_members_are_left_alone(tmp_path: Path) -> None:
    members = {
        "a/data.pkl": tensor((6,), (1,)),
        "a/data/0": SIX,
        "../../evil": b"x",
        "/etc/evil": b"x",
        "a/data/1": b"",
    }
    assert_same(read_torch(archive(tmp_path, members)), np.arange(6, dtype=np.float32))
    assert not list(tmp_path.parent.glob("evil"))


# ---- what is refused


@pytest.mark.parametrize(
    ("pickled", "message"),
    [
        (tensor((7,), (1,)), "shape (7,) lies beyond the 6 values"),
        (tensor((2,), (6,)), "lies beyond"),
        (tensor((1,), (1,), offset=6), "lies beyond"),
        (tensor((1,), (1,), offset=-1), "without a valid place"),
        (tensor((2, 3), (1,)), "without a valid place"),
        (tensor((2,), (-1,), offset=1), "without a valid shape"),
        (tensor((10**12,), (0,)), "lies beyond"),
        (tensor((10**9, 10**9), (0, 0)), "lies beyond"),
        (tensor((6,), (1,), n=10**12), "storage 0 of 1000000000000 values has 24 bytes"),
        (tensor((6,), (1,), n=5), "storage 0 of 5 values has 24 bytes"),
        (tensor((6,), (1,), kind="QInt8Storage"), "asks for 'torch.QInt8Storage'"),
        (tensor((1,) * 9, (1,) * 9), "without a valid shape"),
        (b"\x80\x02" + storage(6, key="../../x") + b".", "a reference without a valid name"),
        (b"\x80\x02" + storage(6, key="7") + b".", "'a/data/7' is not in the archive"),
        (b"\x80\x02K\x01Q.", "a reference that is no storage"),
        (b"\x80\x02cposix\nsystem\n" + text("true") + b"\x85R.", "asks for 'posix.system'"),
        (b"\x80\x02ctorch.serialization\nload\n" + text("x") + b"\x85R.", "asks for 'torch.serialization.load'"),
        (b"\x80\x02ctorch.storage\n_load_from_bytes\nC\x00\x85R.", "asks for 'torch.storage._load_from_bytes'"),
        (b"\x80\x02ctorch.serialization\n_get_layout\n" + text("torch.sparse_csr") + b"\x85R.", "a layout 'torch.spa"),
        (b"\x80\x02ctorch._utils\n_rebuild_sparse_tensor\nK\x01\x85R.", "without indices and values"),
    ],
)
def test_each_fault_inside_an_archive_is_one_line(tmp_path: Path, pickled: bytes, message: str) -> None:
    path = archive(tmp_path, {"a/data.pkl": pickled, "a/data/0": SIX})
    tracemalloc.start()
    try:
        with pytest.raises(PredictionError) as caught:
            read_torch(path)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{path}: ") and message in str(caught.value)


@pytest.mark.parametrize(
    ("indices", "shape", "message"),
    [
        ([[0, 1], [0, 5]], (2, 3), "with a value outside of it"),
        ([[0, -1], [0, 1]], (2, 3), "with a value outside of it"),
        ([[0, 1]], (2, 3), "with indices of (1, 2)"),
    ],
)
def test_a_sparse_tensor_with_wrong_indices_is_refused(
    tmp_path: Path, indices: list[list[int]], shape: tuple[int, ...], message: str
) -> None:
    array = np.array(indices, "<i8")
    view = tensor(array.shape, (array.shape[1], 1), n=array.size, kind="LongStorage")[2:-1]
    values = tensor((2,), (1,), n=2)[2:-1].replace(text("0"), text("1"))
    layout = b"ctorch.serialization\n_get_layout\n" + text("torch.sparse_coo") + b"\x85R"
    pickled = (
        b"\x80\x02ctorch._utils\n_rebuild_sparse_tensor\n(" + layout + b"(" + view + values + numbers(*shape) + b"ttR."
    )
    members = {"a/data.pkl": pickled, "a/data/0": array.tobytes(), "a/data/1": np.ones(2, "<f4").tobytes()}
    with pytest.raises(PredictionError) as caught:
        read_torch(archive(tmp_path, members))
    assert message in str(caught.value)


def test_the_form_of_old_torch_and_other_files_say_what_to_do(tmp_path: Path) -> None:
    old = pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2)
    for content in (old, b"", b"PK", b"hello world", bytes(1000)):
        (tmp_path / "old.pth").write_bytes(content)
        with pytest.raises(PredictionError, match=r"old\.pth: not a zip archive of torch\.save.*torch\.load"):
            read_torch(tmp_path / "old.pth")
        assert torch_kind(tmp_path / "old.pth") is None
    path = archive(tmp_path, {"word/document.xml": b"x"})
    with pytest.raises(PredictionError, match=r"not one of .*: it has 0"):
        read_torch(path)
    path = archive(tmp_path, {"a/data.pkl": b"N.", "b/data.pkl": b"N."})
    with pytest.raises(PredictionError, match=r"not one of .*: it has 2"):
        read_torch(path)
    for missing in (tmp_path / "none.pt", tmp_path):
        with pytest.raises(PredictionError, match="cannot be read"):
            read_torch(missing)


def test_archives_that_inflate_are_held_to_their_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zeros = bytes(40 << 20)
    pickled = tensor((1,), (1,), n=len(zeros) // 4)
    path = archive(tmp_path, {"a/data.pkl": pickled, "a/data/0": zeros}, zipfile.ZIP_DEFLATED)
    with pytest.raises(PredictionError, match="storages are larger than the file"):
        read_torch(path)
    monkeypatch.setattr(unpacking, "FREE_BYTES", 1 << 20)
    tracemalloc.start()
    try:
        path = archive(tmp_path, {"a/data.pkl": zeros}, zipfile.ZIP_DEFLATED)
        with pytest.raises(PredictionError, match="unpacks to more than 3 MiB, over 100 times its size"):
            read_torch(path)
        np.savez_compressed(tmp_path / "bomb.npz", pred_masks=np.zeros((1 << 11, 1 << 10), np.bool_))
        with pytest.raises(PredictionError, match="unpacks to more than 1 MiB"):
            read_npz(tmp_path / "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
    finally:
        tracemalloc.stop()


def test_a_member_that_promises_more_than_its_file_warrants_is_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "lie.npz", pred_masks=np.zeros(1000, np.bool_))
    content = bytearray((tmp_path / "lie.npz").read_bytes())
    at = content.index(b"PK\x01\x02") + 24  # the unpacked size in the directory
    content[at : at + 4] = struct.pack("<I", 3_000_000_000)
    (tmp_path / "lie.npz").write_bytes(bytes(content))
    with pytest.raises(PredictionError, match=r"lie\.npz: unpacks to more than 128 MiB"):
        read_npz(tmp_path / "lie.npz")


def test_encrypted_and_oddly_compressed_members_are_refused(tmp_path: Path) -> None:
    path = archive(tmp_path, {"a/data.pkl": b"N." * 100}, zipfile.ZIP_BZIP2)
    with pytest.raises(PredictionError, match="encrypted or compressed in an unusual way"):
        read_torch(path)


# ---- arrays of NumPy


def npy(header: str, body: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    width = "<H" if version[0] == 1 else "<I"
    return b"\x93NUMPY" + version + struct.pack(width, len(header)) + header.encode() + body


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a .npy array of plain numbers"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }"), "needs 4000000000000 bytes"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }", b"1234"), "needs 8 bytes, 4 are there"),
        (npy("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }", b"1234"), "not a .npy array"),
        (npy("{'descr': '|V4', 'fortran_order': False, 'shape': (1,), }", b"1234"), "not a .npy array"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }", b"1234"), "not a .npy array"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 5000), "not a .npy array"),
        (npy("{'descr': '<U0', 'fortran_order': False, 'shape': (99,), }"), "needs 0 bytes"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (0, 9999999999, 99999999999), }"), "is damaged"),
    ],
)
def test_each_fault_of_an_array_file_is_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(PredictionError) as caught:
        read_npy(tmp_path / "a.npy")
    assert message in str(caught.value) and "a.npy" in str(caught.value)


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_arrays_that_numpy_wrote_are_read_in_every_version(tmp_path: Path, version: tuple[int, int]) -> None:
    for array in (
        np.arange(6).reshape(2, 3),
        np.asfortranarray(np.ones((2, 3), ">f4")),
        np.array(["a", "bc"]),
        np.array(1),
    ):
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, array, version, allow_pickle=False)
        (tmp_path / "a.npy").write_bytes(buffer.getvalue())
        assert_same(read_npy(tmp_path / "a.npy"), array)


# ---- damage


def reader(tmp_path: Path, name: str) -> Any:
    def read_bytes(content: bytes) -> object:
        path = tmp_path / name
        path.write_bytes(content)
        torch_kind(path)
        return (
            read_npz(path) if name.endswith(".npz") else read_npy(path) if name.endswith(".npy") else read_torch(path)
        )

    return read_bytes


def whole(tmp_path: Path, name: str) -> bytes:
    if name == "a.npy":
        np.save(tmp_path / name, np.arange(12.0).reshape(3, 4))
    elif name == "a.npz":
        np.savez_compressed(tmp_path / name, pred_masks=MASKS, pred_score=np.ones(3))
    else:
        return (FILES / name).read_bytes()
    return (tmp_path / name).read_bytes()


NAMES = ("strided.pt", "openins3d.pt", "open3dis.pth", "a.npy", "a.npz")  # the rest is damaged in the tests of formats


@pytest.mark.parametrize("name", NAMES)
def test_every_cut_of_an_archive_is_one_error(tmp_path: Path, name: str) -> None:
    copies = truncations(whole(tmp_path, name))
    n_read, _ = outcomes(reader(tmp_path, name), copies, must_name=name, refusal=PredictionError)
    assert n_read == 0


@pytest.mark.parametrize("name", NAMES)
def test_damaged_archives_are_read_or_refused_but_nothing_else(tmp_path: Path, name: str) -> None:
    copies = damages(whole(tmp_path, name))
    n_read, n_refused = outcomes(reader(tmp_path, name), copies, must_name=name, refusal=PredictionError)
    assert n_read + n_refused == N_DAMAGES and n_refused > 0.25 * N_DAMAGES
