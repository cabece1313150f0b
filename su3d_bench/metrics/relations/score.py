"""Protocols of kind ``relations``: objects of a scene graph, predicates between them, and triplets of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Masks, Partition
from su3d_bench.core.types import Float64Array, GroundTruth, Int64Array
from su3d_bench.metrics.instance.score import named_classes, score_of_masks
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids, encoder_warning
from su3d_bench.metrics.metric import Metric, Pooled, SceneScore, Values
from su3d_bench.metrics.relations import counts as relation_counts
from su3d_bench.metrics.relations.counts import NAMES, RelationCounts, recalls
from su3d_bench.metrics.relations.graphs import (
    Edges,
    boxes_around,
    geometric_edges,
    last_best,
    shared_points,
    stand_for,
)

MOST_RELATED = 1000  # masks whose boxes are compared pair by pair; above it, only those that stand for an object
BY_BOXES = "relations of the map by the boxes of its instances: it has no edges of its own"


@dataclass(frozen=True)
class _Graph:
    """What is true: instance ids and class places (G,) of objects, and the place of the predicate of pairs of rows."""

    ids: Int64Array
    classes: Int64Array
    relations: Sequence[tuple[int, int, int]]  # rows of subject and object, place of the predicate


class RelationMetric(Metric[RelationCounts]):
    """Of true objects, relations and triplets, how many has a scene graph at rank 1?"""

    truth = GroundTruth
    counts = RelationCounts

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        assert rules.transfer.cap_m is not None
        graph = self._graph(truth)
        masks = transfer.masks_of(prediction)
        row_of_point = _rows_of(graph.ids, truth.instance)
        is_object = row_of_point >= 0
        shared = shared_points(
            prediction.points,
            masks,
            truth.points[is_object],
            row_of_point[is_object],
            len(graph.ids),
            rules.transfer.cap_m,
        )
        stands = stand_for(shared, masks.sizes)
        called = class_index_of_ids(rules, named_classes(rules, truth.semantic, prediction, encoder))
        edges, remark = self._edges(prediction, masks, called, stands)
        counts = self._counts(graph, stands, called, edges)
        warnings = [encoder_warning(rules, prediction, encoder), remark]
        return score_of_masks(self, counts, prediction, truth.points, is_object, warnings)

    def _graph(self, truth: GroundTruth) -> _Graph:
        """The objects of scored classes and their relations, as people annotated them or by their boxes."""
        rules = self.rules
        if rules.relations == "annotated":
            if truth.graph is None:
                raise DataError(f"{rules.name}: the truth '{truth.variant}' has no annotated relations")
            class_of = dict(truth.graph.class_of_object)
        else:
            ids, first = np.unique(truth.instance, return_index=True)
            known = zip(ids.tolist(), truth.semantic[first].tolist(), strict=True)
            class_of = {key: class_id for key, class_id in known if key > 0 and class_id > 0}
        place_of = {entry.id: place for place, entry in enumerate(rules.classes) if not rules.is_ignored(entry.name)}
        kept = {key: place_of[class_id] for key, class_id in sorted(class_of.items()) if class_id in place_of}
        for key, place in kept.items():
            if truth.labels.name_of(class_of[key]) != rules.classes[place].name:
                raise DataError(
                    f"{rules.name}: class {class_of[key]} is '{rules.classes[place].name}', in the truth it is "
                    f"'{truth.labels.name_of(class_of[key])}'"
                )
        objects, classes = np.array([*kept], np.int64), np.array([*kept.values()], np.int64)
        if truth.graph is not None and rules.relations == "annotated":
            row_of = {key: row for row, key in enumerate(kept)}
            return _Graph(
                objects,
                classes,
                [
                    (row_of[subject], row_of[other], self._place(predicate))
                    for subject, predicate, other in truth.graph.relations
                    if subject in row_of and other in row_of
                ],
            )
        boxes = np.array(
            [_box(truth.points[truth.instance == key]) for key in kept], np.float64
        ).reshape(-1, 2, 3)  # fmt: skip
        names = [rules.classes[place].name for place in kept.values()]
        edges = geometric_edges(boxes, names, rules.predicates, sure=True)
        return _Graph(objects, classes, [(*pair, place) for pair, place in edges.items()])

    def _place(self, predicate: str) -> int:
        if predicate not in self.rules.predicates:
            raise DataError(f"{self.rules.name}: the truth has the predicate '{predicate}', none of the protocol's")
        return self.rules.predicates.index(predicate)

    def _edges(
        self, prediction: Instances | Partition, masks: Masks, called: Int64Array, stands: Int64Array
    ) -> tuple[Edges, str | None]:
        """The predicate of each pair of rows that the map relates, its own or by boxes; and a remark."""
        rules = self.rules
        own = prediction if isinstance(prediction, Instances) and prediction.edges is not None else None
        if own is not None:
            assert own.edges is not None and own.edge_scores is not None and own.predicates is not None
            places = [rules.predicates.index(name) if name in rules.predicates else -1 for name in own.predicates]
            best = np.array(places, np.int64)[last_best(own.edge_scores)]
            edges: Edges = {}
            for pair, place in zip(own.edges.tolist(), best.tolist(), strict=True):
                edges.setdefault((pair[0], pair[1]), place)
            return edges, None
        related = np.flatnonzero((called >= 0) & (masks.sizes > 0))
        if len(related) > MOST_RELATED:
            related = np.intersect1d(related, stands)
        boxes = boxes_around(prediction.points, transfer.select(masks, related))
        found = geometric_edges(boxes, [rules.classes[called[row]].name for row in related], rules.predicates)
        return {(int(related[a]), int(related[b])): place for (a, b), place in found.items()}, BY_BOXES

    def _counts(self, graph: _Graph, stands: Int64Array, called: Int64Array, edges: Edges) -> RelationCounts:
        n_classes, n_predicates = len(self.rules.classes), len(self.rules.predicates)
        is_called = (stands >= 0) & (np.append(called, -1)[stands] == graph.classes)
        asked = np.array(graph.relations, np.int64).reshape(-1, 3)
        pairs = [(int(stands[a]), int(stands[b])) for a, b, _ in graph.relations]
        given = np.array([edges.get(pair, -1) if min(pair) >= 0 else -1 for pair in pairs], np.int64)
        has_predicate = given == asked[:, 2]
        is_triplet = has_predicate & is_called[asked[:, 0]] & is_called[asked[:, 1]]

        def per_predicate(kept: np.ndarray) -> Int64Array:
            return np.bincount(asked[kept, 2], minlength=n_predicates).astype(np.int64)

        return RelationCounts(
            np.bincount(graph.classes, minlength=n_classes).astype(np.int64),
            np.bincount(graph.classes[is_called], minlength=n_classes).astype(np.int64),
            per_predicate(np.ones(len(asked), bool)),
            per_predicate(has_predicate),
            per_predicate(is_triplet),
        )

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.classes), "predicates": len(self.rules.predicates)}

    def pooled(self, counts: Sequence[RelationCounts]) -> Pooled:
        """The recalls, beside each what it is a share of, ``n_<name>``, and those of each class and predicate."""
        sums = relation_counts.resampled(counts, np.ones((1, len(counts)), np.int64))
        values: Values = {name: float(value[0]) for name, value in recalls(sums).items()}
        n_objects, n_relations = int(sums["n_objects"].sum()), int(sums["n_relations"].sum())
        values |= dict(zip((f"n_{name}" for name in NAMES[:3]), (n_objects, n_relations, n_relations), strict=True))
        single = {name: float(value[0]) for name, value in self._single(sums).items()}
        return Pooled(values, {name: {"R@1": value} for name, value in single.items() if not np.isnan(value)})

    def _single(self, sums: Mapping[str, Float64Array]) -> dict[str, Float64Array]:
        """The recall (R,) of each class and each predicate that some scene has."""
        of_class = relation_counts.ratio(sums["n_objects_found"], sums["n_objects"])
        of_predicate = relation_counts.ratio(sums["n_predicates_found"], sums["n_relations"])
        names = [entry.name for entry in self.rules.classes]
        columns = dict(zip(names, of_class.T, strict=True))
        columns |= {f"predicate {name}": row for name, row in zip(self.rules.predicates, of_predicate.T, strict=True)}
        return columns

    def resampled(self, counts: Sequence[RelationCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        return recalls(relation_counts.resampled(counts, weights))

    def resampled_classes(
        self, counts: Sequence[RelationCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        whole = self._single(relation_counts.resampled(counts, np.ones((1, len(counts)), np.int64)))
        table = self._single(relation_counts.resampled(counts, weights))
        return {name: {"R@1": table[name]} for name, value in whole.items() if not np.isnan(value[0])}


def _rows_of(ids: Int64Array, instance: np.ndarray) -> Int64Array:
    """The row in ``ids``, ascending, of each number of ``instance`` (N,), -1 where it is none of them."""
    if not len(ids):
        return np.full(len(instance), -1, np.int64)
    row = np.minimum(np.searchsorted(ids, instance), len(ids) - 1)
    return np.where(ids[row] == instance, row, -1)


def _box(points: np.ndarray) -> list[np.ndarray]:
    return [points.min(axis=0), points.max(axis=0)]
