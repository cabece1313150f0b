"""Parts that readers of masks share: from matrices, run lengths and number lists to ``VertexMasks``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError, printable
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Masks
from su3d_bench.predictions.base import MOST_MASKS, MOST_MEMBERS, MOST_POINTS, Numbering, VertexMasks

NO_SCORES = "the file has no scores: 1 for every mask"
ROWS_AT_ONCE = 1 << 16


def vertex_masks(
    where: str,
    members: Iterable[Int32Array],
    n_points: int | None,
    *,
    scores: Float64Array | None = None,
    class_numbers: Int32Array | None = None,
    numbering: Numbering = "id",
    features: Float32Array | None = None,
    keys: Sequence[str] | None = None,
) -> VertexMasks:
    """The masks whose point indices are ``members``; score 1 and keys ``mask 0``, ... where none are given."""
    parts: list[Int32Array] = []
    n = 0
    for part in members:
        n += len(part)
        if n > MOST_MEMBERS:
            raise PredictionError(f"{where}: the masks hold more than {MOST_MEMBERS} points together; is it damaged?")
        parts.append(part)
    masks = Masks.of_sets(parts)
    try:
        return VertexMasks(
            masks.indptr,
            masks.indices,
            n_points=n_points,
            scores=np.ones(len(parts)) if scores is None else scores,
            class_numbers=class_numbers,
            numbering=numbering,
            features=features,
            keys=tuple(keys) if keys is not None else tuple(f"mask {k}" for k in range(len(parts))),
        )
    except PredictionError as error:
        raise PredictionError(f"{where}: {error}") from error


def matrix_of(value: object, where: str, what: str = "the masks") -> NDArray[Any]:
    """``value`` as a matrix of numbers of which none is NaN or infinite."""
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind not in "biuf":
        raise PredictionError(f"{where}: {what} are {kind_of(value)}; expected a matrix of numbers")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise PredictionError(f"{where}: {what} have values that are NaN or infinite; expected 0 and 1")
    return value


def check_sizes(n_points: int, n_masks: int, where: str) -> None:
    """Refuses more points or masks than any scene has, which cost memory even where the masks are empty."""
    if n_points > MOST_POINTS or n_masks > MOST_MASKS:
        raise PredictionError(f"{where}: {n_masks} masks of {n_points} points; is it damaged?")


def column_members(matrix: NDArray[Any], where: str) -> list[Int32Array]:
    """The rows that are not zero in each column of (points, masks)."""
    n_points, n_masks = matrix.shape
    check_sizes(n_points, n_masks, where)
    parts: list[list[Int32Array]] = [[] for _ in range(n_masks)]
    for start in range(0, n_points, ROWS_AT_ONCE):
        part = np.ascontiguousarray((matrix[start : start + ROWS_AT_ONCE] != 0).T)
        for k in range(n_masks):
            parts[k].append((np.flatnonzero(part[k]) + start).astype(np.int32))
    return [np.concatenate([np.zeros(0, np.int32), *part]) for part in parts]


def run_members(length: object, counts: object, where: str) -> Int32Array:
    """The points of a run-length mask: ``counts`` are start, length, start, length, ... with starts from 1 on.

    ``counts`` may be a text, a list or an array, as the programs write it.
    """
    if isinstance(length, bool) or not isinstance(length, int | np.integer) or not 0 <= length <= MOST_POINTS:
        raise PredictionError(f"{where}: 'length' is {kind_of(length)}; expected the number of points")
    runs = _run_numbers(counts, where).reshape(-1, 2)
    starts, sizes = runs[:, 0] - 1, runs[:, 1]
    is_wrong = (starts < 0) | (sizes < 0) | (starts > length) | (sizes > length - starts)
    is_wrong[1:] |= starts[1:] < starts[:-1] + sizes[:-1]
    if is_wrong.any():
        start, size = (int(number) for number in runs[int(np.argmax(is_wrong))])
        raise PredictionError(
            f"{where}: run of {size} points from {start} on, of {length} points; runs count from 1 and ascend"
        )
    before = np.cumsum(sizes) - sizes
    members: Int32Array = np.arange(int(sizes.sum()), dtype=np.int32)
    members += np.repeat((starts - before).astype(np.int32), sizes)
    return members


def _run_numbers(counts: object, where: str) -> NDArray[np.int64]:
    try:
        values = [int(word) for word in counts.split()] if isinstance(counts, str) else counts
        if isinstance(values, list | tuple) and all(type(value) is int for value in values):
            values = np.array(values, np.int64)
    except (ValueError, OverflowError) as error:
        raise PredictionError(f"{where}: the runs are no numbers") from error
    numbers = values if isinstance(values, np.ndarray) else np.array("")
    if not numbers.size:
        return np.zeros(0, np.int64)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) % 2:
        raise PredictionError(f"{where}: the runs are {kind_of(counts)}; expected pairs of start and length")
    if int(numbers.max()) > MOST_POINTS or int(numbers.min()) < 0:
        raise PredictionError(f"{where}: a run with {int(numbers.max())}; is it damaged?")
    return numbers.astype(np.int64)


def scores_of(value: object, n_masks: int, where: str) -> Float64Array:
    """Scores, one a mask."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf" or value.shape != (n_masks,):
        raise PredictionError(f"{where}: {n_masks} masks, but the scores are {kind_of(value)}")
    return value.astype(np.float64)


def classes_of(value: object, n_masks: int, where: str) -> Int32Array:
    """Class numbers, one a mask, from an array of integers or of floats without a fraction."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf" or value.shape != (n_masks,):
        raise PredictionError(f"{where}: {n_masks} masks, but the classes are {kind_of(value)}")
    is_whole = np.isfinite(value) & (np.abs(value.astype(np.float64)) < 1 << 31)
    is_whole[is_whole] = value[is_whole] == np.floor(value[is_whole])
    if not is_whole.all():
        worst = int(np.argmin(is_whole))
        raise PredictionError(f"{where}: mask {worst} has class {value[worst]}; expected an integer")
    return value.astype(np.int32)


def kind_of(value: object) -> str:
    """What a value out of a file is, for messages."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} {value.dtype.name}"
    return printable(str(value), 40) if isinstance(value, int | float) else f"a {type(value).__name__}"
