"""What two boxes have in common, exactly, however they are turned."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from su3d_bench.core.types import Float64Array, OrientedBox

# A cube of half sides 1 in six tetrahedra (6, 4, 3): one for each order in which its axes lead from corner to corner.
_TETRAHEDRA: Float64Array = np.array(
    [[[1.0 if axis in order[:n] else -1.0 for axis in range(3)] for n in range(4)] for order in permutations(range(3))]
)


def smallest_box(points: Float64Array, rotation: Float64Array) -> OrientedBox:
    """The smallest box around ``points`` (N, 3), N at least 1, whose axes are the columns of ``rotation`` (3, 3).

    >>> smallest_box(np.array([[0.0, 0, 0], [2, 1, 0]]), np.eye(3)).sizes.tolist()
    [2.0, 1.0, 0.0]
    """
    along_axes = rotation.T @ points.T  # (3, N): each axis in one piece, which takes a fraction of the time of (N, 3)
    low, high = along_axes.min(axis=1), along_axes.max(axis=1)
    return OrientedBox(rotation @ ((low + high) / 2), high - low, rotation)


def box_iou(first: OrientedBox, second: OrientedBox) -> float:
    """The volume in both boxes as a share of that in either, 0 where neither has a volume.

    >>> unit = OrientedBox(np.zeros(3), np.ones(3), np.eye(3))
    >>> round(box_iou(unit, OrientedBox(np.array([0.5, 0.0, 0.0]), np.ones(3), np.eye(3))), 12)
    0.333333333333
    """
    shared = shared_volume(first, second)
    either = float(np.prod(first.sizes) + np.prod(second.sizes)) - shared
    return shared / either if either > 0 else 0.0


def shared_volume(first: OrientedBox, second: OrientedBox) -> float:
    """The volume in m3 of what is in both boxes."""
    if not first.sizes.all() or not second.sizes.all():
        return 0.0
    middle, half = second.rotation.T @ (first.centre - second.centre), second.sizes / 2
    if np.array_equal(first.rotation, second.rotation):
        high, low = np.minimum(half, middle + first.sizes / 2), np.maximum(-half, middle - first.sizes / 2)
        return float(np.prod(np.maximum(high - low, 0.0)))
    # the first box, in the axes of the second, as tetrahedra that are cut at the second's six sides
    parts = (_TETRAHEDRA * (first.sizes / 2)) @ (second.rotation.T @ first.rotation).T + middle
    for axis in range(3):
        for sign in (-1.0, 1.0):
            parts = _cut(parts, half[axis] - sign * parts[:, :, axis])
    edges = parts[:, 1:] - parts[:, :1]
    return float(np.abs(np.linalg.det(edges)).sum() / 6)


def _cut(parts: Float64Array, inside: Float64Array) -> Float64Array:
    """What is left of tetrahedra (T, 4, 3) where ``inside`` (T, 4), linear over space, is above 0; as tetrahedra."""
    order = np.argsort(-inside, axis=1, kind="stable")
    inside = np.take_along_axis(inside, order, axis=1)
    parts = np.take_along_axis(parts, order[:, :, None], axis=1)
    n_inside = (inside > 0).sum(axis=1)
    left = [parts[n_inside == 4]]

    def crossing(rows: np.ndarray, near: int, far: int) -> Float64Array:
        """Where the edges from the corners ``near`` to the corners ``far`` leave."""
        share = inside[rows, near] / (inside[rows, near] - inside[rows, far])
        point: Float64Array = parts[rows, near] + share[:, None] * (parts[rows, far] - parts[rows, near])
        return point

    one, two, three = (np.flatnonzero(n_inside == n) for n in (1, 2, 3))
    left.append(np.stack([parts[one, 0], *(crossing(one, 0, far) for far in (1, 2, 3))], axis=1))
    left += _wedge(
        [parts[two, 0], crossing(two, 0, 2), crossing(two, 0, 3)],
        [parts[two, 1], crossing(two, 1, 2), crossing(two, 1, 3)],
    )
    left += _wedge([parts[three, k] for k in range(3)], [crossing(three, k, 3) for k in range(3)])
    return np.concatenate(left)


def _wedge(first: list[Float64Array], second: list[Float64Array]) -> list[Float64Array]:
    """Wedges between triangles of three corners (T, 3) each as three lots of tetrahedra (T, 4, 3)."""
    a, b, c = first
    x, y, z = second
    return [np.stack(corners, axis=1) for corners in ((a, b, c, z), (a, b, y, z), (a, x, y, z))]
