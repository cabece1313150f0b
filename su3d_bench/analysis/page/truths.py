"""The truths of a scene for a page: each made once, drawn beside the maps, and which of its objects a map misses."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, printable, printable_json
from su3d_bench.core.maps import Masks, Prediction
from su3d_bench.core.types import GroundTruth, Int32Array, Int64Array, UInt8Array
from su3d_bench.metrics.attribution.overlaps import Overlaps
from su3d_bench.metrics.fitness import why_not_scorable
from su3d_bench.metrics.instance.scene_counts import intersections
from su3d_bench.metrics.matching.nearest import Candidates
from su3d_bench.reports.page.maps import colour_plane, extent_of, index_plane, nearest_colours, pack_map, thinned
from su3d_bench.reports.pictures.canvas import class_colours
from su3d_bench.reports.pictures.maps import truth_owner
from su3d_bench.runs.finished import FinishedRun

Seen = tuple[Candidates, UInt8Array]  # points (n, 3) m that frames saw and their colours (n, 3)


@dataclass(frozen=True)
class Beside:
    """The truth beside a map: which ``variant`` of it, and what the page's map says ``about`` it.

    ``same``: by the place of each instance that is an object of this truth, which object.
    """

    variant: str
    about: Mapping[str, Any]
    same: Mapping[int, Mapping[str, Any]]


class ShownTruths:
    """The truths of a scene that maps stand beside, each once, in the order in which they were asked for."""

    def __init__(self) -> None:
        self._truths: list[GroundTruth] = []

    def place(self, truth: GroundTruth) -> int:
        """Where ``truth`` stands among those that are drawn."""
        for place, known in enumerate(self._truths):
            if known is truth:
                return place
        self._truths.append(truth)
        return len(self._truths) - 1

    def packed(self, most_points: int, seen: Seen | None) -> list[str]:
        """The truths in the form of maps, in base64."""
        return [_packed(truth, most_points, seen) for truth in self._truths]


def why_not_shown(run: FinishedRun, protocol: str, prediction: Prediction) -> str | None:
    """Why ``protocol`` does not say what a map misses; None where it does."""
    with suppress(ConfigError):  # another version of it
        rules = run.rules(protocol)
        return why_not_scorable(rules, prediction) if rules.kind == "instance" else "counts no objects"
    return "its rules here are others"


def judged_objects(truth: GroundTruth, overlaps: Overlaps) -> dict[str, list[int]]:
    """The places of objects among ``instances_of``: those ``counted``, and of these those ``missed``.

    They are missed as the kind of error of that name has it.
    """
    place_of = {int(number): place for place, number in enumerate(instances_of(truth))}
    counted = [place_of.get(int(truth.instance[members[0]])) for members in overlaps.members]
    missed = set(overlaps.missed.tolist())
    return {
        "counted": [place for place in counted if place is not None],
        "missed": [place for k, place in enumerate(counted) if k in missed and place is not None],
    }


def same_objects(truth: GroundTruth, masks: Masks) -> dict[int, dict[str, Any]]:
    """Of each of ``masks`` on the points of the truth that is one of its objects, above IoU 0.5: its place and name.

    The place is that among ``instances_of``; parts and lumps are no object of the truth.
    """
    numbers = instances_of(truth)
    column = np.where(truth.instance > 0, np.searchsorted(numbers, truth.instance), len(numbers))
    shared = intersections(column, len(numbers) + 1, masks.indptr, masks.indices, np.arange(len(masks)))[:, :-1]
    union = masks.sizes[:, None] + np.bincount(column, minlength=len(numbers) + 1)[:-1] - shared
    row_of_class = truth_owner(truth)
    found: dict[int, dict[str, Any]] = {}
    for row, place in np.argwhere(2 * shared > union).tolist():  # objects share no point: of a mask at most one
        called = _most(row_of_class[truth.instance == numbers[place]])
        found[row] = {"place": place, "name": printable(truth.labels.names[called], 80) if called >= 0 else ""}
    return found


def _most(classes: Int32Array) -> int:
    """The row of the labels that most points have, -1 where none has any."""
    known = classes[classes >= 0]
    return int(np.bincount(known).argmax()) if len(known) else -1


def instances_of(truth: GroundTruth) -> Int64Array:
    """The numbers of the instances of a truth, ascending."""
    return np.unique(truth.instance[truth.instance > 0]).astype(np.int64)


def _packed(truth: GroundTruth, most_points: int, seen: Seen | None) -> str:
    cloud = thinned(truth.points, most_points)
    numbers, names = instances_of(truth), [printable(name, 80) for name in truth.labels.names]
    row_of_class = truth_owner(truth)
    place = np.searchsorted(numbers, truth.instance)
    owner = np.where(truth.instance > 0, place, -1)
    planes: dict[str, Any] = {"owner": index_plane(owner[cloud.rows]), "class": index_plane(row_of_class[cloud.rows])}
    colours = None if seen is None else nearest_colours(cloud.points, *seen)
    if colours is not None:
        planes["colour"] = colour_plane(colours)
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(numbers) + 1))
    instances = []
    for k, number in enumerate(numbers.tolist()):
        rows = order[starts[k] : starts[k + 1]]
        called = _most(row_of_class[rows])
        one = {"id": number, "class": called, "points": len(rows), **extent_of(truth.points[rows])}
        instances.append(one | {"name": names[called] if called >= 0 else ""})
    tints = class_colours(truth.labels.names)
    about: dict[str, Any] = {
        "protocol": None, "classes": names, "class_colours": [tints[name] for name in truth.labels.names],
        "instances": instances, "queries": [],
    }  # fmt: skip
    return pack_map(cloud, planes, printable_json(about))
