"""Protocols of kind ``grounding``: whether the box of the first instance overlaps that of the described object.

Sources: ``eval_ref_one_sample`` of lib/eval_helper.py, ``box3d_iou`` of utils/box_util.py and ``export`` of
data/scannet/load_scannet_data.py (daveredrum/ScanRefer at 9d74830): boxes along the walls, right from an IoU of 0.25 or
0.5 on; ``analyze_predictions`` of referit3d/analysis/deepnet_predictions.py (referit3d/referit3d at 725a5d3): a choice
among given objects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, LabelSet
from su3d_bench.metrics.instance.boxes import box_around
from su3d_bench.metrics.instance.score import covered_objects, score_of_masks
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.labelling import encoder_warning, similarities
from su3d_bench.metrics.matching.nearest import Points
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery
from su3d_bench.metrics.questions.score import ShareMetric, first_instances, share_counts

THRESHOLDS = (0.25, 0.5)
EVERY = "all"  # the group of all scored texts
_SMALLEST_VOLUME = 1e-8  # the original adds it to the union


class GroundingMetric(ShareMetric):
    """Whether the box of the first instance for each text overlaps that of an object that the text describes.

    With metric ``referit3d`` the boxes of all objects are given: whether it is at the right one.
    """

    truth = QueryTruth

    def per_scene(self, truth: QueryTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        turn = truth.alignment if self.rules.box_axes == "aligned" else None
        masks = transfer.masks_of(prediction)
        ids = np.unique(truth.object_of_point[truth.object_of_point >= 0])
        true_points = aligned(truth.points, turn)
        given = [box_around(true_points[truth.object_of_point == key]) for key in ids.tolist()]
        is_meant = np.array([np.isin(ids, query.object_ids) for query in truth.queries]).reshape(-1, len(ids))
        points = aligned(prediction.points, turn)
        boxes = {row: box_around(points[masks.mask(row)]) for row in np.flatnonzero(masks.sizes).tolist()}
        if self.rules.metric == "referit3d":
            is_right = self._chosen(truth, prediction, encoder, boxes, given, is_meant)
            judged = {"": is_right}
        else:
            texts = [query.text for query in truth.queries]
            first = first_instances(self.rules, texts, prediction, encoder).tolist()
            iou = np.array([_best_iou(boxes.get(k), given, row) for k, row in zip(first, is_meant, strict=True)])
            judged = {f"Acc@{threshold:g}": iou >= threshold for threshold in THRESHOLDS}
        counts = share_counts(*zip(*[self._share(name, truth, judged) for name in self.rules.value_names], strict=True))
        asked_for = [object_id for query in truth.queries for object_id in query.object_ids]
        wanted = np.isin(truth.object_of_point, np.array(asked_for, np.int64))
        warnings = [encoder_warning(self.rules, prediction, encoder)]
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)

    def _share(self, name: str, truth: QueryTruth, judged: dict[str, BoolArray]) -> tuple[int, int]:
        """The number of texts of a value such as ``unique Acc@0.25`` or ``easy``, and the number of right ones."""
        group, _, measure = name.rpartition(" ") if "" not in judged else (name, "", "")
        rows = in_group([query.groups for query in truth.queries], group or EVERY, self.rules.metric)
        return int(rows.sum()), int((rows & judged[measure]).sum())

    def _chosen(
        self,
        truth: QueryTruth,
        prediction: Instances | Partition,
        encoder: Encoder | None,
        boxes: dict[int, Float64Array],
        given: Sequence[Float64Array],
        is_meant: BoolArray,
    ) -> BoolArray:
        """Whether (Q,) the given object matched by the first instance that overlaps any of them is the right one."""
        iou = {row: np.array([box_iou(box, other) for other in given]) for row, box in boxes.items()}
        rows = np.array([row for row, values in iou.items() if values.any()], np.int64)
        if not len(rows) or not truth.queries:
            return np.zeros(len(truth.queries), bool)
        texts = [query.text for query in truth.queries]
        first = rows[similarities(self.rules, texts, prediction, encoder, rows).argmax(axis=0)]
        choice = [choose(iou[row]) for row in first.tolist()]
        return is_meant[np.arange(len(choice)), choice]


def choose(scores: Float64Array) -> int:
    """The object with the greatest of ``scores`` (G,), the first on ties."""
    return int(scores.argmax())


def in_group(groups: Sequence[Sequence[str]], group: str, metric: str) -> BoolArray:
    """Which texts (Q,) with these groups a value of ``group`` includes; ``all`` includes every text.

    With ``referit3d``, ``accuracy`` includes the easy and the hard texts: Nr3D excludes the others.

    >>> in_group([("easy",), ("left out",)], "accuracy", "referit3d").tolist()
    [True, False]
    """
    if group == EVERY:
        return np.ones(len(groups), bool)
    wanted = {"easy", "hard"} if metric == "referit3d" and group == "accuracy" else {group}
    return np.array([not wanted.isdisjoint(of_text) for of_text in groups], bool)


def aligned(points: Points, motion: Float64Array | None) -> Points:
    """Points (N, 3) after a rigid transform (4, 4), in float32 as in the original."""
    if motion is None:
        return points
    moved = np.column_stack([np.asarray(points, np.float64), np.ones(len(points))]) @ motion.T
    return moved[:, :3].astype(np.float32)


def _best_iou(box: Float64Array | None, given: Sequence[Float64Array], is_meant: BoolArray) -> float:
    if box is None:
        return 0.0
    return max((box_iou(box, given[place]) for place in np.flatnonzero(is_meant).tolist()), default=0.0)


def box_iou(first: Float64Array, second: Float64Array) -> float:
    """The intersection over union of two boxes (2, 3), with the original's rounding.

    >>> unit = np.array([[0.0, 0, 0], [1, 1, 1]])
    >>> round(box_iou(unit, unit + [0.5, 0, 0]), 6), box_iou(unit, unit + 2.0)
    (0.333333, 0.0)
    """
    sides = np.maximum(np.minimum(first[1], second[1]) - np.maximum(first[0], second[0]), 0.0)
    shared, one, other = (
        float(each[0] * each[1] * each[2]) for each in (sides, first[1] - first[0], second[1] - second[0])
    )
    return shared / (one + other - shared + _SMALLEST_VOLUME)


TAGS = ("class", "appearance", "geometry", "spatial", "functionality")
CHAINS_EACH = 3
COARSE_ONLY, FINE_ONLY, NEITHER = "coarse alone", "fine alone", "neither"


@dataclass(frozen=True)
class Place:
    """The position of a text: its object and chain, by their numbers in the scene; 0 is the finest text."""

    object: int
    chain: int
    step: int


@dataclass(frozen=True, kw_only=True)
class ChainedText(TextQuery):
    """A text, the kinds of information that it uses (``tags``, from ``TAGS``), and all its positions."""

    tags: frozenset[str] = frozenset()
    places: tuple[Place, ...] = ()


class ChainMetric(ShareMetric):
    """Whether the first instance for each text is assigned to an object that the text describes."""

    truth = QueryTruth

    def per_scene(self, truth: QueryTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        cases = chained(truth)
        scene = GroundTruth(
            truth.points,
            np.zeros(len(truth.points), np.int32),
            np.maximum(truth.object_of_point, 0).astype(np.int32),
            LabelSet(truth.space, (), ()),
            truth.variant,
            truth.source,
        )
        main = covered_objects(self.rules.transfer, scene, prediction).main_object
        first = first_instances(self.rules, [case.text for case in cases], prediction, encoder)
        is_right = np.array(
            [k >= 0 and int(main[k]) in case.object_ids for k, case in zip(first.tolist(), cases, strict=True)], bool
        )
        wanted = [object_id for case in cases for object_id in case.object_ids]
        warnings = [encoder_warning(self.rules, prediction, encoder)]
        return self._score(scene, wanted, prediction, judge_chains(cases, is_right), warnings)


def chained(truth: QueryTruth) -> tuple[ChainedText, ...]:
    """The texts of a ground truth with their positions; ``DataError`` for texts without chains."""
    cases = tuple(query for query in truth.queries if isinstance(query, ChainedText))
    if len(cases) < len(truth.queries):
        raise DataError("object-chains: the queries have no object chains; use a metadata_*_grounding.json of Beacon3D")
    return cases


def judge_chains(cases: Sequence[ChainedText], is_right: BoolArray) -> Mapping[str, BoolArray]:
    """The judged cases of each value of the metric and whether they are right; ``is_right`` (C,) is per case.

    An object is right if the finest text of each of its chains is; a chain if all its texts are. Every object must
    have ``CHAINS_EACH`` chains.

    >>> fine = [ChainedText(f"the {k}", (1,), tags=frozenset(), places=(Place(0, k, 0),)) for k in range(3)]
    >>> rows = judge_chains(fine, np.array([True, True, False]))
    >>> rows["case"].mean().round(2), rows["object"].tolist(), rows["appearance"].tolist()
    (np.float64(0.67), [False], [])
    """
    is_right = np.asarray(is_right, bool)
    steps: dict[tuple[int, int], dict[int, bool]] = {}
    for case, right in zip(cases, is_right.tolist(), strict=True):
        for place in case.places:
            steps.setdefault((place.object, place.chain), {})[place.step] = right
    fine_of: dict[int, list[bool]] = {}
    chains = []
    for (object_number, _), of_chain in sorted(steps.items()):
        fine, coarse = of_chain[0], all(right for step, right in of_chain.items() if step)
        fine_of.setdefault(object_number, []).append(fine)
        chains.append((fine, coarse))
    assert all(len(fine) == CHAINS_EACH for fine in fine_of.values())
    is_fine, is_coarse = np.array(chains, bool).reshape(-1, 2).T
    rows = {tag: is_right[[tag in case.tags for case in cases]] for tag in TAGS}
    rows |= {"case": is_right, "object": np.array([all(each) for each in fine_of.values()], bool)}
    rows |= {"chain": is_fine & is_coarse, COARSE_ONLY: ~is_fine & is_coarse}
    rows |= {FINE_ONLY: is_fine & ~is_coarse, NEITHER: ~is_fine & ~is_coarse}
    return rows
