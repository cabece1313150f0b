"""Objects and relations of scene graphs as additive counts: how many there are, and how many are found at rank 1.

Source: Merging/evaluate.py of FROSS (Howardkhh/FROSS at 645153b), which scores ReplicaSSG, by the recall of Wu et al.
(ShunChengWu/3DSSG, ssg/utils/util_eva.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.metric import Arrays, Counts
from su3d_bench.numerics.statistics import nan_mean

NAMES = ("object R@1", "predicate R@1", "relationship R@1", "object mR@1", "predicate mR@1")


@dataclass(frozen=True)
class RelationCounts(Counts):
    """What a scene adds: true objects of each class (C,) and true relations of each predicate (P,), and of these how
    many objects got their class, relations their predicate, and relations subject, predicate and object right."""

    stored_as = "relations"
    arrays: ClassVar[Arrays] = {
        "n_objects": ("i", ("classes",)),
        "n_objects_found": ("i", ("classes",)),
        "n_relations": ("i", ("predicates",)),
        "n_predicates_found": ("i", ("predicates",)),
        "n_triplets_found": ("i", ("predicates",)),
    }

    n_objects: Int64Array
    n_objects_found: Int64Array
    n_relations: Int64Array
    n_predicates_found: Int64Array
    n_triplets_found: Int64Array

    def contradiction(self) -> str | None:
        """More that is found than there is, or triplets without their predicate."""
        pairs = (
            ("n_objects_found", "n_objects"),
            ("n_predicates_found", "n_relations"),
            ("n_triplets_found", "n_predicates_found"),
        )
        for part, whole in pairs:
            if (getattr(self, part) > getattr(self, whole)).any():
                return f"'{part}' has more than '{whole}'"
        return None


def resampled(counts: Sequence[RelationCounts], weights: Int64Array) -> dict[str, Float64Array]:
    """Each array of the counts (R, C or P) over the scenes drawn ``weights`` (R, S) times."""
    drawn = weights.astype(np.float64)
    return {
        name: drawn @ np.stack([getattr(of_scene, name) for of_scene in counts]).astype(np.float64)
        for name in RelationCounts.arrays
    }


def recalls(sums: dict[str, Float64Array]) -> dict[str, Float64Array]:
    """The recalls (R,) of sums of counts (R, C or P); NaN where nothing is true. ``mR`` is the mean over what is true.

    >>> one = RelationCounts(*(np.array(n, np.int64) for n in ([2, 1], [2, 0], [4], [2], [1])))
    >>> {name: value.tolist() for name, value in recalls(resampled([one], np.ones((1, 1), np.int64))).items()}
    ... # doctest: +NORMALIZE_WHITESPACE
    {'object R@1': [0.6666666666666666], 'predicate R@1': [0.5], 'relationship R@1': [0.25], 'object mR@1': [0.5],
     'predicate mR@1': [0.5]}
    """
    of_class = ratio(sums["n_objects_found"], sums["n_objects"])
    of_predicate = ratio(sums["n_predicates_found"], sums["n_relations"])
    n_relations = sums["n_relations"].sum(axis=1)
    values = (
        ratio(sums["n_objects_found"].sum(axis=1), sums["n_objects"].sum(axis=1)),
        ratio(sums["n_predicates_found"].sum(axis=1), n_relations),
        ratio(sums["n_triplets_found"].sum(axis=1), n_relations),
        np.array([nan_mean(row) for row in of_class]),
        np.array([nan_mean(row) for row in of_predicate]),
    )
    return dict(zip(NAMES, values, strict=True))


def ratio(part: Float64Array, whole: Float64Array) -> Float64Array:
    """Shares, NaN of nothing."""
    answer: Float64Array = np.divide(part, whole, out=np.full(part.shape, np.nan), where=whole > 0)
    return answer
