"""Shares of a difference: exact by every order, drawn where there are too many, summing to the whole either way."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest

from su3d_bench.numerics.statistics import EXACT_STEPS, N_ORDERS, choices, shares


def drawn_values(n_steps: int, seed: int = 1) -> list[float]:
    return list(map(float, np.random.default_rng(seed).random(1 << n_steps)))


@pytest.mark.parametrize("n_steps", [1, 2, 3, 5])
def test_a_share_is_the_mean_over_every_order(n_steps: int) -> None:
    values = drawn_values(n_steps)
    added: list[list[float]] = [[] for _ in range(n_steps)]
    for order in permutations(range(n_steps)):
        bits = 0
        for step in order:
            added[step].append(values[bits | 1 << step] - values[bits])
            bits |= 1 << step
    for found, of_step in zip(shares(n_steps, values.__getitem__), added, strict=True):
        assert found.share == pytest.approx(np.mean(of_step), abs=1e-14)
        assert (found.least, found.most) == (min(of_step), max(of_step))
        assert found.standard_error == 0.0


@pytest.mark.parametrize("n_steps", [EXACT_STEPS, EXACT_STEPS + 1, 12])
def test_shares_sum_to_the_difference(n_steps: int) -> None:
    values = drawn_values(n_steps)
    asked = []
    found = shares(n_steps, lambda bits: asked.append(bits) or values[bits])  # type: ignore[func-returns-value]
    assert math.fsum(one.share for one in found) == pytest.approx(values[-1] - values[0], abs=1e-12)
    assert set(asked) == set(choices(n_steps))


def test_drawn_shares_lie_about_those_of_all_orders_as_their_errors_say() -> None:
    # A step's share of a sum of its own part and of those of pairs is known without drawing.
    n_steps = 10
    generator = np.random.default_rng(0)
    alone, pairs = generator.normal(size=n_steps), np.triu(generator.normal(size=(n_steps, n_steps)), 1)

    def value(bits: int) -> float:
        has = np.array([bits >> step & 1 for step in range(n_steps)])
        return float(alone @ has + has @ pairs @ has)

    known = alone + (pairs.sum(axis=0) + pairs.sum(axis=1)) / 2
    found = shares(n_steps, value)
    errors = np.array([one.standard_error for one in found])
    assert (errors > 0).all() and errors.max() < 4 / math.sqrt(N_ORDERS)
    assert (np.abs([one.share for one in found] - known) < 4 * errors).all()
    assert shares(n_steps, value) == found
    assert shares(n_steps, value, seed=1) != found
