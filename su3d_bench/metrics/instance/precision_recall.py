"""The area under raw precision-recall polylines, to the bit that the official ScanNet evaluator gives."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array, Int64Array

_SPLITTER = 134217729.0  # 2**27 + 1: Veltkamp's constant, cuts a double into two halves of 26 bits
ROWS_AT_ONCE = 1 << 20  # of the curves that are formed side by side, which bounds the memory that they take


def average_precision(scores: Float64Array, is_true: BoolArray, n_missed: int) -> float:
    """Area under the raw precision-recall polyline, one vertex a distinct score and the vertex (recall 0, precision 1).

    Rows are the counted predictions of one class; 0 where there is none (pull request 26).

    >>> average_precision(np.array([1.0, 1.0, 1.0]), np.array([True, True, False]), 2)  # recall (1 + precision) / 2
    0.41666666666666663
    """
    cell = np.zeros(len(scores), np.int64)
    return float(average_precisions(cell, scores, is_true, np.array([n_missed]), np.array([True]))[0])


def average_precisions(
    cell: Int64Array, score: Float64Array, is_true: BoolArray, n_missed: Int64Array, is_wanted: BoolArray
) -> Float64Array:
    """``average_precision`` of the rows of each cell, NaN where it is not wanted.

    ``cell`` (E,), ``score`` (E,) and ``is_true`` (E,) are one row a counted prediction, ``n_missed`` and ``is_wanted``
    one value a cell.
    """
    rows = np.flatnonzero(is_wanted[cell])
    order = rows[np.argsort(score[rows])]  # the order of equal scores moves no curve
    order = order[np.argsort(cell[order].astype(np.min_scalar_type(len(n_missed))), kind="stable")]
    bounds = np.searchsorted(cell[order], np.arange(len(n_missed) + 1))
    score, is_true = score[order], is_true[order]
    values = np.where(is_wanted, 0.0, np.nan)
    with_rows = np.flatnonzero(np.diff(bounds))
    starts, ends = bounds[with_rows], bounds[with_rows + 1]
    first = 0
    while first < len(with_rows):
        last = max(first + 1, int(np.searchsorted(ends, starts[first] + ROWS_AT_ONCE, side="right")))
        own = slice(starts[first], ends[last - 1])
        cells = with_rows[first:last]
        values[cells] = _areas(score[own], is_true[own], starts[first:last] - own.start, n_missed[cells])
        first = last
    return values


def _areas(score: Float64Array, is_true: BoolArray, starts: Int64Array, n_missed: Int64Array) -> Float64Array:
    """The area (C,) of each cell; its rows begin at ``starts`` (C,) and come with rising score, and it has some."""
    n_rows = np.diff(starts, append=len(score))
    is_vertex = np.append(True, score[1:] != score[:-1])
    is_vertex[starts] = True
    row, cell = np.flatnonzero(is_vertex), np.repeat(np.arange(len(starts)), n_rows)[is_vertex]
    n_true_before = np.append(0, np.cumsum(is_true))
    n_true = n_true_before[starts + n_rows] - n_true_before[starts]
    hits = n_true_before[starts + n_rows][cell] - n_true_before[row]
    # behind the vertices of each cell come the vertex (recall 0, precision 1) and a second recall of 0
    n_vertices = np.bincount(cell)
    ends = np.cumsum(n_vertices + 2)
    at = np.arange(len(row)) + 2 * cell
    precision, recall = np.ones(ends[-1]), np.zeros(ends[-1])
    precision[at] = hits / ((starts + n_rows)[cell] - row)
    # every instance is either a true positive at some score or missed, so the denominator is one constant
    with np.errstate(invalid="ignore"):
        recall[at] = hits / (n_true + n_missed)[cell]
    # convolution with (-1/2, 0, 1/2): halving is exact, so this equals numpy.convolve in every bit
    width = np.zeros(ends[-1])
    width[1:-1] = 0.5 * (recall[:-2] - recall[2:])
    begins = ends - n_vertices - 2
    width[begins] = 0.5 * (recall[begins] - recall[begins + 1])
    return dots(precision, width, begins, n_vertices + 1)


# numpy hands ``np.dot`` to the BLAS, whose order of additions differs between processors: the same curve ends in
# another last bit on AVX2 than on AVX-512. The reference answers of the original evaluators come from OpenBLAS's
# AVX-512 kernel (kernel/x86_64/ddot_microk_skylakex-2.c, and the tail loop of ddot.c): we add in that order,
# in plain double arithmetic, many curves side by side.
def dots(left: Float64Array, right: Float64Array, starts: Int64Array, lengths: Int64Array) -> Float64Array:
    """The sum of products of each stretch, added as OpenBLAS's AVX-512 kernel adds them with fused multiply-adds.

    Values must be far from overflow and underflow, as precisions and recall steps are.

    >>> dots(np.array([1.0, 0.5, 0.25]), np.array([0.5, 0.25, 0.25]), np.array([0, 1]), np.array([3, 2])).tolist()
    [0.6875, 0.1875]
    """
    products = _exact_products(left, right)
    n_blocked = lengths - lengths % 16
    n_wide = n_blocked - n_blocked % 32
    wide = _chains(*products, starts, n_wide // 32, np.zeros((len(starts), 32)))
    # the halves of each 512-bit register fold into one of 256 bits, which takes the last block of 16
    halves = wide.reshape(-1, 4, 2, 4)
    lanes = (halves[:, :, 0] + halves[:, :, 1]).reshape(-1, 16)
    fours = _chains(*products, starts + n_wide, (n_blocked - n_wide) // 16, lanes).reshape(-1, 4, 4)
    four = ((fours[:, 0] + fours[:, 1]) + fours[:, 2]) + fours[:, 3]
    total = (four[:, 0] + four[:, 2]) + (four[:, 1] + four[:, 3])
    return _chains(*products, starts + n_blocked, lengths - n_blocked, total[:, None])[:, 0]


def _chains(
    product: Float64Array, error: Float64Array, starts: Int64Array, n_steps: Int64Array, totals: Float64Array
) -> Float64Array:
    """``totals`` (C, lanes) plus, a step each, the next exact products of every lane, rounded once a step."""
    order = np.argsort(-n_steps, kind="stable")
    totals, lanes = totals[order], np.arange(totals.shape[1])
    n_left = np.searchsorted(-n_steps[order], -np.arange(n_steps.max(initial=0)), side="left")
    for step, n in enumerate(n_left.tolist()):
        at = starts[order[:n], None] + (step * len(lanes) + lanes)
        totals[:n] = _rounded_once(product[at], error[at], totals[:n])
    back = np.empty_like(totals)
    back[order] = totals
    return back


def _rounded_once(product: Float64Array, error: Float64Array, total: Float64Array) -> Float64Array:
    """``product + error + total`` as a fused multiply-add gives it, where ``error`` is what rounding took.

    The sum of what two exact additions leave over is rounded to odd, so that the last addition rounds right (Boldo and
    Melquiond, Emulation of FMA and correctly rounded sums, IEEE Transactions on Computers 57, 2008).
    """
    high, low = _exact_sums(total, error)
    high, middle = _exact_sums(product, high)
    rest, lost = _exact_sums(low, middle)
    bits = rest.view(np.int64)
    is_even = (lost != 0) & (bits & 1 == 0)
    bits += np.where(is_even, np.where((lost > 0) == (rest > 0), 1, -1), 0)
    return high + rest


def _exact_sums(left: Float64Array, right: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Knuth's sum: rounded sums and what rounding took from them; the two add up to the exact sums."""
    total = left + right
    part = total - left
    return total, (left - (total - part)) + (right - part)


def _exact_products(left: Float64Array, right: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Dekker's product: rounded products and what rounding took from them; the two add up to the exact products."""
    product = left * right
    left_high, left_low = _halves(left)
    right_high, right_low = _halves(right)
    error = left_low * right_low - (
        ((product - left_high * right_high) - left_low * right_high) - left_high * right_low
    )
    return product, error


def _halves(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    scaled = _SPLITTER * values
    high = scaled - (scaled - values)
    return high, values - high
