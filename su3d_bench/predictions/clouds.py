"""Parts that readers of maps with own points share: from the cloud of each object to ``Instances``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError, shown
from su3d_bench.core.types import Float32Array, Instances, Masks, starts_of
from su3d_bench.predictions.base import MOST_MASKS, MOST_POINTS
from su3d_bench.predictions.mask_arrays import kind_of

ONES = "the format has no scores: 1 for every object"


@contextmanager
def as_prediction_error() -> Iterator[None]:
    """Damage that a reader of data files finds is damage of the prediction."""
    try:
        yield
    except DataError as error:
        raise PredictionError(str(error)) from error


def checked_points(values: object, where: str) -> Float32Array:
    """Points (N, 3) as float32; ``PredictionError`` for another shape, and for what float32 metres cannot hold."""
    is_table = isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] == 3
    if not isinstance(values, np.ndarray) or not is_table or values.dtype.kind not in "fiu":
        raise PredictionError(f"{where}: the points are {kind_of(values)}; expected three coordinates a point")
    if len(values) > MOST_POINTS:
        raise PredictionError(f"{where}: has {len(values)} points; is it damaged?")
    with np.errstate(over="ignore", invalid="ignore"):
        points = values.astype(np.float32)
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        raise PredictionError(f"{where}: point {row} is at {values[row].tolist()}; expected finite metres")
    return points


def feature_table(value: object, file: Path) -> Float32Array:
    """A row of features an object, as float32."""
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind != "f" or not value.shape[1]:
        raise PredictionError(f"{shown(file)}: holds {kind_of(value)}; expected a row of features an object")
    with np.errstate(over="ignore", invalid="ignore"):
        return value.astype(np.float32, copy=False)


def without_nonfinite(features: Float32Array, what: str) -> tuple[Float32Array, tuple[str, ...]]:
    """``features`` with rows of zeros in place of rows that hold NaN or infinity, and how many rows have no feature."""
    is_bad = ~np.isfinite(features).all(axis=1)
    if is_bad.any():
        features = features.copy()
        features[is_bad] = 0
    n = int((~features.any(axis=1)).sum())
    return features, (f"{n} {what} have no feature (a row of zeros or NaN)",) if n else ()


def instances_of(
    clouds: Sequence[Float32Array],
    where: str,
    *,
    features: Float32Array | None,
    labels: tuple[str, ...] | None,
    names: tuple[str, ...],
    captions: tuple[str, ...],
    ids: Sequence[int],
) -> Instances:
    """One instance a cloud, each with points of its own, score 1 and no views; boxes of empty clouds are zeros."""
    sizes = np.array([len(cloud) for cloud in clouds], np.int64)
    n = int(sizes.sum())
    if n > MOST_POINTS or len(clouds) > MOST_MASKS:
        raise PredictionError(f"{where}: {len(clouds)} objects of {n} points; is it damaged?")
    points = np.concatenate([np.zeros((0, 3), np.float32), *clouds])
    masks = Masks(starts_of(sizes), np.arange(n, dtype=np.int32))
    return Instances.of(points, masks, None, features, labels=labels, names=names, captions=captions, ids=ids)


def some(numbers: Sequence[int]) -> str:
    """The first of ``numbers`` for a message.

    >>> some([1, 2, 3, 4, 5, 6])
    '1, 2, 3, 4, 5, ...'
    """
    return ", ".join(str(number) for number in numbers[:5]) + (", ..." if len(numbers) > 5 else "")
