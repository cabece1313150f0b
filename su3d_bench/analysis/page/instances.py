"""What a page says of the instances of a map: names, scores, sizes, views, and when each of them was first seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.core.errors import Su3dError, printable
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import Frame, Int64Array
from su3d_bench.reports.page.maps import box_in_view, extent_of
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.records import read_updates

MOST_VIEWS = 12  # frames of an instance that are named
MOST_CAPTION = 240  # characters
MOST_STEPS = 500  # of a growth: more than a slider has pixels


def fed_frames(run: FinishedRun, scene: str, method: str) -> list[int]:
    """The frames that a method was given, as its table of updates says; none where it says nothing that can be read."""
    return [int(index) for index in _updates(run, scene, method).get("frame", ())]


def _updates(run: FinishedRun, scene: str, method: str) -> Mapping[str, Any]:
    updates = run.folder.job(scene, method).updates
    with suppress(Su3dError, OSError):
        return read_updates(updates, updates.name)
    return {}


@dataclass(frozen=True)
class Growth:
    """The updates of a map: ``steps`` as the page has them, some of ``frames`` where there are very many."""

    frames: Sequence[int]
    places: Int64Array
    steps: Mapping[str, Any]

    def step_of(self, views: Sequence[int]) -> int | None:
        """The step by which an instance with these views was first seen; None where no view is of a known frame."""
        known = [self._place_of[frame] for frame in views if frame in self._place_of]
        return int(np.searchsorted(self.places, min(known))) if known else None

    @cached_property
    def _place_of(self) -> Mapping[int, int]:
        return {frame: place for place, frame in reversed(list(enumerate(self.frames)))}


def growth_of(run: FinishedRun, scene: str, method: str) -> Growth | None:
    """How the map of a method grew; None where its table of updates names no frames.

    >>> growth = Growth([0, 40, 80], np.array([0, 2]), {})
    >>> growth.step_of([0]), growth.step_of([80, 40]), growth.step_of([7])
    (0, 1, None)
    """
    columns = _updates(run, scene, method)
    frames = [int(index) for index in columns.get("frame", ())]
    if len(frames) < 2:
        return None
    places = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_STEPS)).round().astype(np.int64))
    steps: dict[str, Any] = {"update": (places + 1).tolist(), "frame": [frames[place] for place in places]}
    if "n_instances" in columns:
        steps["held"] = [int(columns["n_instances"][place]) for place in places]
    return Growth(frames, places, steps)


def frames_of(instances: Instances, k: int) -> list[int]:
    """The frames in which an instance was seen, each once; none where the method keeps no views."""
    if not len(instances.views):
        return []
    rows = instances.views[instances.view_indptr[k] : instances.view_indptr[k + 1]]
    return list(dict.fromkeys(int(frame) for frame, _ in rows))


def instance_data(
    prediction: Prediction, k: int, classes: Int64Array | None, similarity: Any, frames: Mapping[int, Frame]
) -> dict[str, Any]:
    """An instance: n points, c class, s similarities in thousandths, and of ``Instances`` its name, score and views."""
    data: dict[str, Any] = {}
    if classes is not None:
        data["class"] = int(classes[k])
    if similarity is not None:
        data["similarity"] = [round(1000 * float(value)) for value in similarity[k]]
    if not isinstance(prediction, Instances):
        assert not isinstance(prediction, DenseFeatures)
        return {"id": k, "points": int((prediction.instance == k).sum()), **data}
    views = frames_of(prediction, k)
    own = prediction.points[prediction.mask(k)]
    data |= {
        "id": int(prediction.ids[k]) if len(prediction.ids) else k,
        "name": printable((prediction.labels or prediction.names)[k] or prediction.names[k], 80),
        "caption": printable(prediction.captions[k], MOST_CAPTION),
        "score": round(float(prediction.scores[k]), 4),
        "points": len(own),
        "n_views": len(views),
        "views": views[:MOST_VIEWS],
    }
    data |= extent_of(own)
    boxes = {index: _box(own, frames[index]) for index in views if index in frames}
    seen = {index: box for index, box in boxes.items() if box is not None}
    if seen:
        best = max(
            seen, key=lambda index: ((seen[index][2] - seen[index][0]) * (seen[index][3] - seen[index][1]), -index)
        )
        data |= {"view": best, "box": seen[best]}
    return data


def _box(points: Any, frame: Frame) -> list[float] | None:
    height, width = frame.depth_m.shape
    return box_in_view(points[:: max(1, len(points) // 2000)], frame.camera_to_world, frame.intrinsics, width, height)
