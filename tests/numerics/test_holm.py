"""Several tests at once."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from su3d_bench.numerics.holm import holm


def test_the_worked_example_of_four_tests() -> None:
    """By hand: 4 x 0.005, 3 x 0.01, 2 x 0.03, and the last no less than the one before."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx((0.03, 0.06, 0.06, 0.02))


def test_without_tests_there_is_nothing_to_adjust_and_one_stays_as_it_is() -> None:
    assert holm([]) == ()
    assert holm([0.04]) == (0.04,)


@given(st.lists(st.floats(0, 1), max_size=20))
def test_no_adjusted_p_is_smaller_than_its_own_or_above_one_and_their_order_is_kept(p_values: list[float]) -> None:
    adjusted = holm(p_values)
    assert all(p <= value <= 1 for p, value in zip(p_values, adjusted, strict=True))
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    assert [adjusted[k] for k in order] == sorted(adjusted)
