"""Agreement coefficients compared with the examples of their publications and with hand-computed values."""

from __future__ import annotations

import doctest

import numpy as np
import pytest

import su3d_bench.human_eval.answers as module
from su3d_bench.core.types import Int64Array
from su3d_bench.human_eval.answers import (
    agreement,
    cohen_kappa,
    fleiss_kappa,
    gwet_ac1,
    krippendorff_alpha,
)

# Fleiss 1971, Psychological Bulletin 76, table 1: 30 patients, 6 psychiatrists each, 5 diagnoses; kappa = .430
FLEISS = """00060 03003 01401 00006 03030 20400 00402 20310 20040 00006 10050 11040 03300 10050 02031 00501 30012 51000
02040 10203 00006 01050 02013 20040 10041 05010 40002 02040 10500 00006"""
# Krippendorff 2011, Computing Krippendorff's Alpha-Reliability: examples A to C; . is missing
BINARY = ("0100000010", "1110010000")
NOMINAL = ("aabbdcccedda", "babbbccceddd")
WITH_GAPS = ("123321412...", "1233224125.3", ".3332342251.", "12332441251.")


def counts_of(*observers: str) -> Int64Array:
    values = sorted(set("".join(observers)) - {"."})
    return np.array([[unit.count(value) for value in values] for unit in zip(*observers, strict=True)], np.int64)


def repeated(table: list[list[int]]) -> tuple[list[str], list[str]]:
    """The answers of two annotators with this cross table."""
    left, right = [], []
    for i, row in enumerate(table):
        for j, n in enumerate(row):
            left += [str(i)] * n
            right += [str(j)] * n
    return left, right


def test_docstring_examples_run() -> None:
    assert doctest.testmod(module).failed == 0


def test_fleiss_kappa_matches_the_published_example() -> None:
    table = np.array([[int(one) for one in row] for row in FLEISS.split()])
    assert table.shape == (30, 5)
    assert fleiss_kappa(table) == pytest.approx(0.430, abs=5e-4)


@pytest.mark.parametrize(("observers", "alpha"), [(BINARY, 0.095), (NOMINAL, 0.692), (WITH_GAPS, 0.743)])
def test_krippendorffs_alpha_matches_the_published_examples(observers: tuple[str, ...], alpha: float) -> None:
    assert krippendorff_alpha(counts_of(*observers)) == pytest.approx(alpha, abs=5e-4)


def test_ac1_matches_the_published_examples_and_a_hand_worked_one() -> None:
    # README of the author's R package irrCAC: raw4raters (the ratings of WITH_GAPS) and 3x3abstractors
    assert gwet_ac1(counts_of(*WITH_GAPS)) == pytest.approx(0.77544, abs=5e-6)
    both = repeated([[13, 0, 0], [0, 20, 7], [0, 4, 56]])
    assert gwet_ac1(counts_of(*("".join(one) for one in both))) == pytest.approx(0.8493305, abs=5e-8)
    # shares 3/4 and 1/4: by chance 2 x 3/4 x 1/4 = 3/8; two of four items equal
    assert gwet_ac1(np.array([[2, 0], [2, 0], [1, 1], [1, 1]])) == pytest.approx((1 / 2 - 3 / 8) / (1 - 3 / 8))
    assert gwet_ac1(np.array([[2, 0, 0], [2, 0, 0]])) == 1.0  # where kappa is undefined


def test_cohens_kappa_matches_the_published_example() -> None:
    # Cohen 1960, Educational and Psychological Measurement 20, table 1, as counts of 100: (.29 - .35) / .65 = -.092
    left, right = repeated([[25, 13, 12], [12, 2, 16], [3, 15, 2]])
    assert cohen_kappa(left, right) == pytest.approx((0.29 - 0.35) / 0.65)


def test_agreement_is_undefined_without_two_answers_or_items() -> None:
    always = np.array([[2, 0], [2, 0]])
    assert fleiss_kappa(always) is None
    assert krippendorff_alpha(always) is None
    assert cohen_kappa(["right"] * 3, ["right"] * 3) is None
    assert cohen_kappa([], []) is None
    nothing = np.zeros((0, 2), np.int64)
    assert fleiss_kappa(nothing) is None
    for coefficient in (krippendorff_alpha, gwet_ac1):
        assert coefficient(nothing) is None
        assert coefficient(np.array([[1, 0], [0, 1]])) is None  # no item with two answers


def test_all_agreement_coefficients_of_a_question() -> None:
    ratings = {
        "a": {"ann": "right", "bob": "right", "cyn": "right"},
        "b": {"ann": "wrong", "bob": "wrong"},
        "c": {"ann": "right", "bob": "wrong"},
        "d": {"ann": "wrong", "bob": "wrong"},
        "e": {"cyn": "wrong"},
    }
    found = agreement(ratings, ("right", "wrong"))
    assert (found.n_annotators, found.n_items, found.n_equal) == (3, 4, 3)
    assert (found.n_fleiss, found.n_raters) == (3, 2)  # three items have two answers, one has three
    # of b, c, d: observed 2/3; right 1/6, wrong 5/6: by chance 26/36
    assert found.fleiss == pytest.approx((2 / 3 - 26 / 36) / (1 - 26 / 36))
    pairs = {(one.left, one.right): one for one in found.pairs}
    assert list(pairs) == [("ann", "bob"), ("ann", "cyn"), ("bob", "cyn")]
    # ann: 2 right 2 wrong; bob: 1 right 3 wrong; agree 3/4; by chance .5 x .25 + .5 x .75 = .5
    assert pairs["ann", "bob"].kappa == pytest.approx(0.5)
    assert (pairs["ann", "bob"].n, pairs["ann", "bob"].n_equal) == (4, 3)
    assert (pairs["ann", "cyn"].n, pairs["ann", "cyn"].kappa) == (1, None)
    # n = 9, right 4, wrong 5; disagreeing pairs of c: 2; 1 - 8 x 2 / (81 - 16 - 25)
    assert found.alpha == pytest.approx(1 - 8 * 2 / 40)
    # right: 1, 0, 1/2, 0, 0 of the five items' answers; three of four items equal
    by_chance = 2 * 0.3 * 0.7
    assert found.ac1 == pytest.approx((3 / 4 - by_chance) / (1 - by_chance))
    assert found.interval is None  # four items


def test_alpha_interval_is_a_jackknife_over_items() -> None:
    answers = ["rr", "ww", "rw", "rr", "ww", "rr", "wr", "rr", "ww", "rr", "rw"]
    ratings = {str(k): dict(zip("xy", both, strict=True)) for k, both in enumerate(answers)}
    found = agreement(ratings, ("r", "w"))
    counts = np.array([[both.count("r"), both.count("w")] for both in answers])
    without = np.array([krippendorff_alpha(np.delete(counts, k, axis=0)) for k in range(11)], np.float64)
    assert found.alpha is not None
    error = np.std(11 * found.alpha - 10 * without, ddof=1) / np.sqrt(11)
    half = 2.2281388519649385 * error  # Student's t, 10 degrees of freedom
    assert found.interval == pytest.approx((found.alpha - half, min(1.0, found.alpha + half)), rel=1e-9)
