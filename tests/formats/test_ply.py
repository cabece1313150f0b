"""PLY files: every type in every format round-trips, quads and mixed faces; a damaged file is a typed error."""

from __future__ import annotations

import resource
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from damage import assert_same

from su3d_bench.core.errors import DataError
from su3d_bench.formats.ply import ListColumn, PlyElement, read_ply, write_ply


def write_ply_as(path: Path, elements: Sequence[PlyElement], format: str) -> None:
    """As ``write_ply``, in another ``format``."""
    write_ply(path, elements)
    header, end, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    lines[1] = f"format {format} 1.0"
    if format != "binary_little_endian":
        is_text = format == "ascii"
        body = b"".join(text(row) if is_text else big_endian(row) for element in elements for row in rows(element))
    path.write_bytes("\n".join([*lines, ""]).encode() + end + body)


def rows(element: PlyElement) -> Iterator[list[np.ndarray]]:
    """The values of each row; lists are preceded by their length."""
    for row in range(element.n_rows):
        cells: list[np.ndarray] = []
        for column in element.columns.values():
            if isinstance(column, ListColumn):
                items = column.values[column.indptr[row] : column.indptr[row + 1]]
                cells += [np.array([len(items)], column.count_type), items]
            else:
                cells.append(column[row : row + 1])
        yield cells


def text(row: list[np.ndarray]) -> bytes:
    """The shortest digits that reproduce each value."""
    return (" ".join(str(value) for cell in row for value in cell) + "\n").encode()


def big_endian(row: list[np.ndarray]) -> bytes:
    return b"".join(cell.astype(cell.dtype.newbyteorder(">")).tobytes() for cell in row)


FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
QUADS = ListColumn(np.arange(4) * 4, np.array([0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 5, 4], np.int32))
MIXED = ListColumn(np.array([0, 4, 7, 7, 12]), np.array([0, 1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4], np.uint32))


def extremes(kind: str) -> np.ndarray:
    """The smallest and largest values of a type, and some that need all its digits."""
    if kind.startswith("f"):
        info = np.finfo(kind)
        return np.array([info.max, -info.max, info.tiny, 1 / 3, -0.1], kind)
    return np.array([np.iinfo(kind).min, np.iinfo(kind).max, 0, 1, np.iinfo(kind).max - 1], kind)


def vertices(n: int) -> PlyElement:
    points = np.random.default_rng(0).normal(size=(3, n)).astype(np.float32)
    return PlyElement("vertex", n, dict(zip("xyz", points, strict=True)))


def faces(corners: ListColumn, id_type: str = "u2") -> PlyElement:
    ids = np.arange(len(corners), dtype=id_type) + 7
    return PlyElement("face", len(corners), {"vertex_indices": corners, "object_id": ids})


def mesh_bytes(tmp_path: Path, format: str, corners: ListColumn = MIXED) -> bytes:
    write_ply_as(tmp_path / "whole.ply", [vertices(8), faces(corners)], format)
    return (tmp_path / "whole.ply").read_bytes()


@pytest.mark.parametrize("format", FORMATS)
def test_every_scalar_type_round_trips_over_its_full_range(tmp_path: Path, format: str) -> None:
    elements = [PlyElement("sample", 5, {f"value_{kind}": extremes(kind) for kind in TYPES})]
    write_ply_as(tmp_path / "a.ply", elements, format)
    assert_same(read_ply(tmp_path / "a.ply").elements, tuple(elements))


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(
    ("count", "item"), [*zip(["i1", "u1", "i2", "u2", "i4", "u4", "u1", "i4"], TYPES, strict=True)]
)
def test_lists_of_every_count_and_item_type_round_trip(tmp_path: Path, format: str, count: str, item: str) -> None:
    values = np.concatenate([extremes(item), extremes(item)])
    for indptr in (np.array([0, 5, 10]), np.array([0, 3, 3, 10])):  # equal lengths and different ones
        column = ListColumn(indptr, values, np.dtype(count))
        elements = [PlyElement("strip", len(column), {"before": np.arange(len(column), dtype="u1"), "items": column})]
        write_ply_as(tmp_path / "a.ply", elements, format)
        assert_same(read_ply(tmp_path / "a.ply").elements, tuple(elements))


def test_hand_written_ply_file_is_read_as_specified(tmp_path: Path) -> None:
    header = (
        b"ply\r\nformat binary_little_endian 1.0\r\nobj_info scanner\r\nelement vertex 1\r\nproperty double x\r\n"
        b"property uint8 red\r\nelement face 2\r\nproperty list uchar int vertex_indices\r\n"
        b"property ushort object_id\r\nend_header\r\n"
    )
    body = (
        struct.pack("<dB", 1.25, 200) + struct.pack("<B4iH", 4, 0, 1, 2, 3, 65535) + struct.pack("<B3iH", 3, 7, 8, 9, 0)
    )
    (tmp_path / "a.ply").write_bytes(header + body)
    file = read_ply(tmp_path / "a.ply")
    face = file.element("face")
    assert face is not None
    corners, ids = face.columns["vertex_indices"], face.columns["object_id"]
    assert isinstance(corners, ListColumn) and not isinstance(ids, ListColumn)
    assert corners.indptr.tolist() == [0, 4, 7] and corners.values.tolist() == [0, 1, 2, 3, 7, 8, 9]
    assert ids.tolist() == [65535, 0]
    assert file.elements[0].columns["x"].tolist() == [1.25]  # type: ignore[union-attr]


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("corners", [QUADS, MIXED], ids=["quads", "mixed"])
def test_file_truncated_anywhere_is_a_named_data_error(tmp_path: Path, format: str, corners: ListColumn) -> None:
    whole = (
        mesh_bytes(tmp_path, format, corners).rstrip() if format == "ascii" else mesh_bytes(tmp_path, format, corners)
    )
    last_word = len(whole.split()[-1]) if format == "ascii" else 0  # a number that loses digits is still a number
    for length in range(len(whole) - max(last_word, 1)):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"cut\.ply"):
            read_ply(tmp_path / "cut.ply")


@pytest.mark.parametrize("format", FORMATS)
def test_bytes_after_the_last_element_are_an_error(tmp_path: Path, format: str) -> None:
    (tmp_path / "long.ply").write_bytes(mesh_bytes(tmp_path, format) + b" 17 ")
    with pytest.raises(DataError, match="after the last element"):
        read_ply(tmp_path / "long.ply")


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("row", ["property float x", "property list uchar int vertex_indices"])
def test_header_with_a_trillion_rows_allocates_nothing(tmp_path: Path, format: str, row: str) -> None:
    header = f"ply\nformat {format} 1.0\nelement vertex 1000000000000\n{row}\nend_header\n1 2 3 4\n"
    (tmp_path / "bomb.ply").write_text(header)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match="declares 1000000000000 rows"):
        read_ply(tmp_path / "bomb.ply")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10_000  # KiB


V = "ply\nformat ascii 1.0\nelement v 2\n"


@pytest.mark.parametrize(
    "content",
    [
        *("obj\n", "ply\nformat ascii 1.0\n", "ply\nend_header\n", "ply\nformat binary 1.0\nend_header\n"),
        *("ply\nformat ascii 2.0\nend_header\n", "ply\nformat ascii 1.0\nelement vertex -1\nend_header\n"),
        *("ply\nformat ascii 1.0\nproperty float x\nend_header\n", f"{V}property half x\nend_header\n"),
        *(f"{V}property list float int x\nend_header\n", f"{V}element v 0\nend_header\n"),
        *(f"{V}property int x\nproperty int x\nend_header\n1 2 3 4\n", f"{V}property int x\nend_header\n1\nq\n"),
        *(f"{V}property int x\nend_header\n1\n2.5\n", f"{V}property uchar x\nend_header\n256\n1"),
        *(
            f"{V}property list char int x\nend_header\n-1\n-1\n",
            f"{V}property list char uchar x\nend_header\n1 5\n2 5 -5\n",
        ),
    ],
)
def test_each_invalid_ply_file_is_a_one_line_error(tmp_path: Path, content: str) -> None:
    (tmp_path / "bad.ply").write_text(content)
    with pytest.raises(DataError) as caught:
        read_ply(tmp_path / "bad.ply")
    assert str(caught.value).startswith(str(tmp_path / "bad.ply")) and str(caught.value).isprintable()


@pytest.mark.parametrize("is_text", [False, True])
def test_ply_files_are_exchanged_with_open3d(tmp_path: Path, is_text: bool) -> None:
    import open3d as o3d

    triangles = ListColumn(np.arange(3) * 3, np.array([0, 1, 2, 2, 3, 7], np.int32))
    ours = [vertices(8), PlyElement("face", 2, {"vertex_indices": triangles})]
    write_ply_as(tmp_path / "ours.ply", ours, "ascii" if is_text else "binary_little_endian")
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "ours.ply"))
    assert np.asarray(mesh.triangles).tolist() == [[0, 1, 2], [2, 3, 7]]
    columns = ours[0].columns
    np.testing.assert_allclose(np.asarray(mesh.vertices), np.stack([columns[axis] for axis in "xyz"], 1), rtol=1e-6)  # type: ignore[misc]
    assert o3d.io.write_triangle_mesh(str(tmp_path / "theirs.ply"), mesh, write_ascii=is_text)
    vertex, face = read_ply(tmp_path / "theirs.ply").elements
    np.testing.assert_allclose(vertex.columns["y"], columns["y"], rtol=1e-5)  # type: ignore[arg-type]
    assert isinstance(face.columns["vertex_indices"], ListColumn)
    assert face.columns["vertex_indices"].values.tolist() == triangles.values.tolist()
