"""What arrays the counts of a scene are made of, for counts that come from a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.open_vocabulary.object_means import ObjectCounts
from su3d_bench.metrics.protocols import VALUES_OF_METRIC, ProtocolRules
from su3d_bench.metrics.questions.shares import ShareCounts
from su3d_bench.metrics.results.results import Counts
from su3d_bench.metrics.semantic.confusion import SemanticCounts

# Of each array: the kind of its numbers and its axes; axes of one name are equally long.
ARRAYS: dict[type[Counts], dict[str, tuple[str, tuple[str, ...]]]] = {
    SemanticCounts: {"confusion": ("i", ("classes", "columns")), "is_present": ("b", ("classes",))},
    InstanceCounts: {
        "class_index": ("i", ("rows",)),
        "threshold_index": ("i", ("rows",)),
        "score": ("f", ("rows",)),
        "is_true": ("b", ("rows",)),
        "n_missed": ("i", ("classes", "thresholds")),
        "n_truth": ("i", ("classes",)),
        "n_small_truth": ("i", ("classes",)),
        "n_predictions": ("i", ("classes",)),
    },
    ObjectCounts: {"n_points": ("i", ("objects",)), "totals": ("f", ("objects", "values"))},
    ShareCounts: {"n_judged": ("i", ("values",)), "n_right": ("i", ("values",))},
}


def checked_counts(kind: type[Counts], arrays: Mapping[str, NDArray[Any]]) -> Counts:
    """The counts of that kind; a ``DataError`` names the array that is of another kind or shape than it must be."""
    sizes: dict[str, int] = {}
    for name, (number_kind, axes) in ARRAYS[kind].items():
        array = arrays[name]
        fits = array.dtype.kind == number_kind and array.ndim == len(axes)
        if not fits or any(sizes.setdefault(axis, n) != n for axis, n in zip(axes, array.shape, strict=True)):
            raise DataError(f"counts: '{name}' is {array.dtype.name} {array.shape}; score the scene again")
    for name, axis in (("class_index", "classes"), ("threshold_index", "thresholds")):
        index = arrays.get(name, np.zeros(0, np.int32)) if axis in sizes else np.zeros(0, np.int32)
        if len(index) and not 0 <= index.min() <= index.max() < sizes[axis]:
            raise DataError(f"counts: '{name}' counts beyond the {sizes[axis]} {axis}; score the scene again")
    if not np.isfinite(arrays.get("score", 0.0)).all():
        raise DataError("counts: 'score' has values that are NaN or infinite; score the scene again")
    return kind(**{name: arrays[name] for name in ARRAYS[kind]})


def check_against(rules: ProtocolRules, scene: str, counts: Counts) -> None:
    """A ``DataError`` where counts have other classes, thresholds or values than the rules."""
    has, expected = _sizes(rules, counts)
    for what, n in expected.items():
        if has[what] != n:
            raise DataError(f"{scene}: was scored with {has[what]} {what}, {rules.name} has {n} here; score it again")


def _sizes(rules: ProtocolRules, counts: Counts) -> tuple[dict[str, int], dict[str, int]]:
    """What the counts have of each, and what the rules have."""
    if isinstance(counts, InstanceCounts):
        n_classes, n_thresholds = counts.n_missed.shape
        has = {"classes": n_classes, "thresholds": n_thresholds}
        return has, {"classes": len(rules.curve_names), "thresholds": len(rules.thresholds)}
    if isinstance(counts, SemanticCounts):
        n_classes, n_columns = counts.confusion.shape
        has = {"classes": n_classes, "columns": n_columns}
        return has, {"classes": len(rules.classes), "columns": len(rules.classes) + 1}
    n_values = len(counts.n_judged) if isinstance(counts, ShareCounts) else counts.totals.shape[1]
    return {"values": n_values}, {"values": len(VALUES_OF_METRIC[rules.metric])}
