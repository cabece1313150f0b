"""What every kind of metric is: the additive counts of a scene, and the numbers that counts of scenes come to."""

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
from su3d_bench.metrics.matching.nearest import n_farther
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.numerics.statistics import nan_mean, ratio

MAX_COUNTED = 1 << 53  # numbers beyond it are not whole any more where ratios are formed
Values = dict[str, float]
C = TypeVar("C", bound="Counts")
ROWS = "rows"  # the axis along which scenes are put one after another; along all others they are summed
NUMBER_KINDS = {"Int64Array": "i", "Int32Array": "i", "Float64Array": "f", "BoolArray": "b"}


def axes(*names: str) -> dict[str, tuple[str, ...]]:
    """The metadata of an array of counts: its axes, of which those of one name are equally long."""
    return {"axes": names}


@dataclass(frozen=True)
class Counts:
    """What scenes add to a protocol's numbers, as arrays with ``axes``; ``stored_as`` names the kind in files."""

    stored_as: ClassVar[str]

    @classmethod
    @cache
    def arrays(cls) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Of each array the kind of its numbers and its axes."""
        return {array.name: (NUMBER_KINDS[str(array.type)], array.metadata["axes"]) for array in fields(cls)}

    @classmethod
    def joined(cls, counts: Sequence[Self]) -> Self:
        """The counts of several scenes as one: rows one after another, numbers summed in order, flags of any scene."""
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
        """The counts in ``arrays``; a ``DataError`` names one that no scene gives: of another kind or shape than it
        must be, below 0, or that another one contradicts."""
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
        """A clause on what cannot be true of these counts; None where all can."""
        return None

    @property
    def sizes(self) -> dict[str, int]:
        """How long each axis is."""
        return {
            axis: n
            for name, (_, names) in self.arrays().items()
            for axis, n in zip(names, getattr(self, name).shape, strict=True)
        }


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


@dataclass(frozen=True)
class Pooled:
    """The metrics of all scenes together, of each class and of each group of classes, and what a reader must know."""

    values: Values
    classes: dict[str, Values] = field(default_factory=dict)
    groups: dict[str, Values] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


class Metric(ABC, Generic[C]):
    """One kind of protocol under its rules: what a scene counts, and the ratios that counts of scenes come to.

    ``truth``: what ``per_scene`` takes; ``counts``: what it gives. Ratios are formed in ``pooled``, ``combine_each``
    and ``resampled`` alone.
    """

    truth: ClassVar[type]
    counts: ClassVar[type[Counts]]

    def __init__(self, rules: ProtocolRules) -> None:
        self.rules = rules

    @abstractmethod
    def per_scene(self, truth: Any, prediction: Any, encoder: Encoder | None) -> SceneScore:
        """The additive counts of one scene; ``encoder`` names features of predictions that bring no labels."""

    def score(
        self, counts: C, prediction: Prediction, distance_m: Float64Array, warnings: Iterable[str | None]
    ) -> SceneScore:
        """The score of a scene whose scored points are ``distance_m`` from the nearest point of the prediction."""
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
        """Why it is not known what perfect masks would score; None where it is, or where nobody would ask."""
        return None

    @property
    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """How long the axes of the counts are that the rules fix."""

    def pooled(self, counts: Sequence[C]) -> Pooled:
        """The numbers of the scenes together."""
        return Pooled(self.values_once(counts))

    def values_once(self, counts: Sequence[C]) -> Values:
        """The values of ``resampled`` with each scene drawn once."""
        return first_row(self.resampled(counts, np.ones((1, len(counts)), np.int64)))

    @abstractmethod
    def resampled(self, counts: Sequence[C], weights: Int64Array) -> Mapping[str, Float64Array]:
        """The metrics (R,) of the scenes drawn ``weights`` (R, S) times, pooled."""

    def resampled_classes(self, counts: Sequence[C], weights: Int64Array) -> dict[str, dict[str, Float64Array]]:
        """Class -> column -> value (R,) of the scenes drawn ``weights`` (R, S) times; NaN where it has no truth there.

        With weights of ones this is the value over all scenes, with a single one that of a scene alone.
        """
        return {}

    def class_columns(
        self, tables: Mapping[str, Float64Array], is_kept: BoolArray
    ) -> dict[str, dict[str, Float64Array]]:
        """Class -> column -> value (R,) from ``tables`` (R, C) of the scored classes, for those that are kept (C,)."""
        return {
            entry.name: {name: table[:, c] for name, table in tables.items()}
            for c, entry in enumerate(self.rules.scored)
            if is_kept[c]
        }

    def group_means(self, classes: Mapping[str, Values], columns: Mapping[str, str]) -> dict[str, Values]:
        """Of each group the means over its classes that have a value; ``columns``: name of the mean -> of the value."""
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
        """The metrics of the scenes together."""
        return self.pooled(counts).values

    def combine_each(self, counts: Sequence[C]) -> list[Values]:
        """The metrics of each scene alone."""
        return [self.combine([of_scene]) for of_scene in counts]

    def reported(self, counts: Sequence[C]) -> Values:
        """The metrics that the protocol reports: pooled, or the mean over scenes."""
        return self.combine(counts) if self.rules.aggregate == "pooled" else scene_mean(self.combine_each(counts))

    def resampled_headline(
        self, counts: Sequence[C], rows: Sequence[Mapping[str, float]], weights: Int64Array
    ) -> dict[str, Float64Array]:
        """Each headline metric (R,) of the scenes drawn ``weights`` (R, S) times, pooled or as the mean over scenes.

        ``rows`` hold the metrics of each scene alone, from which the mean over scenes is formed. With weights of ones
        this is the value over all scenes, with a single one that of a scene alone.
        """
        names = self.rules.headline
        if self.rules.aggregate == "scene-mean":
            return {name: _weighted_mean(np.array([row[name] for row in rows]), weights) for name in names}
        values = self.resampled(counts, weights)
        return {name: values[name] for name in names}

    def check(self, scene: str, counts: Counts) -> None:
        """A ``DataError`` where counts have other classes, thresholds or values than the rules."""
        has = counts.sizes
        for axis, n in self.sizes.items():
            if has.get(axis, 0) != n:
                raise DataError(
                    f"{scene}: was scored with {has.get(axis, 0)} {axis}, {self.rules.name} has {n} here; "
                    "score it again"
                )


def scene_mean(rows: Collection[Mapping[str, float]]) -> Values:
    """The mean of each metric over scenes, without those where it is NaN."""
    return {name: nan_mean(np.array([row[name] for row in rows])) for name in next(iter(rows))}


def _weighted_mean(values: Float64Array, weights: Int64Array) -> Float64Array:
    is_number = ~np.isnan(values)
    drawn = weights[:, is_number].astype(np.float64)
    return ratio((drawn * values[is_number]).sum(axis=1), drawn.sum(axis=1))


def first_row(values: Mapping[str, Float64Array]) -> Values:
    """Of each value (R,) the first."""
    return {name: float(value[0]) for name, value in values.items()}


def present(class_index: Int64Array, n_classes: int) -> BoolArray:
    """Which classes have points (C,); negative indices are none."""
    return np.bincount(class_index[class_index >= 0], minlength=n_classes) > 0


def n_predictions(prediction: Prediction) -> int:
    """How many instances, or rows of features, a prediction has."""
    return len(prediction) if isinstance(prediction, Instances) else len(prediction.features)
