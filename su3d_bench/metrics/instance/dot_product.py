"""One dot product for every processor, so that the last bit of an AP does not depend on where it was computed.

numpy hands ``np.dot`` to the BLAS, whose order of additions differs between processors: the same curve ends in another
last bit on AVX2 than on AVX-512. The reference answers of the original evaluators come from OpenBLAS's AVX-512 kernel
(kernel/x86_64/ddot_microk_skylakex-2.c, and the tail loop of ddot.c); this module adds in that order, in plain double
arithmetic.
"""

from __future__ import annotations

import math

import numpy as np

from su3d_bench.core.types import Float64Array

_SPLITTER = 134217729.0  # 2**27 + 1: Veltkamp's constant, cuts a double into two halves of 26 bits


def dot(left: Float64Array, right: Float64Array) -> float:
    """The sum of products, added as OpenBLAS's AVX-512 kernel adds them with fused multiply-adds.

    Values must be far from overflow and underflow, as precisions and recall steps are.

    >>> dot(np.array([1.0, 0.5, 0.25]), np.array([0.5, 0.25, 0.25]))
    0.6875
    """
    product, error = _exact_products(np.asarray(left, np.float64), np.asarray(right, np.float64))
    n = len(product)
    n_blocked = n - n % 16
    total = 0.0
    if n_blocked:
        n_wide = n_blocked - n_blocked % 32
        wide = [_chain(product[lane:n_wide:32], error[lane:n_wide:32], 0.0) for lane in range(32)]
        # the halves of each 512-bit register fold into one of 256 bits, which takes the last block of 16
        lanes = [wide[8 * register + i] + wide[8 * register + i + 4] for register in range(4) for i in range(4)]
        lanes = [
            _chain(product[n_wide + i : n_blocked : 16], error[n_wide + i : n_blocked : 16], lane)
            for i, lane in enumerate(lanes)
        ]
        four = [((lanes[i] + lanes[4 + i]) + lanes[8 + i]) + lanes[12 + i] for i in range(4)]
        total = (four[0] + four[2]) + (four[1] + four[3])
    return _chain(product[n_blocked:], error[n_blocked:], total)


def _chain(products: list[float], errors: list[float], start: float) -> float:
    """``start`` plus each exact product in turn, rounded once a step, as a fused add does (fsum rounds right)."""
    total = start
    for product, error in zip(products, errors, strict=True):
        total = math.fsum((product, error, total))
    return total


def _exact_products(left: Float64Array, right: Float64Array) -> tuple[list[float], list[float]]:
    """Dekker's product: rounded products and what rounding took from them; the two add up to the exact products."""
    product = left * right
    left_high, left_low = _halves(left)
    right_high, right_low = _halves(right)
    error = left_low * right_low - (
        ((product - left_high * right_high) - left_low * right_high) - left_high * right_low
    )
    return product.tolist(), error.tolist()


def _halves(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    scaled = _SPLITTER * values
    high = scaled - (scaled - values)
    return high, values - high
