"""The ground truth restricted to what was seen, and the area under a curve of scores over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, GroundTruth
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import AnnotationTruth, RetrievalTruth
from su3d_bench.metrics.scoring import Truth

BOXES = "boxes"  # ground truth on the faces of boxes, which are no surface
# The others depend on complete boxes, or on what is not in the scene.
KINDS = ("semantic", "top-k", "instance", "panoptic", "queries", "categories", "retrieval", "annotation")


def reason_against(rules: ProtocolRules) -> str | None:
    """Why a protocol cannot score against what was seen; None if it can."""
    if rules.kind not in KINDS:
        return f"kind '{rules.kind}' needs the complete scene"
    return "its ground truth has boxes instead of surfaces" if rules.ground_truth == BOXES else None


def clouds_of(truth: Truth) -> list[Float32Array]:
    """The points of a ground truth, and its evaluation points if they are others."""
    base = truth if isinstance(truth, GroundTruth | OpenLexTruth | QueryTruth) else truth.scene
    own = getattr(base, "evaluation_points", None)
    return [base.points] if own is None else [base.points, own]


def restricted(truth: Truth, seen: Sequence[BoolArray]) -> Truth:
    """``truth`` with only the points marked in ``seen``, one mask for each of ``clouds_of``.

    Objects keep their ids; those without a seen point vanish, and so do questions that only they answer.
    """
    if isinstance(truth, QueryTruth):
        owner = truth.object_of_point[seen[0]]
        left = set(owner.tolist())
        asked = [replace(one, object_ids=tuple(filter(left.__contains__, one.object_ids))) for one in truth.queries]
        queries = tuple(one for one in asked if one.object_ids)
        return replace(truth, points=truth.points[seen[0]], object_of_point=owner, queries=queries)
    if isinstance(truth, OpenLexTruth):
        owner = truth.object_of_point[seen[0]]
        left = set(owner.tolist())
        objects = {key: labels for key, labels in truth.objects.items() if key in left}
        return replace(truth, points=truth.points[seen[0]], object_of_point=owner, objects=objects)
    if isinstance(truth, GroundTruth):
        return _restricted_points(truth, seen)
    scene = _restricted_points(truth.scene, seen)
    left = set(scene.instance.tolist())
    if isinstance(truth, AnnotationTruth):
        return replace(truth, scene=scene, object_ids=tuple(filter(left.__contains__, truth.object_ids)))
    assert isinstance(truth, RetrievalTruth), "reason_against rejects the others"
    unknown = float("nan")  # how often a guess is right among the seen objects
    targets = [
        replace(one, answers=tuple(filter(left.__contains__, one.answers)), by_chance=unknown, by_name=unknown)
        for one in truth.asked
    ]
    return replace(truth, scene=scene, asked=tuple(one for one in targets if one.answers))


def _restricted_points(truth: GroundTruth, seen: Sequence[BoolArray]) -> GroundTruth:
    is_seen, every, evaluated = seen[0], truth.every_semantic, truth.evaluation_points
    return replace(
        truth,
        points=truth.points[is_seen],
        semantic=truth.semantic[is_seen],
        instance=truth.instance[is_seen],
        every_semantic=None if every is None else every[is_seen],
        evaluation_points=None if evaluated is None else evaluated[seen[1]],
        graph=None,
        places=None,
    )


def area_under(curve: Sequence[tuple[float, float | None]]) -> float | None:
    """The area under a curve of ascending (share of the updates, value), divided by its width: a mean over time.

    By the trapezoidal rule over the points with a value; None with fewer than two, or if the last has no value.

    >>> area_under([(0.25, None), (0.5, 0.2), (0.75, 0.6), (1.0, 0.6)])
    0.5
    """
    known = [(share, value) for share, value in curve if value is not None]
    if len(known) < 2 or curve[-1][1] is None:
        return None
    shares, values = np.array(known, np.float64).T
    return float(np.trapezoid(values, shares) / (shares[-1] - shares[0]))
