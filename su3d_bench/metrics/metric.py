"""The base of all metrics: additive counts per scene, and the values computed from the counts of scenes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, reduce
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.matching.transfer import n_farther
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.numerics.statistics import nan_mean, ratio

MAX_COUNTED = 1 << 53  # larger integers are not exact in the float64 of ratios
Values = dict[str, float]
C = TypeVar("C", bound="Counts")
ROWS = "rows"  # the axis along which scenes are concatenated; along all others they are summed
NUMBER_KINDS = {"Int64Array": "i", "Int32Array": "i", "Float64Array": "f", "BoolArray": "b"}


def axes(*names: str) -> dict[str, tuple[str, ...]]:
    """The metadata of an array of counts: its axes; axes of the same name have the same length."""
    return {"axes": names}


@dataclass(frozen=True)
class Counts:
    """The counts of scenes under a protocol, as arrays with ``axes``; ``stored_as`` names the kind in files."""

    stored_as: ClassVar[str]

    @classmethod
    @cache
    def arrays(cls) -> dict[str, tuple[str, tuple[str, ...]]]:
        """The dtype kind and axes of each array."""
        return {array.name: (NUMBER_KINDS[str(array.type)], array.metadata["axes"]) for array in fields(cls)}

    @classmethod
    def joined(cls, counts: Sequence[Self]) -> Self:
        """The joined counts of several scenes: rows concatenated, numbers summed in order, flags combined with *or*."""
        whole: dict[str, NDArray[Any]] = {}
        for name, (number_kind, names) in cls.arrays().items():
            parts = [getattr(of_scene, name) for of_scene in counts]
            if names[0] == ROWS:
                whole[name] = np.concatenate(parts)
            else:
                whole[name] = reduce(np.logical_or if number_kind == "b" else np.add, parts)
        return cls(**whole)

    @classmethod
    def drawn(cls, counts: Sequence[Self], weights: Int64Array, *names: str) -> dict[str, Float64Array]:
        """The arrays ``names``, or all, summed (R, ...) over the scenes drawn ``weights`` (R, S) times."""
        drawn = weights.astype(np.float64)
        return {
            name: drawn @ np.stack([getattr(of_scene, name) for of_scene in counts]).astype(np.float64)
            for name in names or cls.arrays()
        }

    @classmethod
    def checked(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The counts in ``arrays``; ``DataError`` names an impossible one: of a wrong kind or shape, below 0, or
        contradicted by another."""
        sizes: dict[str, int] = {}
        for name, (number_kind, names) in cls.arrays().items():
            array = arrays[name]
            fits = array.dtype.kind == number_kind and array.ndim == len(names)
            if not fits or any(sizes.setdefault(axis, n) != n for axis, n in zip(names, array.shape, strict=True)):
                raise DataError(f"counts: '{name}' is {array.dtype.name} {array.shape}; score the scene again")
            if number_kind == "i" and array.size and not 0 <= array.min() <= array.max() < MAX_COUNTED:
                raise DataError(f"counts: '{name}' counts from {array.min()} to {array.max()}; score the scene again")
        counts = cls(**{name: arrays[name] for name in cls.arrays()})
        if (fault := counts.contradiction()) is not None:
            raise DataError(f"counts: {fault}; score the scene again")
        return counts

    def contradiction(self) -> str | None:
        """A clause on what is impossible in these counts; None if nothing is."""
        return None

    @property
    def has_match(self) -> bool:
        """Whether any mask matched an object; True for kinds that do not match masks."""
        return True

    @property
    def sizes(self) -> dict[str, int]:
        """The length of each axis."""
        return {
            axis: n
            for name, (_, names) in self.arrays().items()
            for axis, n in zip(names, getattr(self, name).shape, strict=True)
        }


@dataclass(frozen=True)
class SceneScore:
    """The counts of one scene under a protocol, with warnings.

    ``n_scored`` ground-truth points count; ``n_farther`` (3,) of them have no predicted point within 2.5, 5 and 10 cm.
    """

    protocol: str
    version: int
    counts: Counts
    n_predictions: int
    n_scored: int
    n_farther: Int64Array
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Pooled:
    """The metrics over all scenes, per class and per group of classes, with warnings."""

    values: Values
    classes: dict[str, Values] = field(default_factory=dict)
    groups: dict[str, Values] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


class Metric(ABC, Generic[C]):
    """One kind of protocol with its rules: the counts of a scene, and the ratios computed from counts of scenes.

    ``truth``: the type that ``per_scene`` takes; ``counts``: the type it returns. Ratios are computed only in
    ``pooled``, ``combine_each`` and ``resampled``.
    """

    truth: ClassVar[type]
    counts: ClassVar[type[Counts]]

    def __init__(self, rules: ProtocolRules) -> None:
        self.rules = rules

    @abstractmethod
    def per_scene(self, truth: Any, prediction: Any, encoder: Encoder | None) -> SceneScore:
        """The additive counts of one scene; ``encoder`` classifies the features of predictions without labels."""

    def score(
        self, counts: C, prediction: Prediction, distance_m: Float64Array, warnings: Iterable[str | None]
    ) -> SceneScore:
        """The score of a scene whose scored points are ``distance_m`` away from the nearest predicted point."""
        return SceneScore(
            protocol=self.rules.name,
            version=self.rules.version,
            counts=counts,
            n_predictions=n_predictions(prediction),
            n_scored=len(distance_m),
            n_farther=n_farther(distance_m),
            warnings=tuple(warning for warning in warnings if warning),
        )

    @property
    def ceiling_remark(self) -> str | None:
        """Why the score of perfect masks is unknown; None if it is known or irrelevant."""
        return None

    @property
    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """The lengths of the axes of the counts that the rules determine."""

    def pooled(self, counts: Sequence[C]) -> Pooled:
        """The values over all scenes together."""
        return Pooled(self.values_once(counts))

    def values_once(self, counts: Sequence[C]) -> Values:
        """The values of ``resampled`` with each scene drawn once."""
        return first_row(self.resampled(counts, np.ones((1, len(counts)), np.int64)))

    @abstractmethod
    def resampled(self, counts: Sequence[C], weights: Int64Array) -> Mapping[str, Float64Array]:
        """The metrics (R,) of the scenes drawn ``weights`` (R, S) times, pooled."""

    def resampled_classes(self, counts: Sequence[C], weights: Int64Array) -> dict[str, dict[str, Float64Array]]:
        """Class -> column -> value (R,) of the scenes drawn ``weights`` (R, S) times; NaN without ground truth there.

        Weights of ones give the value over all scenes, a single one that of one scene.
        """
        return {}

    def class_columns(
        self, tables: Mapping[str, Float64Array], is_kept: BoolArray
    ) -> dict[str, dict[str, Float64Array]]:
        """Class -> column -> value (R,) from ``tables`` (R, C) of the scored classes, for the kept ones (C,)."""
        return {
            entry.name: {name: table[:, c] for name, table in tables.items()}
            for c, entry in enumerate(self.rules.scored)
            if is_kept[c]
        }

    def group_means(self, classes: Mapping[str, Values], columns: Mapping[str, str]) -> dict[str, Values]:
        """For each group the means over its classes with a value; ``columns``: name of the mean -> of the value."""
        rows: dict[str, list[Values]] = {}
        for entry in self.rules.scored:
            if entry.group:
                rows.setdefault(entry.group, []).append(classes.get(entry.name, {}))
        return {
            group: {
                name: nan_mean(np.array([row.get(column, np.nan) for row in of_group]))
                for name, column in columns.items()
            }
            for group, of_group in rows.items()
        }

    def combine(self, counts: Sequence[C]) -> Values:
        """The metrics over all scenes together."""
        return self.pooled(counts).values

    def combine_each(self, counts: Sequence[C]) -> list[Values]:
        """The metrics of each scene."""
        return [self.combine([of_scene]) for of_scene in counts]

    def reported(self, counts: Sequence[C]) -> Values:
        """The metrics that the protocol reports: pooled, or the mean over scenes."""
        return self.combine(counts) if self.rules.aggregate == "pooled" else scene_mean(self.combine_each(counts))

    def resampled_headline(
        self, counts: Sequence[C], rows: Sequence[Mapping[str, float]], weights: Int64Array
    ) -> dict[str, Float64Array]:
        """Each headline metric (R,) of the scenes drawn ``weights`` (R, S) times, pooled or as the mean over scenes.

        ``rows`` are the metrics of each scene, from which the mean over scenes is computed. Weights of ones give the
        value over all scenes, a single one that of one scene.
        """
        names = self.rules.headline
        if self.rules.aggregate == "scene-mean":
            return {name: _weighted_mean(np.array([row[name] for row in rows]), weights) for name in names}
        values = self.resampled(counts, weights)
        return {name: values[name] for name in names}

    def check(self, scene: str, counts: Counts) -> None:
        """``DataError`` if counts have other classes, thresholds or values than the rules."""
        has = counts.sizes
        for axis, n in self.sizes.items():
            if has.get(axis, 0) != n:
                raise DataError(
                    f"{scene}: was scored with {has.get(axis, 0)} {axis}, {self.rules.name} has {n} here; "
                    "score it again"
                )


def scene_mean(rows: Collection[Mapping[str, float]]) -> Values:
    """The mean of each metric over scenes, ignoring NaN."""
    return {name: nan_mean(np.array([row[name] for row in rows])) for name in next(iter(rows))}


def _weighted_mean(values: Float64Array, weights: Int64Array) -> Float64Array:
    is_number = ~np.isnan(values)
    drawn = weights[:, is_number].astype(np.float64)
    return ratio((drawn * values[is_number]).sum(axis=1), drawn.sum(axis=1))


def first_row(values: Mapping[str, Float64Array]) -> Values:
    """The first entry of each value (R,)."""
    return {name: float(value[0]) for name, value in values.items()}


def present(class_index: Int64Array, n_classes: int) -> BoolArray:
    """Which classes have points (C,); negative indices are none."""
    return np.bincount(class_index[class_index >= 0], minlength=n_classes) > 0


def n_predictions(prediction: Prediction) -> int:
    """The number of instances, or rows of features, of a prediction."""
    return len(prediction) if isinstance(prediction, Instances) else len(prediction.features)
