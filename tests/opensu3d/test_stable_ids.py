"""Ids of a map that is requested while it grows: an id never moves to another object."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from literal_problems import Problem, random_problem
from numpy.typing import NDArray
from plates import contents

from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import SceneInfo
from su3d_bench.opensu3d.pipeline import OpenSU3D

OF_ONE_TEST = 40
SCENE = SceneInfo("made", "random", 5, 7, "rendered-rooms")
EPS = 0.04
Marks = frozenset[tuple[int, ...]]


def sequence(seed: int) -> Problem:
    """A random problem in which objects split into parts that are separate objects."""
    problem = random_problem(seed)
    parts = {"density": "scene", "eps": EPS, "dbscan_eps": 0.1, "dbscan_min_points": 3, "split_fraction": 0.2}
    return Problem(problem.settings.model_copy(update=parts), problem.images)


def maps(problem: Problem, asked_after: Iterable[int]) -> list[Instances]:
    """The maps of one method, requested after those images, the last one being the final map."""
    method = OpenSU3D(problem.settings)
    method.start(SCENE)
    answers = []
    for nth, (frame, detections) in enumerate(problem.images):
        method.update(frame, detections, Timer())
        if nth in asked_after:
            answers.append(method.finish())
    answers.append(method.finish())
    method.close()
    return answers


def marks_of(found: Instances) -> dict[int, tuple[Marks, Marks]]:
    """For each id the voxels with points of its object, and the views that show it."""
    voxels = np.floor(found.points.astype(float) / EPS).astype(int)
    marks = {}
    for k in range(len(found)):
        views = found.views[found.view_indptr[k] : found.view_indptr[k + 1]]
        marks[int(found.ids[k])] = (marks_in(voxels[found.mask(k)]), marks_in(views))
    return marks


def marks_in(rows: NDArray[Any]) -> Marks:
    return frozenset(map(tuple, rows.tolist()))


def foreign_files(answers: Sequence[Instances]) -> list[int]:
    """The ids that name, in two of ``answers``, objects without a common voxel, or view: a view is of one segment."""
    shown: dict[int, list[tuple[Marks, Marks]]] = {}
    for found in answers:
        for one, marks in marks_of(found).items():
            shown.setdefault(one, []).append(marks)
    return [
        one
        for one, seen in shown.items()
        if any(a.isdisjoint(b) for first, second in combinations(seen, 2) for a, b in zip(first, second, strict=True))
    ]


FIRST = [0, *(pytest.param(n, marks=pytest.mark.proof) for n in (40, 80, 120, 160))]


@pytest.mark.parametrize("first", FIRST)
def test_no_id_names_two_objects_however_often_the_map_is_requested(first: int) -> None:
    n_parts = 0
    for seed in range(first, first + OF_ONE_TEST):
        problem = sequence(seed)
        answers = maps(problem, range(len(problem.images)))
        assert all(len({*found.ids.tolist()}) == len(found) and (found.ids > 0).all() for found in answers)
        assert (seed, foreign_files(answers)) == (seed, [])
        n_parts += sum(len(found.views) - len(marks_in(found.views)) for found in answers[:-1])
        assert contents(answers[-1]) == contents(answers[-2])
    assert n_parts > OF_ONE_TEST  # views shared by several parts of an object


@pytest.mark.parametrize("first", FIRST)
def test_intermediate_maps_do_not_change_the_final_map(first: int) -> None:
    for seed in range(first, first + OF_ONE_TEST):
        problem = sequence(seed)
        undisturbed = maps(problem, ())[-1]
        assert (seed, contents(maps(problem, range(len(problem.images)))[-1])) == (seed, contents(undisturbed))
