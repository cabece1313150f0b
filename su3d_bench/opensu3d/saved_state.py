"""The detection table Q and the detections of all images as arrays, and back."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.files.atomic import Scratch
from su3d_bench.core.files.state import check_range, check_starts, check_texts
from su3d_bench.core.maps import starts_of
from su3d_bench.core.types import Int64Array
from su3d_bench.opensu3d.tracking import ImageRecord, TrackingTable, View

Arrays = dict[str, NDArray[Any]]
# I images with K detections in total, features of F dimensions; T scene ids with V views, S of them with a seed.
FORMS = {
    "image_frames": "i8 I",
    "image_starts": "i8 I+1",
    "rows": "i8 K",
    "detection_scores": "f8 K",
    "multi_scale": "f8 K F",
    "global_features": "f8 I F",
    "hit_starts": "i8 K+1",
    "hits": "i4 H",
    "table_ids": "i8 T",
    "table_starts": "i8 T+1",
    "views": "i8 V 2",
    "seeds": "i8 S 2",
}


def image_arrays(images: Sequence[ImageRecord]) -> tuple[Arrays, dict[str, list[str]]]:
    """Numbers and texts of all detections."""
    n_dimensions = images[0].n_dimensions if images else 0
    features, whole = np.zeros((0, n_dimensions)), np.zeros((0, n_dimensions))
    sizes = [np.diff(image.hit_indptr) for image in images]
    arrays: Arrays = {
        "image_frames": np.array([image.frame_index for image in images], np.int64),
        "image_starts": starts_of(len(image.names) for image in images),
        "rows": np.concatenate([np.zeros(0, np.int64), *(image.rows for image in images)]),
        "detection_scores": np.concatenate([np.zeros(0), *(image.scores for image in images)]),
        "multi_scale": np.concatenate([features, *(image.multi_scale.rows(0, len(image.names)) for image in images)]),
        "global_features": np.concatenate([whole, *(image.global_feature.rows(0, 1) for image in images)]),
        "hit_starts": starts_of(np.concatenate([np.zeros(0, np.int64), *sizes])),
        "hits": np.concatenate([np.zeros(0, np.int32), *(image.hits.rows(0, image.hits.shape[0]) for image in images)]),
    }
    names = [name for image in images for name in image.names]
    return arrays, {"names": names, "captions": [caption for image in images for caption in image.captions]}


def images_of(arrays: Mapping[str, NDArray[Any]], values: Mapping[str, Any], scratch: Scratch) -> list[ImageRecord]:
    """The reverse of ``image_arrays``; large arrays go to ``scratch``."""
    n, starts, hit_starts = len(arrays["rows"]), arrays["image_starts"], arrays["hit_starts"]
    check_starts("image_starts", starts, n)
    check_starts("hit_starts", hit_starts, len(arrays["hits"]))
    names, captions = (tuple(map(sys.intern, check_texts(key, values.get(key), n))) for key in ("names", "captions"))
    images = []
    for k, (first, last) in enumerate(pairwise(starts.tolist())):
        of_image = slice(first, last)
        hits = hit_starts[first : last + 1]
        images.append(
            ImageRecord(
                int(arrays["image_frames"][k]),
                arrays["rows"][of_image].copy(),
                arrays["detection_scores"][of_image].copy(),
                names[of_image],
                captions[of_image],
                scratch.put(arrays["multi_scale"][of_image]),
                scratch.put(arrays["global_features"][k : k + 1]),
                hits - hits[0],
                scratch.put(arrays["hits"][hits[0] : hits[-1]]),
            )
        )
    return images


def table_arrays(table: TrackingTable, seeds: Mapping[int, int]) -> Arrays:
    """Q and the seeds of its ids."""
    views = [(view.position, view.detection) for of_id in table.values() for view in of_id]
    return {
        "table_ids": np.array(list(table), np.int64),
        "table_starts": starts_of(map(len, table.values())),
        "views": np.array(views, np.int64).reshape(-1, 2),
        "seeds": np.array(list(seeds.items()), np.int64).reshape(-1, 2),
    }


def table_of(arrays: Mapping[str, NDArray[Any]], next_id: int) -> Iterator[tuple[int, list[View]]]:
    """The ids of Q, below ``next_id``, with their views."""
    views, starts, image_starts = arrays["views"], arrays["table_starts"], arrays["image_starts"]
    check_starts("table_starts", starts, len(views))
    check_range("table_ids", arrays["table_ids"], 1, next_id)
    check_range("views", views[:, 0], 0, len(image_starts) - 1)
    n_detections: Int64Array = np.diff(image_starts)[views[:, 0]]
    check_range("views", views[:, 1], 0, 1 << 62)
    check_range("views", views[:, 1] - n_detections, -(1 << 62), 0)
    for scene_id, (first, last) in zip(arrays["table_ids"].tolist(), pairwise(starts.tolist()), strict=True):
        yield scene_id, [View(position, detection) for position, detection in views[first:last].tolist()]
