"""Intersection over union of boxes: exact for oriented ones, and of their axis-aligned extents.

Source: concept-graphs at commit 5c4da70, ``conceptgraph/utils/ious.py``, which asks PyTorch3D's ``box3d_overlap``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float64Array, OrientedBox

# The faces of PyTorch3D's boxes in our order of corners, where bit i of a corner is its side along axis i: PyTorch3D's
# corners 0..7 are 0, 2, 6, 4, 1, 3, 7, 5 here.
FACES = np.array([[0, 2, 6, 4], [4, 6, 7, 5], [0, 2, 3, 1], [0, 4, 5, 1], [2, 6, 7, 3], [1, 3, 7, 5]])
COPLANAR_M = 1e-4  # PyTorch3D's tolerance


@dataclass(frozen=True)
class Extents:
    """Axis-aligned boxes: ``low`` and ``high`` (N, 3) in metres."""

    low: Float64Array
    high: Float64Array


def grown(boxes: Sequence[OrientedBox], least_side_m: float) -> list[OrientedBox]:
    """``boxes`` with every side that is shorter grown to ``least_side_m`` about the centre."""
    return [OrientedBox(box.centre, np.maximum(box.sizes, least_side_m), box.rotation) for box in boxes]


def extents_of_boxes(boxes: Sequence[OrientedBox]) -> Extents:
    """The axis-aligned extents of oriented boxes."""
    centres = np.array([box.centre for box in boxes]).reshape(-1, 3)
    reach = np.array([np.abs(box.rotation) @ box.sizes / 2 for box in boxes]).reshape(-1, 3)
    return Extents(centres - reach, centres + reach)


def extents_of_clouds(clouds: Sequence[Float64Array]) -> Extents:
    """The axis-aligned extents of clouds, none of them empty."""
    low, high = [cloud.min(axis=0) for cloud in clouds], [cloud.max(axis=0) for cloud in clouds]
    return Extents(np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3))


def shared_volume(a: Extents, b: Extents) -> Float64Array:
    """Volumes (A, B) that axis-aligned boxes share."""
    low = np.maximum(a.low[:, None], b.low[None])
    high = np.minimum(a.high[:, None], b.high[None])
    volume: Float64Array = np.maximum(high - low, 0).prod(axis=2)
    return volume


def axis_aligned_iou(a: Extents, b: Extents) -> Float64Array:
    """IoU (A, B) of axis-aligned boxes; the original adds 1e-10 m^3 to the union.

    >>> unit, moved = np.zeros((1, 3)), np.array([[0.5, 0.0, 0.0]])
    >>> round(float(axis_aligned_iou(Extents(unit, unit + 1), Extents(moved, moved + 1))[0, 0]), 6)
    0.333333
    """
    shared = shared_volume(a, b)
    volume_a, volume_b = (a.high - a.low).prod(axis=1), (b.high - b.low).prod(axis=1)
    iou: Float64Array = shared / (volume_a[:, None] + volume_b[None] - shared + 1e-10)
    return iou


def oriented_iou(a: Sequence[OrientedBox], b: Sequence[OrientedBox]) -> Float64Array:
    """IoU (A, B) of oriented boxes, exact up to rounding; every side must be longer than 0."""
    from su3d_bench.baselines.conceptgraphs import kernels as kernels

    shared = kernels.intersection_volumes(*_arrays(a), *_arrays(b))
    volume_a = np.array([box.sizes.prod() for box in a])
    volume_b = np.array([box.sizes.prod() for box in b])
    iou: Float64Array = shared / (volume_a[:, None] + volume_b[None] - shared)
    return iou


def are_coplanar(boxes: Sequence[OrientedBox]) -> bool:
    """Whether PyTorch3D takes ``boxes``: the corners of each face lie in a plane, in single precision.

    Boxes far from the origin fail by rounding; at the size of a building none does. As in PyTorch3D the distances of
    the six faces' fourth corners are summed with their signs, so that those of opposite faces may cancel.
    """
    if not boxes:
        return True
    corners = np.array([box.corners for box in boxes]).astype(np.float32)
    first, second, third, fourth = np.moveaxis(corners[:, FACES], 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = _unit(np.cross(_unit(second - first), _unit(third - first)))
        off = ((fourth - first) * normals).sum(axis=(1, 2), dtype=np.float32)
    return bool((np.abs(off) < COPLANAR_M).all())


def _unit(vectors: np.typing.NDArray[np.float32]) -> np.typing.NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: np.typing.NDArray[np.float32] = vectors / np.maximum(lengths, np.float32(1e-12))
    return unit


def _arrays(boxes: Sequence[OrientedBox]) -> tuple[Float64Array, Float64Array, Float64Array]:
    centres = np.array([box.centre for box in boxes], np.float64).reshape(-1, 3)
    halves = np.array([box.sizes for box in boxes], np.float64).reshape(-1, 3) / 2
    rotations = np.array([box.rotation for box in boxes], np.float64).reshape(-1, 3, 3)
    return centres, halves, rotations
