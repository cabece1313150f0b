"""Compiled loops of the segmenter over pixels and its graph; import this module only to segment a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.compiled import njit
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from su3d_bench.numerics.clusters import root_of


@njit(cache=True)
def discontinuities(disparity: Float32Array, jump: float, margin: float, slope_factor: float) -> BoolArray:
    """Pixels (H, W) next to a jump of the relative disparity that the slopes on its two sides do not explain.

    Steps below ``margin`` (1/m) are noise.
    """
    height, width = disparity.shape
    broken = np.zeros((height, width), np.bool_)
    for axis in range(2):
        dv, du = (0, 1) if axis == 0 else (1, 0)
        for v in range(height - dv):
            for u in range(width - du):
                here, there = disparity[v, u], disparity[v + dv, u + du]
                if here <= 0 or there <= 0:
                    continue
                step = abs(there - here)
                limit = jump * max(here, there) + margin
                if step <= limit:
                    continue
                slope = 1e30
                if v >= dv and u >= du and disparity[v - dv, u - du] > 0:
                    slope = min(slope, abs(here - disparity[v - dv, u - du]))
                if v + 2 * dv < height and u + 2 * du < width and disparity[v + 2 * dv, u + 2 * du] > 0:
                    slope = min(slope, abs(disparity[v + 2 * dv, u + 2 * du] - there))
                if slope > 1e29:
                    slope = 0.0
                if step > limit + slope_factor * slope:
                    broken[v, u] = True
                    broken[v + dv, u + du] = True
    return broken


@njit(cache=True)
def _sums(disparity: Float32Array, x: Float64Array, y: Float64Array) -> Float64Array:
    """Integral images (9, H + 1, W + 1) of the moments of a plane fit over the valid pixels."""
    height, width = disparity.shape
    table = np.zeros((height + 1, width + 1, 9), np.float64)
    row = np.zeros(9, np.float64)
    for v in range(height):
        row[:] = 0.0
        for u in range(width):
            q = np.float64(disparity[v, u])
            if q > 0:
                row[0] += 1.0
                row[1] += x[u]
                row[2] += y[v]
                row[3] += x[u] * x[u]
                row[4] += x[u] * y[v]
                row[5] += y[v] * y[v]
                row[6] += q
                row[7] += x[u] * q
                row[8] += y[v] * q
            for k in range(9):
                table[v + 1, u + 1, k] = table[v, u + 1, k] + row[k]
    return table


@njit(cache=True)
def fit_planes(disparity: Float32Array, radius: Int32Array, x: Float64Array, y: Float64Array) -> Float32Array:
    """Planes (H, W, 3): (A, B, C) with 1/z = A x + B y + C in the square window of ``radius``; zeros where unknown.

    ``x`` (W,) and ``y`` (H,) are the ray coordinates (u - cx) / fx and (v - cy) / fy. Since A X + B Y + C Z = 1, the
    vector (A, B, C) is a normal of the plane, pointing away from the camera, whose length is 1 / distance.
    """
    height, width = disparity.shape
    table = _sums(disparity, x, y)
    planes = np.zeros((height, width, 3), np.float32)
    m = np.zeros(9, np.float64)
    for v in range(height):
        for u in range(width):
            if disparity[v, u] <= 0:
                continue
            r = radius[v, u]
            v0, v1 = max(v - r, 0), min(v + r + 1, height)
            u0, u1 = max(u - r, 0), min(u + r + 1, width)
            for k in range(9):
                m[k] = table[v1, u1, k] - table[v0, u1, k] - table[v1, u0, k] + table[v0, u0, k]
            n = m[0]
            if n < 4:
                continue
            mx, my, mq = m[1] / n, m[2] / n, m[6] / n
            sxx, sxy, syy = m[3] - n * mx * mx, m[4] - n * mx * my, m[5] - n * my * my
            sxq, syq = m[7] - n * mx * mq, m[8] - n * my * mq
            det = sxx * syy - sxy * sxy
            if det <= 1e-9 * sxx * syy or det <= 0:
                continue
            a = (sxq * syy - syq * sxy) / det
            b = (syq * sxx - sxq * sxy) / det
            planes[v, u, 0] = a
            planes[v, u, 1] = b
            planes[v, u, 2] = mq - a * mx - b * my
    return planes


@njit(cache=True)
def _misfit(
    a: float, b: float, c: float, disparity: Float32Array, v: int, u: int, x: Float64Array, y: Float64Array
) -> float:
    """Mean relative error of a plane at (v, u) and those of its four neighbours that are near it in depth."""
    height, width = disparity.shape
    here = disparity[v, u]
    base = a * x[u] + b * y[v] + c
    total = abs(base - here)
    n = 1
    for axis in range(2):
        for sign in (-1, 1):
            v1, u1 = (v, u + sign) if axis == 0 else (v + sign, u)
            if v1 < 0 or v1 >= height or u1 < 0 or u1 >= width:
                continue
            there = disparity[v1, u1]
            if abs(there - here) < 0.03 * here:
                total += abs(a * x[u1] + b * y[v1] + c - there)
                n += 1
    return float(total / (n * here))


@njit(cache=True)
def sharpen_planes(
    planes: Float32Array,
    disparity: Float32Array,
    reach: int,
    own_bonus: float,
    margin: float,
    x: Float64Array,
    y: Float64Array,
) -> Float32Array:
    """For every pixel the best fitting plane, among its own and those ``reach`` pixels away in eight directions.

    Windows that straddle an edge blur it; a window one step to the side is on one surface. A pixel keeps its own plane
    unless another misfit is smaller by ``own_bonus`` (relative depth) and a quarter of the noise ``margin`` (1/m).
    """
    height, width = disparity.shape
    sharp = planes.copy()
    for v in range(height):
        for u in range(width):
            if disparity[v, u] <= 0:
                continue
            a, b, c = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            best = 1e30
            if a != 0 or b != 0 or c != 0:
                best = _misfit(a, b, c, disparity, v, u, x, y) - own_bonus - 0.25 * margin / disparity[v, u]
                if best <= 0:
                    continue
            for step in range(9):
                v1, u1 = v + (step // 3 - 1) * reach, u + (step % 3 - 1) * reach
                if step == 4 or v1 < 0 or u1 < 0 or v1 >= height or u1 >= width:
                    continue
                a, b, c = planes[v1, u1, 0], planes[v1, u1, 1], planes[v1, u1, 2]
                if a == 0 and b == 0 and c == 0:
                    continue
                misfit = _misfit(a, b, c, disparity, v, u, x, y)
                if misfit < best:
                    best = misfit
                    sharp[v, u, 0], sharp[v, u, 1], sharp[v, u, 2] = a, b, c
    return sharp


@njit(cache=True)
def double_planes(planes: Float32Array, disparity: Float32Array, x: Float64Array, y: Float64Array) -> Float32Array:
    """Planes at twice the resolution: of the four planes around a pixel, the best fit to its ``disparity``."""
    height, width = disparity.shape
    half_height, half_width = planes.shape[0], planes.shape[1]
    full = np.zeros((height, width, 3), np.float32)
    for v in range(height):
        for u in range(width):
            if disparity[v, u] <= 0:
                continue
            best = 1e30
            for step in range(4):
                v1, u1 = v // 2 + step // 2, u // 2 + step % 2
                if v1 >= half_height or u1 >= half_width:
                    continue
                a, b, c = planes[v1, u1, 0], planes[v1, u1, 1], planes[v1, u1, 2]
                if a == 0 and b == 0 and c == 0:
                    continue
                misfit = abs(a * x[u] + b * y[v] + c - disparity[v, u])
                if misfit < best:
                    best = misfit
                    full[v, u, 0], full[v, u, 1], full[v, u, 2] = a, b, c
    return full


@njit(cache=True)
def _reach(planes: Float32Array, v: int, u: int, x: float, y: float, q: float, worst: float) -> float:
    """The distance of the plane at (v, u) from disparity ``q`` at ray (x, y); ``worst`` if there is no plane."""
    a, b, c = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
    if a == 0 and b == 0 and c == 0:
        return worst
    return float(abs(a * x + b * y + c - q))


@njit(cache=True)
def _jump(
    disparity: Float32Array, planes: Float32Array, v: int, u: int, dv: int, du: int, x: Float64Array, y: Float64Array
) -> float:
    """Relative step in depth from (v, u) to (v + dv, u + du) that no extrapolation from either side explains."""
    height, width = disparity.shape
    v1, u1 = v + dv, u + du
    q0, q1 = disparity[v, u], disparity[v1, u1]
    step = abs(q1 - q0)
    step = min(step, _reach(planes, v, u, x[u1], y[v1], q1, step))
    step = min(step, _reach(planes, v1, u1, x[u], y[v], q0, step))
    if v >= dv and u >= du and disparity[v - dv, u - du] > 0:
        step = min(step, abs(2 * q0 - disparity[v - dv, u - du] - q1))
    if v1 + dv < height and u1 + du < width and disparity[v1 + dv, u1 + du] > 0:
        step = min(step, abs(2 * q1 - disparity[v1 + dv, u1 + du] - q0))
    return float(step / max(q0, q1))


@njit(cache=True)
def _chord(planes: Float32Array, v: int, u: int, v1: int, u1: int) -> float:
    """Distance of the unit normals of two pixels; 0 if one is unknown."""
    a0, b0, c0 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
    a1, b1, c1 = planes[v1, u1, 0], planes[v1, u1, 1], planes[v1, u1, 2]
    if a0 == a1 and b0 == b1 and c0 == c1:
        return 0.0
    square0, square1 = a0 * a0 + b0 * b0 + c0 * c0, a1 * a1 + b1 * b1 + c1 * c1
    if square0 == 0 or square1 == 0:
        return 0.0
    return float(np.sqrt(max(0.0, 2.0 - 2.0 * (a0 * a1 + b0 * b1 + c0 * c1) / np.sqrt(square0 * square1))))


@njit(cache=True)
def pair_costs(
    lab: Float32Array,
    disparity: Float32Array,
    planes: Float32Array,
    x: Float64Array,
    y: Float64Array,
    colour_unit: float,
    depth_unit: float,
    margin: float,
    normal_unit: float,
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Colour, depth and normal difference (2, H, W) of each pixel to its right (0) and lower (1) neighbour, in units.

    The depth difference is the part of the relative step that no slope explains; -1 if one of the two has no depth.
    """
    height, width = disparity.shape
    colour = np.zeros((2, height, width), np.float32)
    depth = np.full((2, height, width), np.float32(-1.0))
    normal = np.zeros((2, height, width), np.float32)
    for axis in range(2):
        dv, du = (0, 1) if axis == 0 else (1, 0)
        for v in range(height - dv):
            for u in range(width - du):
                v1, u1 = v + dv, u + du
                dl = lab[v1, u1, 0] - lab[v, u, 0]
                da = lab[v1, u1, 1] - lab[v, u, 1]
                db = lab[v1, u1, 2] - lab[v, u, 2]
                colour[axis, v, u] = np.sqrt(dl * dl + da * da + db * db) / colour_unit
                q0, q1 = disparity[v, u], disparity[v1, u1]
                if q0 <= 0 or q1 <= 0:
                    continue
                unit = depth_unit + margin / max(q0, q1)
                if abs(q1 - q0) < 0.1 * unit * q0:
                    depth[axis, v, u] = 0.0  # below a tenth of a jump: not worth an extrapolation
                else:
                    depth[axis, v, u] = _jump(disparity, planes, v, u, dv, du, x, y) / unit
                normal[axis, v, u] = _chord(planes, v, u, v1, u1) / normal_unit
    return colour, depth, normal


@njit(cache=True)
def grow_superpixels(cost: Float32Array, order: Int64Array, scale: float, min_size: int) -> Int32Array:
    """Labels (H, W) from 0 by the predicate of Felzenszwalb and Huttenlocher (2004) over ``cost`` (2, H, W).

    Pairs are visited in ``order``, their places in the flat ``cost``. Segments below ``min_size`` pixels then join
    across their cheapest pair.
    """
    height, width = cost.shape[1], cost.shape[2]
    n, weights = height * width, cost.ravel()
    parent = np.arange(n).astype(np.int32)
    size = np.ones(n, np.int32)
    limit = np.full(n, np.float32(scale))
    for step in range(2):
        for edge in order:
            pixel, step_to = (edge, 1) if edge < n else (edge - n, width)
            a, b = root_of(parent, pixel), root_of(parent, pixel + step_to)
            if a == b:
                continue
            weight = weights[edge]
            joins = weight <= limit[a] and weight <= limit[b]
            if step == 1:
                joins = size[a] < min_size or size[b] < min_size
            if joins:
                low, high = min(a, b), max(a, b)
                parent[high] = low
                size[low] += size[high]
                limit[low] = weight + scale / size[low]
    labels = np.empty((height, width), np.int32)
    number = np.full(n, np.int32(-1))
    n_labels = 0
    for v in range(height):
        for u in range(width):
            root = root_of(parent, v * width + u)
            if number[root] < 0:
                number[root] = n_labels
                n_labels += 1
            labels[v, u] = number[root]
    return labels


@njit(cache=True)
def sum_pixels(
    labels: Int32Array,
    n_labels: int,
    lab: Float32Array,
    contrast: Float32Array,
    disparity: Float32Array,
    planes: Float32Array,
    x: Float64Array,
    y: Float64Array,
) -> Float64Array:
    """Sums (N, 19) over each label's pixels.

    Columns: pixels, pixels with depth, colour (3), camera-frame point (3) m, its products
    xx xy xz yy yz zz, unit normal towards the camera (3), pairs of neighbours inside, their ``contrast`` (2, H, W).
    """
    height, width = labels.shape
    sums = np.zeros((n_labels, 19), np.float64)
    for v in range(height):
        for u in range(width):
            label = labels[v, u]
            row = sums[label]
            row[0] += 1.0
            for k in range(3):
                row[2 + k] += np.float64(lab[v, u, k])
            if u + 1 < width and labels[v, u + 1] == label:
                row[17] += 1.0
                row[18] += contrast[0, v, u]
            if v + 1 < height and labels[v + 1, u] == label:
                row[17] += 1.0
                row[18] += contrast[1, v, u]
            if disparity[v, u] <= 0:
                continue
            pz = 1.0 / disparity[v, u]
            px, py = x[u] * pz, y[v] * pz
            row[1] += 1.0
            row[5] += px
            row[6] += py
            row[7] += pz
            row[8] += px * px
            row[9] += px * py
            row[10] += px * pz
            row[11] += py * py
            row[12] += py * pz
            row[13] += pz * pz
            a, b, c = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            length = np.sqrt(a * a + b * b + c * c)
            if length > 0:
                row[14] -= a / length
                row[15] -= b / length
                row[16] -= c / length
    return sums


@njit(cache=True)
def connected(a: NDArray[np.intp], b: NDArray[np.intp], n: int) -> tuple[NDArray[np.intp], int]:
    """The component (n,) of each of ``n`` nodes under links from ``a`` to ``b`` (L,), and the number of components.

    Components are counted in the order of their first nodes.
    """
    parent = np.arange(n)
    for k in range(len(a)):
        i, j = root_of(parent, a[k]), root_of(parent, b[k])
        parent[max(i, j)] = min(i, j)
    component = np.empty(n, np.intp)
    n_components = 0
    for i in range(n):
        if parent[i] == i:
            component[i] = n_components
            n_components += 1
        else:  # a parent is a node before its children
            component[i] = component[parent[i]]
    return component, n_components


@njit(cache=True)
def sum_rows(label: NDArray[np.intp], values: Float64Array, n: int) -> Float64Array:
    """The sums (n, C) of the rows of ``values`` (N, C) with equal ``label`` (N,), added in their order."""
    sums = np.zeros((n, values.shape[1]))
    for i in range(len(label)):
        for c in range(values.shape[1]):
            sums[label[i], c] += values[i, c]
    return sums
