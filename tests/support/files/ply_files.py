"""PLY files in the forms that others write: text, big-endian bytes, with comments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply


def write_ply_as(path: Path, elements: Sequence[PlyElement], format: str, comments: Sequence[str] = ()) -> None:
    """As ``write_ply``, in another ``format``."""
    write_ply(path, elements)
    header, end, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    lines[1:2] = [f"format {format} 1.0", *(f"comment {comment}" for comment in comments)]
    if format != "binary_little_endian":
        is_text = format == "ascii"
        body = b"".join(text(row) if is_text else big_endian(row) for element in elements for row in rows(element))
    path.write_bytes("\n".join([*lines, ""]).encode() + end + body)


def rows(element: PlyElement) -> Iterator[list[np.ndarray]]:
    """The values of each row, those of a list behind their number."""
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
    """The shortest digits that give each value back."""
    return (" ".join(str(value) for cell in row for value in cell) + "\n").encode()


def big_endian(row: list[np.ndarray]) -> bytes:
    return b"".join(cell.astype(cell.dtype.newbyteorder(">")).tobytes() for cell in row)
