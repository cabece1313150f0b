"""How far people who judge the same things agree, beyond what chance would give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array, Interval
from su3d_bench.numerics.statistics import DIFFERENCE, LEAST_ITEMS, jackknife_interval, leave_one_out

Ratings = Mapping[str, Mapping[str, str]]  # item -> annotator -> answer


@dataclass(frozen=True)
class PairAgreement:
    """Cohen's kappa of two annotators over the ``n`` items that both answered; None where it is undefined."""

    left: str
    right: str
    n: int
    n_equal: int
    kappa: float | None


@dataclass(frozen=True)
class Agreement:
    """What can be said of one question: its items with two answers or more, and the coefficients over them.

    ``fleiss`` is of the ``n_fleiss`` items with ``n_raters`` answers each, the number that most of them have. ``alpha``
    is Krippendorff's for nominal data, of all; its ``interval`` is over items, of at least ten. None: undefined, for
    want of items or because nobody ever chose a second answer.
    """

    n_annotators: int
    n_items: int
    n_equal: int
    pairs: tuple[PairAgreement, ...]
    fleiss: float | None
    n_fleiss: int
    n_raters: int
    alpha: float | None
    interval: Interval | None


def agreement(ratings: Ratings) -> Agreement:
    """All coefficients for one question; ``ratings`` may hold items with a single answer, which say nothing."""
    answers = sorted({answer for item in ratings.values() for answer in item.values()})
    annotators = sorted({annotator for item in ratings.values() for annotator in item})
    given = [list(item.values()) for item in ratings.values()]
    counts = np.array([[item.count(answer) for answer in answers] for item in given], np.int64)
    counts = counts.reshape(-1, len(answers))
    counts = counts[counts.sum(axis=1) >= 2]
    sizes = counts.sum(axis=1)
    n_raters = 0 if not len(sizes) else int(np.argmax(np.bincount(sizes)))
    even = counts[sizes == n_raters]
    alpha = krippendorff_alpha(counts)
    interval = None
    if alpha is not None and len(counts) >= LEAST_ITEMS:
        # Fleiss and Davies, Jackknifing functions of multinomial frequencies, Am. J. of Epidemiology 115 (1982)
        values = krippendorff_alphas(counts, leave_one_out(len(counts)))
        interval = jackknife_interval(values, bounds=DIFFERENCE)
    return Agreement(
        n_annotators=len(annotators),
        n_items=len(counts),
        n_equal=int(np.count_nonzero(counts.max(axis=1, initial=0) == sizes)),
        pairs=tuple(_pair(ratings, left, right) for left, right in combinations(annotators, 2)),
        fleiss=fleiss_kappa(even),
        n_fleiss=len(even),
        n_raters=n_raters,
        alpha=alpha,
        interval=interval,
    )


def _pair(ratings: Ratings, left: str, right: str) -> PairAgreement:
    both = [(item[left], item[right]) for item in ratings.values() if left in item and right in item]
    kappa = cohen_kappa([answer for answer, _ in both], [other for _, other in both])
    return PairAgreement(left, right, len(both), sum(answer == other for answer, other in both), kappa)


def cohen_kappa(left: Sequence[str], right: Sequence[str]) -> float | None:
    """Cohen's kappa [Cohen 1960] of two annotators' answers to the same items, in the same order.

    None without items, and where both gave one and the same answer throughout: chance alone would agree so.
    """
    if len(set(left) | set(right)) < 2:
        return None
    from sklearn.metrics import cohen_kappa_score

    return float(cohen_kappa_score(list(left), list(right)))


def fleiss_kappa(counts: Int64Array) -> float | None:
    """Fleiss' kappa [Fleiss 1971, equation 7] of items (rows) by answers (columns); all rows have the same sum >= 2.

    None without items, and where only one answer was ever given.

    >>> round(fleiss_kappa(np.array([[2, 0], [0, 2], [1, 1], [2, 0]])), 4)
    0.4667
    """
    if not len(counts) or np.count_nonzero(counts.sum(axis=0)) < 2:
        return None
    n = int(counts[0].sum())
    assert n >= 2 and np.all(counts.sum(axis=1) == n)
    observed = float(((counts**2).sum(axis=1) - n).sum()) / (len(counts) * n * (n - 1))
    shares = counts.sum(axis=0) / counts.sum()
    by_chance = float((shares**2).sum())
    return (observed - by_chance) / (1.0 - by_chance)


def krippendorff_alpha(counts: Int64Array) -> float | None:
    """Krippendorff's alpha for nominal data [Krippendorff 2011, section D] of items (rows) by answers (columns).

    Items may have any number of answers; those with fewer than two have no part in it. None without such items, and
    where only one answer was ever given.

    >>> round(krippendorff_alpha(np.array([[2, 0], [0, 2], [1, 1], [2, 0]])), 4)
    0.5333
    """
    pairable = counts[counts.sum(axis=1) >= 2]
    if not len(pairable) or np.count_nonzero(pairable.sum(axis=0)) < 2:
        return None
    return float(krippendorff_alphas(pairable, np.ones((1, len(pairable)), np.int64))[0])


def krippendorff_alphas(counts: Int64Array, weights: Int64Array) -> Float64Array:
    """Alpha for each row of how often each item is drawn (R, N); NaN where only one answer is left."""
    sizes = counts.sum(axis=1)
    # o_cc, the diagonal of the coincidence matrix: ordered pairs of equal answers in an item, over its size less one
    equal = (counts * (counts - 1)).sum(axis=1) / (sizes - 1)
    totals = (weights @ counts).astype(np.float64)  # n_c
    n = totals.sum(axis=1)
    observed = n - weights @ equal  # disagreeing pairs
    expected = (n**2 - (totals**2).sum(axis=1)) / (n - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        alphas: Float64Array = np.where(expected > 0, 1.0 - observed / expected, np.nan)
    return alphas
