"""Synthetic sequences, answered by both trackeval or deeplab2's STQ and this program; needs only numpy.

A track problem is a list of steps: ids of objects (G,), ids of instances (P,) and their similarity (G, P). A point
problem is a list of steps with the true class, true id, class and id of each point (N,), class -1 for void.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Track = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
Points = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
N_TRACKS, N_POINTS = 500, 200
N_CURVES = 40  # track problems whose values are stored at each threshold
N_TOGETHER = 20  # point problems with the same classes, also scored together
TRACK_KINDS = ("no step", "no instance", "no object", "nothing", "apart", "tied", "at thresholds", "perfect")
POINT_KINDS = ("no step", "no point", "all void", "no prediction", "crowd", "perfect")


def track_problem(seed: int) -> list[Track]:
    """Objects that come and go, followed by ids that switch; every fifth problem is of one of ``TRACK_KINDS``."""
    rng = np.random.default_rng([1, seed])
    kind = TRACK_KINDS[seed // 5 % len(TRACK_KINDS)] if seed % 5 == 0 else ""
    n_objects, n_ids = 1 + int(6 * rng.random()), 1 + int(7 * rng.random())
    steps, follows = [], rng.random(n_ids) * n_objects // 1
    for _ in range(0 if kind == "no step" else 1 + int(9 * rng.random())):
        is_switched = rng.random(n_ids) < 0.15
        follows = np.where(is_switched, rng.random(n_ids) * n_objects // 1, follows)
        is_near = np.arange(n_objects)[:, None] == follows
        draws = rng.random((n_objects, n_ids))
        similarity = np.where(is_near, 0.2 + 0.8 * draws, np.maximum(0, draws - 0.6))
        similarity = np.round(20 * similarity) / 20 if seed % 2 else similarity
        similarity = {
            "apart": 0 * draws, "tied": 0 * draws + 0.5, "perfect": np.eye(n_objects, n_ids),
            "at thresholds": np.arange(0.05, 0.99, 0.05)[(19 * draws).astype(int)],
        }.get(kind, similarity)  # fmt: skip
        is_there, is_found = rng.random(n_objects) < 0.75, rng.random(n_ids) < 0.8
        is_there &= kind not in ("no object", "nothing")
        is_found &= kind not in ("no instance", "nothing")
        is_there &= rng.random() >= 0.1
        is_found &= rng.random() >= 0.1
        rows, columns = (np.flatnonzero(each)[np.argsort(rng.random(each.sum()))] for each in (is_there, is_found))
        steps.append((3 * rows + 2, 97 - 5 * columns, similarity[np.ix_(rows, columns)]))
    return steps


def is_thing(seed: int) -> NDArray[np.bool_]:
    """Which classes (C,) of the point problem are things; none in one group of problems."""
    group = seed // N_TOGETHER
    n_classes = 1 + group % 7
    return np.arange(n_classes) < (n_classes + 1) // 2 * (group != 4)


def point_problem(seed: int) -> list[Points]:
    """Runs of points with classes and ids, predicted with errors; every fourth problem is of ``POINT_KINDS``."""
    rng = np.random.default_rng([2, seed])
    kind = POINT_KINDS[seed // 4 % len(POINT_KINDS)] if seed % 4 == 0 else ""
    n_classes, steps = len(is_thing(seed)), []
    for _ in range(0 if kind == "no step" else 1 + int(6 * rng.random())):
        n = 0 if kind == "no point" else int(80 * rng.random())
        runs = np.cumsum(rng.random(n) < 0.15)
        number = (rng.random(n + 1) * 6 // 1).astype(np.int64)[runs]
        true_class = number % (n_classes + 1) - 1
        true_id = np.where(number == 5, 0, number)  # 0: a crowd
        wrong = rng.random((2, n)) < 0.1
        class_index = np.where(wrong[0], (rng.random(n) * (n_classes + 1) // 1).astype(np.int64) - 1, true_class)
        ids = np.where(wrong[1], (rng.random(n) * 9 // 1).astype(np.int64), true_id + int(3 * rng.random()))
        true_class = np.where(kind == "all void", -1, true_class)
        class_index = np.where(kind == "no prediction", -1, true_class if kind == "perfect" else class_index)
        true_id, ids = 0 * true_id if kind == "crowd" else true_id, true_id if kind == "perfect" else ids
        steps.append((true_class, true_id, class_index, ids))
    return steps
