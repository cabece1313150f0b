"""What a reader of predictions gives, whatever the format: masks, labels or a map of one scene, with remarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.types import (
    DenseFeatures,
    Float32Array,
    Float64Array,
    Instances,
    Int32Array,
    Masks,
    Partition,
)

Numbering = Literal["id", "index"]
MOST_POINTS = 100_000_000  # points of one scene; the largest scans of rooms have some millions
MOST_MASKS = 100_000  # of one scene; methods give some hundred
MOST_MEMBERS = (
    200_000_000  # points of all masks of a scene together; 600 masks of a large ScanNet scene have 10 million
)


@dataclass(frozen=True, kw_only=True)
class VertexMasks(Masks):
    """Masks over the points of the ground truth, in its order; the file has no coordinates.

    ``n_points`` is None where the file does not say it (a list without masks). ``scores`` (K,) are finite.
    ``class_numbers`` (K,) are as the file has them, None where it has no classes: with ``numbering`` "id" class ids of
    the label space, with "index" positions in the protocol's list of classes. ``features`` (K, D), all-zero rows have
    none. ``keys`` name the masks in messages.
    """

    n_points: int | None
    scores: Float64Array
    class_numbers: Int32Array | None = None
    numbering: Numbering = "id"
    features: Float32Array | None = None
    keys: tuple[str, ...]

    def __post_init__(self) -> None:
        k = len(self.keys)
        if self.indptr.shape != (k + 1,) or self.indptr[0] != 0 or (self.sizes < 0).any():
            raise PredictionError(f"{k} masks: indptr of {self.indptr.shape} does not describe them")
        if not self.is_whole or (self.n_points is None and k):
            raise PredictionError(f"{k} masks: {len(self.indices)} indices, {self.n_points} points")
        if self.scores.shape != (k,) or (self.class_numbers is not None and self.class_numbers.shape != (k,)):
            raise PredictionError(f"{k} masks, but scores of {self.scores.shape} or classes of another number")
        if self.features is not None and (self.features.ndim != 2 or len(self.features) != k):
            raise PredictionError(f"{k} masks, but features of {self.features.shape}; expected one row a mask")
        if not np.isfinite(self.scores).all():
            worst = int(np.flatnonzero(~np.isfinite(self.scores))[0])
            raise PredictionError(f"mask '{self.keys[worst]}': the score is {self.scores[worst]}; it must be finite")
        self._check_indices()

    def _check_indices(self) -> None:
        if not len(self.indices):
            return
        is_start = np.zeros(len(self.indices), np.bool_)
        is_start[self.indptr[:-1][self.sizes > 0]] = True
        is_wrong = (self.indices < 0) | (self.indices >= (self.n_points or 0))
        is_wrong[1:] |= (np.diff(self.indices) <= 0) & ~is_start[1:]
        if is_wrong.any():
            worst = int(np.argmax(is_wrong))
            raise PredictionError(
                f"mask '{self.keys[self.owner_at(worst)]}': point {int(self.indices[worst])} is out of range or out of "
                f"order, the scene has {self.n_points} points"
            )


@dataclass(frozen=True)
class VertexLabels:
    """One class id a point of the ground truth, in its order."""

    class_ids: Int32Array


Content = VertexMasks | VertexLabels | Instances | Partition | DenseFeatures  # the last three have their own points


@dataclass(frozen=True)
class ScenePrediction:
    """What one scene's files say; ``remarks`` are what a reader of the number must know."""

    scene: str
    format: str
    path: Path
    content: Content
    remarks: tuple[str, ...] = ()


class Reader(Protocol):
    """One format of predictions."""

    @property
    def name(self) -> str: ...

    @property
    def summary(self) -> str:
        """One line for lists: whose format, which files."""
        ...

    def recognise(self, path: Path) -> str | None:
        """Why ``path`` is of this format, from names and first bytes alone; None where it is not."""
        ...

    def scenes(self, path: Path) -> Mapping[str, Path]:
        """The file or folder of each scene, by the name that the files give it."""
        ...

    def read(self, path: Path, scene: str) -> ScenePrediction:
        """The prediction of one of ``scenes(path)``; ``PredictionError`` where it cannot be used."""
        ...
