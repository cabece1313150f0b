"""Tables in HDF5 files: every usual form is read, every hostile one is one error of one line."""

from __future__ import annotations

import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from damage import N_DAMAGES, damages, outcomes, truncations

from su3d_bench.core.errors import DataError
from su3d_bench.formats import hdf5
from su3d_bench.formats.hdf5 import largest_column, read_rows, row_blocks

NAME = "pc_points"
WHERE = f"replica/room0: {NAME}.h5"
ROWS = np.random.default_rng(0).random((40, 3)).astype(np.float32)
GZIP: dict[str, Any] = {"chunks": (16, 3), "compression": "gzip", "shuffle": True}


def write(folder: Path, data: np.ndarray = ROWS, name: str = NAME, **options: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=data, **options)
    return path


@pytest.mark.parametrize(
    "options",
    [{}, GZIP, {"chunks": (7, 2), "compression": "gzip"}, {"chunks": (40, 2)}, {"chunks": (7, 3), "shuffle": True}],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["<f2", ">f4", "<f4", "<f8"])
def test_rows_come_back_as_they_were_written(tmp_path: Path, options: dict[str, Any], dtype: str) -> None:
    data = ROWS.astype(dtype)
    found = read_rows(write(tmp_path, data, **options), 3, WHERE)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, data.astype(np.float32))


@pytest.mark.parametrize("options", [{}, GZIP], ids=["contiguous", "chunked"])
def test_a_large_table_comes_in_blocks(
    tmp_path: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5, "BLOCK_BYTES", 16 * 12)
    path = write(tmp_path, **options)
    assert [len(block) for block in row_blocks(path, 3, WHERE)] == [16, 16, 8]
    np.testing.assert_array_equal(read_rows(path, 3, WHERE), ROWS)


def test_an_empty_table_has_no_rows(tmp_path: Path) -> None:
    assert read_rows(write(tmp_path, np.zeros((0, 3), np.float32)), 3, WHERE).shape == (0, 3)


def test_the_first_maximum_wins_and_a_row_of_zeros_is_column_0(tmp_path: Path) -> None:
    table = np.zeros((4, 5), np.float32)
    table[1, [2, 4]] = 1
    table[2] = [-3, -2, -2, -9, -9]
    table[3, 4] = np.inf
    assert largest_column(write(tmp_path, table), 5, WHERE).tolist() == [0, 2, 1, 4]


def test_a_nan_anywhere_in_a_row_is_an_error_that_names_the_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5, "BLOCK_BYTES", 16 * 12)
    table = ROWS.copy()
    table[35, 1] = np.nan
    with pytest.raises(DataError, match=r"^replica/room0: pc_points\.h5: row 35 holds NaN; copy"):
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


def stored(content: bytes) -> Any:
    """A file of one compressed chunk, which holds 192 bytes, as ``content`` says it."""

    def make(path: Path) -> None:
        with h5py.File(path, "w") as file:
            table = file.create_dataset(NAME, (16, 3), np.float32, chunks=(16, 3), compression="gzip")
            table.id.write_direct_chunk((0, 0), content)

    return make


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
        (written(ROWS.astype(np.int32)), "holds values of type int32; expected float16"),
        (written(ROWS.astype(np.longdouble)), "expected float16, float32 or float64"),
        (written(ROWS, compression="lzf"), "is compressed with the filter 32000 of HDF5; expected gzip"),
        (written(ROWS, chunks=(16, 3), fletcher32=True), "is compressed with the filter 3 of HDF5"),
        (
            unwritten((10**12, 3), chunks=(1024, 3)),
            "promises 1000000000000 rows of 3 values, 12000000000000 bytes, but",
        ),
        (unwritten((10**12, 3)), "promises 1000000000000 rows of 3 values"),
        (unwritten((100, 3), chunks=(10, 3)), "the values from row 0 on are missing or damaged"),
        (unwritten((10**9, 3), chunks=(10**8, 3)), "promises 1000000000 rows"),
        (stored(bytes(10_000)), "the values from row 0 on are missing or damaged"),
        (stored(zlib.compress(bytes(100_000), 9)), "the values from row 0 on are damaged"),
        (stored(zlib.compress(bytes(191))), "the values from row 0 on are damaged"),
        (stored(b"no stream of zlib"), "the values from row 0 on are damaged"),
    ],
)
def test_each_unfit_file_is_one_clear_line(tmp_path: Path, make: Any, message: str) -> None:
    path = tmp_path / f"{NAME}.h5"
    make(path)
    with pytest.raises(DataError) as caught:
        read_rows(path, 3, WHERE)
    line = str(caught.value)
    assert line.startswith(WHERE)
    assert message in line
    assert "\n" not in line


@pytest.mark.parametrize("options", [{}, GZIP], ids=["contiguous", "chunked"])
def test_every_truncation_and_damage_is_read_or_refused_in_one_line(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path, **options)
    content = path.read_bytes()

    def read(damaged: bytes) -> None:
        path.write_bytes(damaged)
        read_rows(path, 3, WHERE)

    assert outcomes(read, truncations(content), must_name=WHERE) == (0, len(content))
    n_read, n_refused = outcomes(read, damages(content), must_name=WHERE)
    assert n_read + n_refused == N_DAMAGES
    assert min(n_read, n_refused) > 0.02 * N_DAMAGES


def test_a_promise_without_data_is_refused_in_little_memory(tmp_path: Path) -> None:
    """The library allocates outside of what Python can trace, so a process of its own is held to 600 MB."""
    unwritten((10**12, 3), chunks=(4096, 3))(tmp_path / f"{NAME}.h5")
    code = (
        "import resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_AS, (600 << 20, 600 << 20))\n"
        "from pathlib import Path\n"
        "from su3d_bench.formats.hdf5 import read_rows\n"
        "from su3d_bench.core.errors import DataError\n"
        "try:\n    read_rows(Path(sys.argv[1]), 3, 'here')\n"
        "except DataError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / f"{NAME}.h5")],
        capture_output=True, text=True, timeout=120, env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.stdout.startswith("here: promises 1000000000000 rows"), done.stderr
