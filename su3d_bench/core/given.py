"""What somebody hands over for a map, brought into arrays; a ``PredictionError`` says what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import PredictionError

KINDS = {"U": "texts", "O": "objects"}


def points_given(points: Any) -> NDArray[Any]:
    """Points (M, 3), of floats."""
    array = _array("points", points)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f":
        raise PredictionError(f"instances: points are {_described(array)}; floats (M, 3) in metres are expected")
    return array


def sets_given(masks: Any, n_points: int) -> list[NDArray[Any]]:
    """The points of each mask, ascending and each once; ``Instances.of`` says what ``masks`` may be."""
    if isinstance(masks, np.ndarray) and masks.ndim == 1 and masks.dtype.kind in "iub":
        return _of_owners(masks, n_points)
    if masks is None or not isinstance(masks, Iterable):
        raise PredictionError(
            f"instances: masks is {_named(masks)}; a list of point indices or bools of each instance is expected"
        )
    return [_set_given(k, mask, n_points) for k, mask in enumerate(masks)]


def _of_owners(owners: NDArray[Any], n_points: int) -> list[NDArray[Any]]:
    if owners.dtype.kind == "b" or len(owners) != n_points:
        raise PredictionError(
            f"instances: masks is one array, {_described(owners)}; a list of masks is expected, or of each of the "
            f"{n_points} points the number of its instance"
        )
    if not len(owners):
        return []
    if owners.min() < -1 or owners.max() >= n_points:
        raise PredictionError(
            f"instances: masks holds numbers {owners.min()} to {owners.max()}; instances are numbered from 0 on "
            f"without gaps, -1 is none, and there are {n_points} points"
        )
    owners = owners.astype(np.int64)
    order = np.argsort(owners, kind="stable")
    ends = np.cumsum(np.bincount(owners + 1, minlength=1))
    sets: list[NDArray[Any]] = np.split(order, ends)[1:-1]
    if empty := [k for k, members in enumerate(sets) if not len(members)]:
        raise PredictionError(
            f"instances: masks numbers no point {empty[0]}, but higher ones; number them without gaps"
        )
    return sets


def _set_given(k: int, mask: Any, n_points: int) -> NDArray[Any]:
    array = _array(f"the mask of instance {k}", mask)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iub"):
        raise PredictionError(
            f"instances: the mask of instance {k} is {_described(array)}; indices of points, or a bool for each of the "
            f"{n_points} points are expected"
        )
    if array.dtype.kind == "b":
        if len(array) != n_points:
            raise PredictionError(f"instances: the mask of instance {k} has {len(array)} bools for {n_points} points")
        return np.flatnonzero(array)
    if not array.size:
        return np.zeros(0, np.int32)
    return np.unique(array) if (array[1:] <= array[:-1]).any() else array


def scores_given(scores: Any, n: int) -> NDArray[Any]:
    """One score an instance; 1 where none are given."""
    if scores is None:
        return np.ones(n)
    array = _array("scores", scores)
    if array.shape != (n,) or (n and array.dtype.kind not in "fiub"):
        raise PredictionError(
            f"instances: scores are {_described(array)}; one number for each of {n} masks is expected"
        )
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def features_given(features: Any, n: int) -> NDArray[Any] | None:
    """One feature an instance; None where none are given, or there is no instance."""
    if features is None:
        return None
    array = _array("features", features)
    if not n and array.ndim == 1:
        return None
    if array.ndim != 2 or len(array) != n or array.dtype.kind != "f":
        raise PredictionError(
            f"instances: features are {_described(array)}; floats ({n}, D), one row a mask, are expected"
        )
    return array


def views_given(views: Sequence[Sequence[tuple[int, int]]] | None, n: int) -> NDArray[np.int32]:
    """The views (V, 2) of all instances, one after another."""
    if views is None:
        return np.zeros((0, 2), np.int32)
    if len(views) != n:
        raise PredictionError(f"instances: views of {len(views)} instances for {n} masks")
    rows = [view for of_instance in views for view in of_instance]
    array = _array("views", rows if rows else np.zeros((0, 2), np.int32))
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        raise PredictionError(
            f"instances: views are {_described(array)}; pairs of integers, frame index and row, are expected"
        )
    return array.astype(np.int32)


def _array(name: str, value: Any) -> NDArray[Any]:
    try:
        return np.asarray(value)
    except (ValueError, TypeError) as error:  # rows of several lengths
        raise PredictionError(f"instances: {name}: is no array: {error}") from error


def _described(array: NDArray[Any]) -> str:
    return f"{KINDS.get(array.dtype.kind, array.dtype.name)} {array.shape}"


def _named(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
