"""How the difference between two values is split among the steps that lead from one to the other.

What a step adds depends on those before it; its share is the mean over the orders of the steps (Shapley 1953, "A value
for n-person games"), so that the shares sum to the difference whatever the steps do to one another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

EXACT_STEPS = 8  # up to so many every choice of steps is taken: 256 values
N_ORDERS = 200  # that are drawn of more

Value = Callable[[int], float]  # of the steps whose bits are set


@dataclass(frozen=True)
class Share:
    """Of one step: its ``share``, the ``least`` and the ``most`` that it adds anywhere, and what drawing leaves open.

    ``standard_error`` is 0 where every order was taken.
    """

    share: float
    least: float
    most: float
    standard_error: float


def choices(n_steps: int, seed: int = 0) -> list[int]:
    """The sets of steps, as bits, whose values ``shares`` asks for.

    >>> choices(2)
    [0, 1, 2, 3]
    """
    if n_steps <= EXACT_STEPS:
        return list(range(1 << n_steps))
    return sorted({bits for order in _orders(n_steps, seed) for bits in _walk(order)})


def shares(n_steps: int, value: Value, seed: int = 0) -> list[Share]:
    """The share of each step in ``value(all) - value(none)``, which is their sum up to the last bits.

    Exact for at most ``EXACT_STEPS``; over ``N_ORDERS`` orders that ``seed`` draws otherwise.

    >>> [one.share for one in shares(2, lambda bits: {0: 0.0, 1: 1.0, 2: 2.0, 3: 5.0}[bits])]
    [2.0, 3.0]
    """
    if n_steps > EXACT_STEPS:
        return _drawn(n_steps, value, seed)
    # In which share of all orders just these steps come before another one.
    weights = [1 / (n_steps * math.comb(n_steps - 1, size)) for size in range(n_steps)]
    found = []
    for step in range(n_steps):
        added = [
            (value(bits | 1 << step) - value(bits), weights[bits.bit_count()])
            for bits in range(1 << n_steps)
            if not bits >> step & 1
        ]
        share = math.fsum(difference * weight for difference, weight in added)
        found.append(Share(share, min(added)[0], max(added)[0], 0.0))
    return found


def _drawn(n_steps: int, value: Value, seed: int) -> list[Share]:
    added: list[list[float]] = [[] for _ in range(n_steps)]
    for order in _orders(n_steps, seed):
        for step, (before, after) in zip(order, pairwise(_walk(order)), strict=True):
            added[step].append(value(after) - value(before))
    root = math.sqrt(N_ORDERS)
    return [Share(math.fsum(one) / N_ORDERS, min(one), max(one), float(np.std(one, ddof=1)) / root) for one in added]


def _orders(n_steps: int, seed: int) -> list[list[int]]:
    generator = np.random.default_rng(seed)
    return [generator.permutation(n_steps).tolist() for _ in range(N_ORDERS)]


def _walk(order: Sequence[int]) -> list[int]:
    """The sets of steps on the way, from none to all."""
    found = [0]
    for step in order:
        found.append(found[-1] | 1 << step)
    return found
