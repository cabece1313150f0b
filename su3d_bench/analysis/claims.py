"""Measures of what the OpenSU3D paper claims in words only, from the maps and scores of finished runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np

from su3d_bench.core.english import words
from su3d_bench.core.errors import PredictionError, Su3dError, some
from su3d_bench.core.files.atomic import row_blocks
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.formats.tables.table import NOT_MEASURED, Table, text_table
from su3d_bench.human_eval.sources import RunSource
from su3d_bench.metrics.instance.score import covered_objects
from su3d_bench.metrics.matching import labelling, transfer
from su3d_bench.metrics.questions.score import labels_n
from su3d_bench.numerics.statistics import ratio
from su3d_bench.questions.ground_truths import question_truth
from su3d_bench.questions.model import BLOCK_ROWS
from su3d_bench.runs.executors import SCENE_DONE, Event, Report
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import prediction_arrays

OF_SPREAD = ("similarity SD", "similarity range")
OF_RANKING = ("relevant - others", "largest first", "largest first, wrong", "largest first by chance")
RELATED = "reasoning and merging"
# Measure: its unit, the section of the paper that makes the claim, and its format.
MEASURES = {
    **dict.fromkeys(OF_SPREAD, ("cosine", "III-C1, C3", ".3f")),
    OF_RANKING[0]: ("cosine", "III-C3", ".3f"),
    **dict.fromkeys(OF_RANKING[1:], ("fraction", "III-C4", ".3f")),
    **dict.fromkeys(("length of n", "length of n'"), ("words", "III-C5", ".2f")),
    RELATED: ("correlation", "III-C6", ".2f"),
    **dict.fromkeys(("size per instance", "size per point"), ("bytes", "I", ".0f")),
    "size of map": ("MB per scene", "I", ".2f"),
}


def spread(blocks: Iterable[Float64Array]) -> tuple[Float64Array, Float64Array]:
    """Standard deviation (Q,) and range (Q,), maximum minus minimum, of the cosine similarities of Q queries.

    ``blocks``: similarities (R, Q) of R of the instances or points, at least one in all. The paper's "saturated"
    similarities (section III-C1) differ little, so that both are small.

    >>> deviation, extent = spread([np.array([[0.1, 0.5]]), np.array([[0.3, 0.5]])])
    >>> deviation.round(3).tolist(), extent.round(3).tolist()
    ([0.1, 0.0], [0.2, 0.0])
    """
    n, low, high, sums, squares = 0, np.array(np.inf), np.array(-np.inf), np.zeros(()), np.zeros(())
    for block in blocks:
        n, sums, squares = n + len(block), sums + block.sum(axis=0), squares + (block**2).sum(axis=0)
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
    if not n:
        raise PredictionError("the map is empty")
    return np.sqrt(np.maximum(squares / n - (sums / n) ** 2, 0.0)), high - low


def relevance(similarity: Float64Array, is_right: BoolArray) -> Float64Array:
    """Mean cosine of the instances that answer a query minus that of the others (Q,); NaN if all or none answer.

    ``similarity``, ``is_right`` (K, Q). The paper: "assigning high similarity scores to relevant objects and lower
    scores to irrelevant ones" (section III-C3).

    >>> relevance(np.array([[0.9, 0.2], [0.3, 0.2], [0.5, 0.2]]), np.array([[1, 0], [0, 0], [0, 0]], bool)).tolist()
    [0.5, nan]
    """
    right = ratio(np.where(is_right, similarity, 0.0).sum(axis=0), is_right.sum(axis=0))
    return right - ratio(np.where(is_right, 0.0, similarity).sum(axis=0), (~is_right).sum(axis=0))


def largest_first(similarity: Float64Array, n_points: Int64Array, is_right: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Whether (Q,) the instance with most points is ranked first, and whether (Q,) it then does not answer the query.

    ``similarity``, ``is_right`` (K, Q); ``n_points`` (K,); the first instance on ties. The paper: scheme 1 "often
    wrongly assigned the highest score to the largest instance" (section III-C4).

    >>> similarity = np.array([[0.9, 0.1, 0.7], [0.3, 0.4, 0.2]])
    >>> first, wrong = largest_first(similarity, np.array([50, 9]), np.array([[1, 1, 0], [0, 0, 1]], bool))
    >>> first.tolist(), wrong.tolist()
    ([True, False, True], [False, False, True])
    """
    largest = int(n_points.argmax())
    is_first = similarity.argmax(axis=0) == largest
    return is_first, is_first & ~is_right[largest]


def correlation(pairs: Sequence[tuple[float, float]]) -> float:
    """Pearson's correlation of two values per scene, from -1 to 1; ``PredictionError`` if it is undefined.

    The paper explains lower reasoning accuracy by more flaws in merging (section III-C6).

    >>> round(correlation([(0.5, 0.6), (0.7, 0.8), (0.9, 1.0)]), 3)
    1.0
    """
    if len(pairs) < 3 or not np.ptp(pairs, axis=0).all():
        raise PredictionError("no correlation: needs 3 scenes with both values, which must differ")
    return float(np.asarray(np.corrcoef(np.array(pairs, np.float64).T))[0, 1])


def map_bytes(prediction: Prediction) -> tuple[int, int]:
    """Bytes of what a map stores for its instances, and of what it stores for its points; uncompressed, a byte per
    character.

    Of points are coordinates, masks or instance numbers, and features if each point has one. The paper: "dense,
    per-point feature representations raises memory and scalability challenges" (section I).

    >>> a_map = Instances.of(np.zeros((3, 3), np.float32), [[0, 1]], features=np.ones((1, 4), np.float32), names=["a"])
    >>> map_bytes(a_map)  # 16 feature + 8 score + 1 name + 24 box + 12 centroid + 2 x 16 starts; 36 points + 8 mask
    (93, 44)
    """
    of_points = ("points", "indices", "instance", *(["features"] if isinstance(prediction, DenseFeatures) else []))
    n = {True: 0, False: 0}
    for name, array in prediction_arrays(prediction).items():  # texts there are padded to the longest
        n[name in of_points] += int(np.char.str_len(array).sum() if array.dtype.kind == "U" else array.nbytes)
    return n[False] - len(type(prediction).__name__), n[True]


@dataclass
class Claims:
    """The measures of one method of a run: ``totals``, and over how many queries, instances, points or scenes.

    ``reasons``: why measures are missing, and in which scenes; ``refined_by``: source of the labels n'.
    """

    run: str
    method: str
    totals: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, list[str]] = field(default_factory=dict)
    refined_by: str = "none"

    def add(self, measure: str, values: Any, n: int | None = None) -> None:
        """Add ``values`` that are not NaN, ``n`` if their number is another."""
        self.totals[measure] += float(np.nansum(values))  # type: ignore[assignment]
        self.counts[measure] += int((~np.isnan(values)).sum()) if n is None else n

    @property
    def means(self) -> dict[str, float | None]:
        return {name: self.totals[name] / self.counts[name] if self.counts[name] else None for name in MEASURES}


def claims_of(
    run: FinishedRun, methods: Sequence[str], kinds: Sequence[str], device: str, report: Report
) -> list[Claims]:
    """Every measure of the methods of a run (none: all of them), pooled over its scenes.

    ``kinds``: those of the queries, which are those of the dataset's retrieval protocol. A typed error of a scene is
    the reason why a measure has no value there.
    """
    source, encoder = RunSource(run, methods), cache(partial(run.encoder, device))
    found = [Claims(run.name, method) for method in source.methods]
    for n, scene in enumerate(source.scenes, start=1):
        for one in found:
            for add in (partial(_add_queries, kinds=kinds, encoder=encoder), _add_labels, _add_sizes):
                try:
                    add(one, source, scene)
                except Su3dError as error:
                    one.reasons.setdefault(str(error), []).append(scene)
        report(Event(f"{run.name} {scene}", SCENE_DONE, n, len(source.scenes)))
    for one in found:
        try:
            one.add(RELATED, correlation(pairs := _pairs_of(run, one.method)) * len(pairs), len(pairs))
        except PredictionError as error:
            one.reasons[str(error)] = list(source.scenes)
    return found


def _add_queries(
    one: Claims, source: RunSource, scene: str, kinds: Sequence[str], encoder: Callable[[], Encoder]
) -> None:
    prediction, rules = source.prediction(scene, one.method), source.rules(scene, "retrieval")
    truth = source.truth(scene, rules)
    if prediction.features is None:
        raise PredictionError("no similarities: the map has no features to compare with text")
    if rules is None or truth is None:
        raise PredictionError("no queries: no ground truth that a retrieval protocol fits")
    asked: Any = question_truth(rules, source.run.dataset(scene), scene.partition("/")[2], truth)
    if not (queries := [query for query in asked.asked if query.kind in kinds]):
        raise PredictionError("no queries of these kinds")
    compare = partial(labelling.similarities, rules, [query.text for query in queries], prediction, encoder())
    blocks = row_blocks(prediction.features, BLOCK_ROWS)
    with_feature = (rows.start + np.flatnonzero(block.any(axis=1)) for rows, block in blocks)
    for measure, values in zip(OF_SPREAD, spread(compare(rows) for rows in with_feature if len(rows)), strict=True):
        one.add(measure, values)
    if isinstance(prediction, DenseFeatures):
        raise PredictionError("no largest instance: the map has a feature per point and no instances")
    similarity, n_points = compare(), transfer.masks_of(prediction).sizes
    main = covered_objects(rules.transfer, truth, prediction).main_object
    is_right = np.stack([np.isin(main, query.answers) for query in queries], axis=1)
    wins = largest_first(similarity, n_points, is_right)
    ranked = relevance(similarity, is_right), *wins, np.full(len(queries), 1 / len(n_points))
    for measure, values in zip(OF_RANKING, ranked, strict=True):
        one.add(measure, values)


def _add_labels(one: Claims, source: RunSource, scene: str) -> None:
    instances = source.prediction(scene, one.method)
    if not isinstance(instances, Instances) or (refined := source.refined(scene, one.method)) is None:
        raise PredictionError("no labels n': the map has no names of instances per view")
    one.refined_by = refined.source
    for own, other, is_kept in zip(labels_n(instances), refined.names, refined.is_kept, strict=True):
        for mark, label in (("n", own), ("n'", other)) if own and other and is_kept else ():
            one.add(f"length of {mark}", len(words(label)))


def _add_sizes(one: Claims, source: RunSource, scene: str) -> None:
    prediction = source.prediction(scene, one.method)
    of_instances, of_points = map_bytes(prediction)
    if not isinstance(prediction, DenseFeatures):
        one.add("size per instance", of_instances, len(transfer.masks_of(prediction)))
    one.add("size per point", of_points, len(prediction.points))
    one.add("size of map", (of_instances + of_points) / 1e6)


def _pairs_of(run: FinishedRun, method: str) -> list[tuple[float, float]]:
    """For each scene the share of right answers under a protocol of kind reasoning, and of well-merged instances."""
    values: dict[str, dict[str, float | None]] = {}
    for (name, _), record in run.results.items():
        if name == method and record.result is not None and record.kind in ("reasoning", "annotation"):
            for scene, metrics in record.result.per_scene.items():
                values[scene] = values.get(scene, {}) | {**metrics}
    pairs = [(metrics.get("answer"), metrics.get("well-merged")) for metrics in values.values()]
    return [(answer, merge) for answer, merge in pairs if answer is not None and merge is not None]


def claims_table(found: Sequence[Claims]) -> Table:
    """One row per measure, one column per method; the notes have the reason why a value is missing."""
    labels = [one.method if len({one.run for one in found}) == 1 else f"{one.method} ({one.run})" for one in found]
    rows = [["measure", "unit", "section", *labels]]
    for name, (unit, section, form) in MEASURES.items():
        values = [one.means[name] for one in found]
        rows.append([name, unit, section, *(NOT_MEASURED if v is None else f"{v:{form}}" for v in values)])
    missing: dict[str, list[str]] = {}  # why and in which scenes -> methods
    notes = ["means over all queries, instances, points or scenes; section: of the paper that makes the claim"]
    for label, one in zip(labels, found, strict=True):
        n = [one.counts[name] for name in (OF_SPREAD[0], "length of n", RELATED)]
        notes.append(f"{label}: {n[0]} queries, {n[1]} labels (n': {one.refined_by}), correlation of {n[2]} scenes")
        for reason, scenes in one.reasons.items():
            missing.setdefault(f"{reason} ({some(scenes, 3)})", []).append(label)
    notes += [f"{', '.join(methods)}: {reason}" for reason, methods in missing.items()]
    return text_table("claims", rows, caption="Measures of what the OpenSU3D paper claims in words.", notes=notes)
