"""Which predicted objects stand for which true ones, and what boxes say of how objects lie to one another.

Source of the matching: Merging/evaluate.py of FROSS (Howardkhh/FROSS at 645153b), section 4.1.3 of its paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.english import last_word
from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.matching.nearest import Points, nearest
from su3d_bench.numerics.relations import RELATIONS, Relation, Relations

OWN_SHARE = 0.5  # of a predicted object's points, to stand for an object: less, and it stands for none
RIVAL_SHARE = 0.75  # of what the first object has of it, for the second: more, and it stands for none
Edges = dict[tuple[int, int], int]  # rows of subject and object: the place of the predicate


def shared_points(
    points: Points, masks: Masks, true_points: Points, owner: Int64Array, n_objects: int, cap_m: float
) -> Int64Array:
    """How many points (G, K) of each of K masks have one of each of G objects as the nearest, nearer than ``cap_m``.

    ``owner`` (N,): the row of the object that each of ``true_points`` (N, 3) m belongs to.
    """
    _, index = nearest(true_points, points, float(np.nextafter(cap_m, 0.0)))
    row = np.where(index >= 0, np.append(owner, -1)[index], -1)[masks.indices]
    met = row >= 0
    flat = np.bincount(row[met] * len(masks) + masks.owners[met], minlength=n_objects * len(masks))
    return flat.reshape(n_objects, len(masks)).astype(np.int64)


def stand_for(shared: Int64Array, sizes: Int64Array) -> Int64Array:
    """The mask (G,) that stands for each object, -1 for none, from shared points (G, K) and sizes (K,) of masks.

    A mask stands for the one object that has half of its points, unless a second has nearly as many; of several masks
    that stand for an object the one with most points counts, the first of equals.

    >>> stand_for(np.array([[6, 4, 5], [3, 4, 0]]), np.array([10, 8, 10])).tolist()
    [0, -1]
    """
    n_objects, n_masks = shared.shape
    if not n_objects or not n_masks:
        return np.full(n_objects, -1, np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = shared / sizes  # as in the original: 0.75 is held against a quotient of two such shares
        main = shared.argmax(axis=0)
        ordered = np.sort(share, axis=0)
        is_clear = ~(ordered[-1] < OWN_SHARE) & ~((ordered[-2] / ordered[-1] > RIVAL_SHARE) if n_objects > 1 else False)
    own = np.where((np.arange(n_objects)[:, None] == main[None]) & is_clear[None], shared, 0)
    best = own.argmax(axis=1)
    return np.where(own[np.arange(n_objects), best] > 0, best, -1)


def last_best(scores: Float64Array) -> Int64Array:
    """The place of the greatest score of each row (R, P), the last of equals, as the original's reversed order has it.

    >>> last_best(np.array([[0.5, 0.5, 0.0]])).tolist()
    [1]
    """
    n = scores.shape[1]
    answer: Int64Array = n - 1 - scores[:, ::-1].argmax(axis=1) if len(scores) else np.zeros(0, np.int64)
    return answer


def boxes_around(points: Points, masks: Masks) -> Float64Array:
    """The lowest and highest corners (K, 2, 3) of the points of each mask; zeros of an empty one."""
    boxes = np.zeros((len(masks), 2, 3))
    for row in np.flatnonzero(masks.sizes).tolist():
        members = points[masks.mask(row)]
        boxes[row] = members.min(axis=0), members.max(axis=0)
    return boxes


def geometric_edges(
    boxes: Float64Array, names: Sequence[str], predicates: Sequence[str], *, sure: bool = False
) -> Edges:
    """The first of the relations that boxes (K, 2, 3) of things so called give each ordered pair, if a predicate.

    In the order of ``RELATIONS``. ``sure`` leaves out what ``Relations.doubtful`` names.
    """
    relations = Relations(boxes, [last_word(name) for name in names])
    asked: list[Relation] = [name for name in RELATIONS if name in predicates]
    edges: Edges = {}
    for name in asked:
        holds: BoolArray = relations.of(name)
        kept = holds & ~relations.doubtful(name) if sure else holds
        for pair in np.argwhere(holds).tolist():
            edges.setdefault((pair[0], pair[1]), list(predicates).index(name) if kept[tuple(pair)] else -1)
    return {pair: place for pair, place in edges.items() if place >= 0}
