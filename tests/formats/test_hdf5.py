"""Tables in HDF5 files: every usual form is read, every hostile one is a one-line error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from su3d_bench.core.errors import DataError
from su3d_bench.formats import hdf5
from su3d_bench.formats.hdf5 import largest_column, read_rows
from su3d_bench.formats.images import decode_colour

NAME = "pc_points"
WHERE = f"replica/room0: {NAME}.h5"
ROWS = np.random.default_rng(0).random((40, 3)).astype(np.float32)


def write(folder: Path, data: np.ndarray = ROWS, name: str = NAME, **options: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=data, **options)
    return path


@pytest.mark.parametrize("dtype", ["f2", "f4", ">f8"])
def test_hdf5_rows_are_read_unchanged(tmp_path: Path, dtype: str) -> None:
    data = ROWS.astype(dtype)
    found = read_rows(write(tmp_path, data), 3, WHERE)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, data.astype(np.float32))


def test_first_maximum_wins_and_row_of_zeros_gives_column_0(tmp_path: Path) -> None:
    table = np.zeros((4, 5), np.float32)
    table[1, [2, 4]] = 1
    table[2] = [-3, -2, -2, -9, -9]
    table[3, 4] = np.inf
    assert largest_column(write(tmp_path, table), 5, WHERE).tolist() == [0, 2, 1, 4]


def test_nan_in_a_row_is_reported_with_the_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5, "BLOCK_BYTES", 16 * 12)
    table = ROWS.copy()
    table[35, 1] = np.nan
    with pytest.raises(DataError, match=r"^replica/room0: pc_points\.h5: row 35 contains NaN; copy"):
        largest_column(write(tmp_path, table), 3, WHERE)


def soft_link(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["other"] = ROWS
        file[NAME] = h5py.SoftLink("/other")


def external_link(path: Path) -> None:
    write(path.parent / "elsewhere")
    with h5py.File(path, "w") as file:
        file[NAME] = h5py.ExternalLink(str(path.parent / "elsewhere" / path.name), NAME)


def external_storage(path: Path) -> None:
    (path.parent / "secret").write_bytes(ROWS.tobytes())
    with h5py.File(path, "w") as file:
        file.create_dataset(NAME, ROWS.shape, np.float32, external=[(str(path.parent / "secret"), 0, ROWS.nbytes)])


def virtual_dataset(path: Path) -> None:
    source = write(path.parent / "elsewhere")
    layout = h5py.VirtualLayout(ROWS.shape, np.float32)
    layout[:] = h5py.VirtualSource(str(source), NAME, ROWS.shape)
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset(NAME, layout)


def group(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_group(NAME)


def unwritten(shape: tuple[int, ...], **options: Any) -> Any:
    def make(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.create_dataset(NAME, shape, np.float32, **options)

    return make


def written(data: np.ndarray, **options: Any) -> Any:
    return lambda path: write(path.parent, data, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (soft_link, "'pc_points' is a link; expected the data itself"),
        (external_link, "'pc_points' is a link; expected the data itself"),
        (external_storage, "the values are in other files"),
        (virtual_dataset, "the values are in other files"),
        (group, "has no dataset 'pc_points'; expected one named like the file"),
        (lambda path: write(path.parent, name="points"), "has no dataset 'pc_points'"),
        (lambda path: path.write_bytes(b"not this format" * 100), "not a readable HDF5 file"),
        (lambda path: path.write_bytes(b""), "not a readable HDF5 file"),
        (lambda path: path.mkdir(), "cannot be read: Is a directory"),
        (lambda path: None, "cannot be read: No such file or directory"),
        (written(ROWS[:, :2]), "has the shape (40, 2); expected (N, 3)"),
        (written(ROWS[:, 0]), "has the shape (40,); expected (N, 3)"),
        (written(ROWS.astype(np.int32)), "contains values of type int32; expected float16"),
        (written(ROWS.astype(np.longdouble)), "expected float16, float32 or float64"),
        (written(ROWS, compression="gzip"), "is chunked or compressed"),
        (written(ROWS, chunks=(16, 3)), "is chunked or compressed"),
        (unwritten((10**12, 3)), "declares 1000000000000 rows of 3 values"),
    ],
)
def test_each_invalid_hdf5_file_is_a_one_line_error(tmp_path: Path, make: Any, message: str) -> None:
    path = tmp_path / f"{NAME}.h5"
    make(path)
    with pytest.raises(DataError) as caught:
        read_rows(path, 3, WHERE)
    line = str(caught.value)
    assert line.startswith(WHERE)
    assert message in line
    assert "\n" not in line


RANDOM = np.random.default_rng(0)
BGR = cv2.GaussianBlur(RANDOM.integers(0, 256, (61, 77, 3), np.uint8), (0, 0), 2)
HALVED = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
FULL = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


@pytest.mark.parametrize(
    ("suffix", "pixels", "options"),
    [
        (".jpg", BGR, HALVED),
        (".jpg", BGR, FULL),
        (".jpg", BGR, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", BGR[:, :, 0], []),
        (".png", BGR, []),
        (".png", BGR[:, :, 0], []),
        (".png", np.dstack([BGR, BGR[:, :, 0]]), []),
        (".png", BGR.astype(np.uint16) * 257, []),
    ],
    ids=["halved chroma", "full chroma", "progressive", "grey JPEG", "PNG", "grey PNG", "alpha", "16 bits"],
)
def test_decoded_pixels_are_rgb(suffix: str, pixels: np.ndarray, options: list[int]) -> None:
    content = cv2.imencode(suffix, pixels, options)[1]
    rgb = decode_colour(content.tobytes(), "here")
    assert rgb.flags.c_contiguous
    assert np.array_equal(rgb, np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR))[:, :, ::-1])
    if suffix == ".png":
        assert np.array_equal(rgb, (BGR if pixels.ndim == 3 else np.dstack([pixels] * 3))[:, :, ::-1])
