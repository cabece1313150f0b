"""What one scene adds to a protocol's numbers, and what the ways of scoring share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Instances, Int64Array, Prediction
from su3d_bench.metrics.results.results import Counts


@dataclass(frozen=True)
class SceneScore:
    """What one scene adds to a protocol's numbers, with what a reader must know about it.

    ``n_scored`` points of the truth count; ``n_farther`` (3,) of them have no predicted point within 2.5, 5 and 10 cm.
    """

    protocol: str
    version: int
    counts: Counts
    n_predictions: int
    n_scored: int
    n_farther: Int64Array
    warnings: tuple[str, ...]


def present(class_index: Int64Array, n_classes: int) -> BoolArray:
    """Which classes have points (C,); negative indices are none."""
    return np.bincount(class_index[class_index >= 0], minlength=n_classes) > 0


def n_predictions(prediction: Prediction) -> int:
    """How many instances, or rows of features, a prediction has."""
    return len(prediction) if isinstance(prediction, Instances) else len(prediction.features)
