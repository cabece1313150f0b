"""From the judgements of annotators to accuracies: counting, simulated annotators, and output."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from simulated_annotators import RATES, annotation_set, answered, retrieval_set, scored

from su3d_bench.core.types import Float64Array
from su3d_bench.human_eval.items import Key, Sheet
from su3d_bench.human_eval.scores import ScoreCell, Scores, paired_p, review_items_csv, review_items_page
from su3d_bench.numerics.statistics import sign_flip_test
from su3d_bench.questions.model import KINDS
from su3d_bench.reports.tables.formats import csv_text, html_page, markdown
from su3d_bench.reports.tables.judged import sheet_tables


def cells_of(scores: Scores, judge: str = "people") -> dict[tuple[str, str], ScoreCell]:
    return {(one.method, one.metric): one for one in scores.cells if one.judge == judge}


@pytest.fixture(scope="module")
def small() -> tuple[Sheet, Key]:
    return retrieval_set(8, ("ann", "bob"))


# Simulated annotators


def test_error_free_annotators_reproduce_the_key() -> None:
    sheet, key = retrieval_set(80, ("ann", "bob", "cyn"))
    found = scored(sheet, key, answered(sheet, key, {"ann": 0.0, "bob": 0.0, "cyn": 0.0}))
    people, truth = cells_of(found), cells_of(found, "automatic")
    assert {place: cell.value for place, cell in people.items()} == {place: c.value for place, c in truth.items()}
    for scheme, rate in RATES.items():
        for kind in (*KINDS, "all"):
            cell = people[scheme, kind]
            assert cell.value == pytest.approx(rate)
            assert (cell.n_items, cell.n_cannot_tell) == (80 if kind == "all" else 20, 0)
            assert cell.n_judgements == 3 * cell.n_items
    (agreed,) = found.agreements
    assert (agreed.agreement.alpha, agreed.agreement.fleiss) == (1.0, 1.0)
    assert [one.kappa for one in agreed.agreement.pairs] == [1.0, 1.0, 1.0]
    (confusion,) = found.confusions
    assert confusion.kappa == 1.0 and confusion.n == confusion.n_equal == 3 * len(sheet.items)
    assert found.review_items == ()


def test_known_error_rates_give_the_known_accuracies_and_agreement() -> None:
    sheet, key = retrieval_set(800, ("ann", "bob"))
    first, second = 0.1, 0.25
    found = scored(sheet, key, answered(sheet, key, {"ann": first, "bob": second}, seed=3))
    people = cells_of(found)
    for scheme, rate in RATES.items():
        # an error turns right into wrong and vice versa; the mean of two annotators with n items each
        expected = sum(rate * (1 - e) + (1 - rate) * e for e in (first, second)) / 2
        variance = sum(e * (1 - e) for e in (first, second)) / 4 / 800
        assert people[scheme, "all"].value == pytest.approx(expected, abs=4 * variance**0.5)
    n = len(sheet.items)
    share = np.mean([one.automatic["retrieval"] == "right" for one in key.items])
    equal = (1 - first) * (1 - second) + first * second
    (pair,) = found.agreements[0].agreement.pairs
    deviation = (equal * (1 - equal) / n) ** 0.5
    assert pair.n_equal / pair.n == pytest.approx(equal, abs=4 * deviation)
    says = [share * (1 - e) + (1 - share) * e for e in (first, second)]
    by_chance = says[0] * says[1] + (1 - says[0]) * (1 - says[1])
    assert pair.kappa == pytest.approx((equal - by_chance) / (1 - by_chance), abs=4 * deviation / (1 - by_chance))
    mean = sum(says) / 2
    alpha = found.agreements[0].agreement.alpha
    assert alpha == pytest.approx(1 - (1 - equal) / (2 * mean * (1 - mean)), abs=5 * deviation / (1 - by_chance))
    (confusion,) = found.confusions
    assert confusion.n_equal / confusion.n == pytest.approx(1 - (first + second) / 2, abs=4 * (0.16 / 2 / n) ** 0.5)


def test_paired_test_matches_exact_sign_flip_test() -> None:
    rng = np.random.default_rng(0)

    def general(changes: Float64Array) -> float:
        test = sign_flip_test(changes)
        assert test is not None and test.is_exact
        return test.p

    for n in range(1, 30):
        changes = rng.integers(-1, 2, n).astype(np.float64)
        assert paired_p(changes)[0] == pytest.approx(general(changes), rel=1e-12)
    # 5 to 20 of 25 that differ: 2 x sum of C(25, k) for k = 0..5, over 2^25
    assert paired_p(np.repeat([1.0, -1.0, 0.0], [20, 5, 9]))[0] == pytest.approx(2 * 68406 / 2**25)
    # with halves, from two annotators, the signed sums of .5 .5 1: only +++ and --- reach 2
    assert paired_p(np.array([0.5, 0.5, 1.0])) == (0.25, 0.25, True)
    thirds = rng.integers(-3, 4, 25) / 3
    assert paired_p(thirds)[0] == pytest.approx(general(thirds), rel=1e-9)
    # many judges: no small step, so the general test is used
    odd = rng.random(12) - 0.3
    assert paired_p(odd)[0] == general(odd)


def test_paper_labels_and_merging_come_from_the_blinded_questions() -> None:
    truths = [
        ("right", "right", "well-merged"),
        ("wrong", "right", "well-merged"),
        ("wrong", "right", "under-merged"),
        ("wrong", "wrong", "over-merged"),
        ("right", "wrong", "well-merged"),
    ]
    sheet, key = annotation_set(truths)
    found = scored(sheet, key, answered(sheet, key, {"ann": 0.0}))
    people = cells_of(found)
    shares = {metric: cell.value for (_, metric), cell in people.items()}
    merges = ["well-merged", "under-merged", "over-merged"]
    names = ["label n", "label n'", *merges, *(f"{name} n'" for name in merges)]
    assert list(shares) == names
    assert [shares[name] for name in names] == pytest.approx([2 / 5, 3 / 5, *2 * [3 / 5, 1 / 5, 1 / 5]])
    assert {cell.n_items for cell in people.values()} == {5}
    (test,) = found.tests
    assert (test.left, test.right) == ("opensu3d label n", "opensu3d label n'")
    assert (test.n_items, test.n_differ, test.p) == (5, 3, 1.0)  # two better, one worse
    assert test.difference == pytest.approx(1 / 5)
    assert "differences" in [table.name for table in sheet_tables(asdict(found))]
    same = replace(found, tests=(replace(test, n_differ=0),))
    first, *others = sheet_tables(asdict(same))
    assert first.notes[-1] == "no difference between methods in 1 comparison"
    assert "differences" not in [table.name for table in others]
    # labels 1 and 2 are one question: 8 labels of 5 instances, two of which have the same label twice
    assert [one.ask for one in found.agreements] == ["label", "merging"]
    assert {one.ask: (one.n, one.n_equal, one.choices[0]) for one in found.confusions} == {
        "label": (8, 8, "right"),
        "merging": (5, 5, "well-merged"),
    }


# Output


HOSTILE = '<script>alert(1)</script>=HYPERLINK("x") \\input{x} \u202ecba \U0001f600' + "x" * 10_000


def test_hostile_texts_are_escaped_in_tables_and_lists(small: tuple[Sheet, Key]) -> None:
    scores = scored(*small, answered(*small, {"ann": 0.0, "bob": 0.5}))
    looks = [replace(one, text=HOSTILE, pictures=("../../x.png", 'a".png')) for one in scores.review_items]
    content = asdict(replace(scores, run=HOSTILE, automatic_rule=HOSTILE, review_items=tuple(looks)))
    page = review_items_page(looks, "../sheet/pictures", "=1+1")
    listed = review_items_csv([replace(one, text="=HYPERLINK(1)") for one in looks])
    for text in (page, html_page(sheet_tables(content)), markdown(sheet_tables(content))):
        assert "<script" not in text and "\u202e" not in text
        assert max(map(len, text.splitlines())) < 8000
    assert "x.png" not in page and "a%22.png" in page
    assert ",'=HYPERLINK(1)," in listed
    assert not any(line.startswith(("=", "+", "@")) for line in csv_text(sheet_tables(content)).splitlines())
