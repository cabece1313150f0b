"""Protocols of kind ``object-chains``: is one object found by each of its texts, and by the coarser ones before them?

Source: ``evaluate_grounding.py`` of beacon-3d/beacon-3d at 9cd8f1f. An object has three chains of texts, each from one
that means it to one that means every thing of its kind. A case is a text of a scene, however it is capitalised; it
counts once, in as many chains as it stands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import BoolArray, GroundTruth, LabelSet
from su3d_bench.metrics.instance.score import covered_objects
from su3d_bench.metrics.matching.labelling import encoder_warning
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery
from su3d_bench.metrics.questions.score import ShareMetric, first_instances

TAGS = ("class", "appearance", "geometry", "spatial", "functionality")
CHAINS_EACH = 3
COARSE_ONLY, FINE_ONLY, NEITHER = "coarse alone", "fine alone", "neither"


@dataclass(frozen=True)
class Place:
    """Where a text stands: in which chain of which object, by their numbers in the scene; 0 is the finest text."""

    object: int
    chain: int
    step: int


@dataclass(frozen=True, kw_only=True)
class ChainedText(TextQuery):
    """A text, by what it tells its objects (``tags``, those of ``TAGS``), and every place where it stands."""

    tags: frozenset[str] = frozenset()
    places: tuple[Place, ...] = ()


class ChainMetric(ShareMetric):
    """Does the instance ranked first for each text stand for an object that the text means?"""

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
    """The texts of a truth with their places; a ``DataError`` for texts that stand in no chains."""
    cases = tuple(query for query in truth.queries if isinstance(query, ChainedText))
    if len(cases) < len(truth.queries):
        raise DataError(
            "object-chains: the queries stand in no chains of objects; give a metadata_*_grounding.json of Beacon3D"
        )
    return cases


def judge_chains(cases: Sequence[ChainedText], is_right: BoolArray) -> Mapping[str, BoolArray]:
    """What is judged under each value of the metric and whether it is right; ``is_right`` (C,) for each of the cases.

    An object is right where the finest text of each of its chains is; a chain where all its texts are. Every object
    must have ``CHAINS_EACH`` chains.

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
