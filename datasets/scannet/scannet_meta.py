"""What is read of ``<scan>.txt``, the facts of a scan: the matrix that turns its axes along the walls."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array
from su3d_bench.formats.images import read_bytes
from su3d_bench.numerics.geometry import are_rigid

ALIGNMENT = "axisAlignment"


def meta_name(scan: str) -> str:
    return f"{scan}.txt"


def read_axis_alignment(path: Path, where: str) -> Float64Array:
    """The rigid motion (4, 4) from the scan's frame to one along the walls; ``where`` begins each message.

    The identity where the file has no such line, as that of some scans. Released meshes and poses are not aligned.
    """
    where = f"{where}: {path.name}"
    try:
        lines = read_bytes(path, where).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text file; copy it again") from error
    facts = {}
    for number, line in enumerate(lines, 1):
        key, equals, value = line.partition("=")
        if line.strip() and not equals:
            raise DataError(f"{where} line {number}: {line.strip()[:40]!r} is no 'key = value'; copy the file again")
        facts[key.strip()] = value
    if not any(facts):
        raise DataError(f"{where}: holds nothing; expected lines 'key = value'")
    return np.eye(4) if ALIGNMENT not in facts else _motion(facts[ALIGNMENT], f"{where}: '{ALIGNMENT}'")


def _motion(text: str, where: str) -> Float64Array:
    words = text.split()
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{where} holds {text.strip()[:40]!r}; expected 16 numbers") from error
    if len(values) != 16 or not all(math.isfinite(value) for value in values):
        raise DataError(f"{where} has {len(values)} values; expected 16 finite numbers, a row-major 4x4 matrix")
    matrix = np.array(values).reshape(4, 4)
    if not are_rigid(matrix[None])[0]:
        raise DataError(f"{where} is not a rigid motion; copy the file again")
    return matrix
