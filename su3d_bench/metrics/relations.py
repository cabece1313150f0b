"""Protocols of kind ``relations``: objects of a scene graph, predicates between them, and triplets of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.english import last_word
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Masks, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array
from su3d_bench.metrics.instance.boxes import box_around
from su3d_bench.metrics.instance.score import named_classes, score_of_masks
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids, encoder_warning
from su3d_bench.metrics.matching.nearest import Points, nearest
from su3d_bench.metrics.matching.rows import rows_of
from su3d_bench.metrics.metric import Counts, Metric, Pooled, SceneScore, axes, first_row
from su3d_bench.numerics.relations import RELATIONS, Relation, Relations
from su3d_bench.numerics.statistics import nan_mean, ratio

NAMES = ("object R@1", "predicate R@1", "relationship R@1", "object mR@1", "predicate mR@1")


@dataclass(frozen=True)
class RelationCounts(Counts):
    """The counts of a scene: true objects per class (C,) and true relations per predicate (P,), and of these the
    objects with the right class, relations with the right predicate, and relations with the right triplet."""

    stored_as = "relations"

    n_objects: Int64Array = field(metadata=axes("classes"))
    n_objects_found: Int64Array = field(metadata=axes("classes"))
    n_relations: Int64Array = field(metadata=axes("predicates"))
    n_predicates_found: Int64Array = field(metadata=axes("predicates"))
    n_triplets_found: Int64Array = field(metadata=axes("predicates"))

    def contradiction(self) -> str | None:
        """More found than exist, or triplets without their predicate."""
        pairs = (
            ("n_objects_found", "n_objects"),
            ("n_predicates_found", "n_relations"),
            ("n_triplets_found", "n_predicates_found"),
        )
        for part, whole in pairs:
            if (getattr(self, part) > getattr(self, whole)).any():
                return f"'{part}' has more than '{whole}'"
        return None


def recalls(sums: dict[str, Float64Array]) -> dict[str, Float64Array]:
    """The recalls (R,) from sums of counts (R, C or P); NaN without ground truth, which ``mR`` averages over.

    >>> one = RelationCounts(*(np.array(n, np.int64) for n in ([2, 1], [2, 0], [4], [2], [1])))
    >>> {name: value.tolist() for name, value in recalls(RelationCounts.drawn([one], np.array([[1]]))).items()}
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


MIN_OWN_SHARE = 0.5  # minimum share of a predicted object's points in the object that it is assigned to
RIVAL_SHARE = 0.75  # maximum ratio of the second object's share to the first's for an assignment
Edges = dict[tuple[int, int], int]  # rows of subject and object: the index of the predicate


def shared_points(
    points: Points, masks: Masks, true_points: Points, owner: Int64Array, n_objects: int, cap_m: float
) -> Int64Array:
    """Points (G, K) of each of K masks whose nearest true point, nearer than ``cap_m``, belongs to each of G objects.

    ``owner`` (N,): the row of the object that each of ``true_points`` (N, 3) m belongs to.
    """
    _, index = nearest(true_points, points, float(np.nextafter(cap_m, 0.0)))
    row = np.where(index >= 0, np.append(owner, -1)[index], -1)[masks.indices]
    met = row >= 0
    flat = np.bincount(row[met] * len(masks) + masks.owners[met], minlength=n_objects * len(masks))
    return flat.reshape(n_objects, len(masks)).astype(np.int64)


def assign_objects(shared: Int64Array, sizes: Int64Array) -> Int64Array:
    """The mask (G,) assigned to each object, -1 for none, from shared points (G, K) and sizes (K,) of masks.

    A mask is assigned to the object that has half of its points, unless a second one has nearly as many; of several
    masks assigned to an object the one with most points counts, the first on ties.

    >>> assign_objects(np.array([[6, 4, 5], [3, 4, 0]]), np.array([10, 8, 10])).tolist()
    [0, -1]
    """
    n_objects, n_masks = shared.shape
    if not n_objects or not n_masks:
        return np.full(n_objects, -1, np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = shared / sizes  # as in the original: 0.75 is compared with a quotient of two such shares
        main = shared.argmax(axis=0)
        ordered = np.sort(share, axis=0)
        is_clear = ~(ordered[-1] < MIN_OWN_SHARE) & ~(
            (ordered[-2] / ordered[-1] > RIVAL_SHARE) if n_objects > 1 else False
        )
    own = np.where((np.arange(n_objects)[:, None] == main[None]) & is_clear[None], shared, 0)
    best = own.argmax(axis=1)
    return np.where(own[np.arange(n_objects), best] > 0, best, -1)


def last_best(scores: Float64Array) -> Int64Array:
    """The index of the greatest score of each row (R, P), the last on ties, as in the original's reversed order.

    >>> last_best(np.array([[0.5, 0.5, 0.0]])).tolist()
    [1]
    """
    n = scores.shape[1]
    return n - 1 - scores[:, ::-1].argmax(axis=1) if len(scores) else np.zeros(0, np.int64)


def boxes_around(points: Points, masks: Masks) -> Float64Array:
    """The lowest and highest corners (K, 2, 3) of the points of each mask; zeros for an empty one."""
    boxes = np.zeros((len(masks), 2, 3))
    for row in np.flatnonzero(masks.sizes).tolist():
        boxes[row] = box_around(points[masks.mask(row)])
    return boxes


def geometric_edges(
    boxes: Float64Array, names: Sequence[str], predicates: Sequence[str], *, sure: bool = False
) -> Edges:
    """The first relation of each ordered pair of named boxes (K, 2, 3), if it is a predicate.

    In the order of ``RELATIONS``. ``sure`` excludes those of ``Relations.doubtful``, and has every fact once: neither
    "under" as the reverse of "on" or "above", nor "next to" from the larger object.
    """
    relations = Relations(boxes, [last_word(name) for name in names])
    asked: list[Relation] = [name for name in RELATIONS if name in predicates]
    edges: Edges = {}
    for name in asked:
        holds: BoolArray = relations.of(name)
        kept = relations.facts(name) & ~relations.doubtful(name) if sure else holds
        if sure and name == "next to":
            faces = relations.faces
            kept &= (faces[:, None] < faces[None]) | np.triu(faces[:, None] == faces[None])
        for pair in np.argwhere(holds).tolist():
            edges.setdefault((pair[0], pair[1]), list(predicates).index(name) if kept[tuple(pair)] else -1)
    return {pair: place for pair, place in edges.items() if place >= 0}


MAX_RELATED = 1000  # masks whose boxes are compared pair by pair; above it, only those assigned to an object
BY_BOXES = "relations of the map from the boxes of its instances: it has no edges"


@dataclass(frozen=True)
class _Graph:
    """Ground truth: instance ids and class indices (G,) of objects, and the predicate index of pairs of rows."""

    ids: Int64Array
    classes: Int64Array
    relations: Sequence[tuple[int, int, int]]  # rows of subject and object, index of the predicate


class RelationMetric(Metric[RelationCounts]):
    """The share of true objects, relations and triplets that a scene graph has at rank 1."""

    truth = GroundTruth
    counts = RelationCounts

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        assert rules.transfer.cap_m is not None
        graph = self._graph(truth)
        masks = transfer.masks_of(prediction)
        row_of_point = rows_of(graph.ids, truth.instance)
        is_object = row_of_point >= 0
        true_points, owner = truth.points[is_object], row_of_point[is_object]
        shared = shared_points(prediction.points, masks, true_points, owner, len(graph.ids), rules.transfer.cap_m)
        stands = assign_objects(shared, masks.sizes)
        called = class_index_of_ids(rules, named_classes(rules, truth.semantic, prediction, encoder))
        edges, remark = self._edges(prediction, masks, called, stands)
        counts = self._counts(graph, stands, called, edges)
        warnings = [encoder_warning(rules, prediction, encoder), remark]
        return score_of_masks(self, counts, prediction, truth.points, is_object, warnings)

    def _graph(self, truth: GroundTruth) -> _Graph:
        """The objects of scored classes and their relations, as annotated or by their boxes."""
        rules = self.rules
        if rules.relations == "annotated":
            if truth.graph is None:
                raise DataError(f"{rules.name}: ground truth '{truth.variant}' has no annotated relations")
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
                    f"{rules.name}: class {class_of[key]} is '{rules.classes[place].name}', in the ground truth it is "
                    f"'{truth.labels.name_of(class_of[key])}'"
                )
        objects, classes = np.array([*kept], np.int64), np.array([*kept.values()], np.int64)
        if truth.graph is not None and rules.relations == "annotated":
            row_of = {key: row for row, key in enumerate(kept)}
            relations = [
                (row_of[subject], row_of[other], self._place(predicate))
                for subject, predicate, other in truth.graph.relations
                if subject in row_of and other in row_of
            ]
            return _Graph(objects, classes, relations)
        boxes = np.array([box_around(truth.points[truth.instance == key]) for key in kept]).reshape(-1, 2, 3)
        names = [rules.classes[place].name for place in kept.values()]
        edges = geometric_edges(boxes, names, rules.predicates, sure=True)
        return _Graph(objects, classes, [(*pair, place) for pair, place in edges.items()])

    def _place(self, predicate: str) -> int:
        if predicate not in self.rules.predicates:
            raise DataError(f"{self.rules.name}: unknown predicate '{predicate}' in ground truth")
        return self.rules.predicates.index(predicate)

    def _edges(
        self, prediction: Instances | Partition, masks: Masks, called: Int64Array, stands: Int64Array
    ) -> tuple[Edges, str | None]:
        """The predicate of each pair of rows, from the map's edges or by boxes; and a remark."""
        rules = self.rules
        own = prediction if isinstance(prediction, Instances) and prediction.edges is not None else None
        if own is not None:
            assert own.edges is not None and own.edge_scores is not None and own.predicates is not None
            places = [rules.predicates.index(name) if name in rules.predicates else -1 for name in own.predicates]
            best = np.array(places, np.int64)[last_best(own.edge_scores)]
            edges: Edges = {}
            for pair, place in zip(own.edges.tolist(), best.tolist(), strict=True):
                edges.setdefault((pair[0], pair[1]), place)
            for (a, b), place in list(edges.items()) if rules.relations == "geometric" else ():
                if place >= 0 and rules.predicates[place] == "next to":
                    edges.setdefault((b, a), place)
            return edges, None
        related = np.flatnonzero((called >= 0) & (masks.sizes > 0))
        if len(related) > MAX_RELATED:
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
        """The recalls, the number that each is a share of, ``n_<name>``, and those of each class and predicate."""
        sums = RelationCounts.drawn(counts, np.ones((1, len(counts)), np.int64))
        values = first_row(recalls(sums))
        n_objects, n_relations = int(sums["n_objects"].sum()), int(sums["n_relations"].sum())
        values |= dict(zip((f"n_{name}" for name in NAMES[:3]), (n_objects, n_relations, n_relations), strict=True))
        single = first_row(self._single(sums))
        return Pooled(values, {name: {"R@1": value} for name, value in single.items() if not np.isnan(value)})

    def _single(self, sums: Mapping[str, Float64Array]) -> dict[str, Float64Array]:
        """The recall (R,) of each class and each predicate that occurs in a scene."""
        of_class = ratio(sums["n_objects_found"], sums["n_objects"])
        of_predicate = ratio(sums["n_predicates_found"], sums["n_relations"])
        names = [entry.name for entry in self.rules.classes]
        columns = dict(zip(names, of_class.T, strict=True))
        columns |= {f"predicate {name}": row for name, row in zip(self.rules.predicates, of_predicate.T, strict=True)}
        return columns

    def resampled(self, counts: Sequence[RelationCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        return recalls(RelationCounts.drawn(counts, weights))

    def resampled_classes(
        self, counts: Sequence[RelationCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        table = self._single(RelationCounts.drawn(counts, weights))
        return {name: {"R@1": table[name]} for name in self.pooled(counts).classes}
