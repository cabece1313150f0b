"""The hand-computed example in docs/numbers/from-map-to-metric.md equals the code, and its modules exist."""

from __future__ import annotations

import re
from fractions import Fraction

import numpy as np
import pytest
from places import ROOT

from su3d_bench.metrics.instance.average_precision import THRESHOLDS, ap_columns, average_precision

PAGE = (ROOT / "docs" / "numbers" / "from-map-to-metric.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| [A-C] \| ([\d.]+) \| [^|]* \| ([^|]+) \|$", PAGE, re.MULTILINE)
FOUND = [(float(confidence), float(iou.rpartition("= ")[2])) for confidence, iou in ROWS]
N_CHAIRS = 3


def by_hand(threshold: float) -> Fraction:
    """The page's sum: each row's precision times half the recall between its neighbours."""
    hits = [iou > threshold for _, iou in sorted(FOUND, reverse=True)]
    taken = range(len(hits) + 1)
    precision = [Fraction(sum(hits[:n]), n) if n else Fraction(1) for n in taken]
    recall = [Fraction(sum(hits[:n]), N_CHAIRS) for n in taken]
    around = [Fraction(0), *recall, recall[-1]]
    return sum((precision[n] * (around[n + 2] - around[n]) / 2 for n in taken), Fraction(0))


def test_three_instances_of_the_page_are_found() -> None:
    assert sorted(FOUND) == [(0.8, 0.6), (0.85, 0.0), (0.9, 1.0)]


@pytest.mark.parametrize("threshold", [0.5, 0.6, 0.25])
def test_hand_computed_area_equals_the_evaluator(threshold: float) -> None:
    scores, is_true = np.array([one[0] for one in FOUND]), np.array([iou > threshold for _, iou in FOUND])
    assert average_precision(scores, is_true, N_CHAIRS - int(is_true.sum())) == pytest.approx(float(by_hand(threshold)))


def test_fractions_on_the_page_add_up_to_its_sum() -> None:
    of_ap = [THRESHOLDS[column] for column in ap_columns(THRESHOLDS)]
    ap = sum(map(by_hand, of_ap), Fraction(0)) / len(of_ap)
    assert f"= {by_hand(0.5)} = {100 * float(by_hand(0.5)):.1f} %" in PAGE
    assert f"= {ap} = {100 * float(ap):.1f} %" in PAGE
    result = " / ".join(f"{50 * float(value):.1f}" for value in (ap, by_hand(0.5), by_hand(0.25)))
    assert result in PAGE  # half of the chair's, because the table's is 0


def test_every_module_named_on_the_page_exists() -> None:
    way = PAGE.split("## Steps")[1].split("\n## ")[0]
    named = re.findall(r"`([a-z_]+/[a-z_/]*(?:\.py)?)`", way)
    assert len(named) >= 12
    for place in named:
        assert (ROOT / place).exists() or (ROOT / "su3d_bench" / place).exists(), place
