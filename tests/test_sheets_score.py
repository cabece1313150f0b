"""From the answers of annotators to accuracies: what is refused, what is counted, and what simulated people give."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from damage import damages, outcomes, truncations
from simulated_annotators import RATES, SCHEMES, annotation_set, answered, as_csv, reasoning_set, retrieval_set

from su3d_bench.cli.main import main
from su3d_bench.errors import DataError
from su3d_bench.questions.model import KINDS
from su3d_bench.reports.second_looks import second_looks_csv, second_looks_page
from su3d_bench.reports.sheet_tables import sheet_tables
from su3d_bench.reports.table_formats import csv_text, html_page, markdown
from su3d_bench.sheets.answers import AnswerRow, parse_csv, parse_workbook, read_answers
from su3d_bench.sheets.items import ANSWER_COLUMNS, Key, Sheet, read_key, write_key, write_sheet
from su3d_bench.sheets.score_file import read_scores, write_scores
from su3d_bench.sheets.scores import ScoreCell, Scores, paired_p, score
from su3d_bench.sheets.validation import check_answers, check_key
from su3d_bench.statistics import sign_flip_test
from su3d_bench.types import Float64Array

Rows = list[AnswerRow]


def scored(sheet: Sheet, key: Key, rows: Sequence[AnswerRow]) -> Scores:
    check_key(sheet, key)
    checked = check_answers(sheet, rows)
    assert checked.faults == ()
    return score(sheet, key, checked.judgements, checked.silent)


def cells_of(scores: Scores, judge: str = "people") -> dict[tuple[str, str], ScoreCell]:
    return {(one.method, one.metric): one for one in scores.cells if one.judge == judge}


def value(cell: ScoreCell) -> float:
    assert cell.value is not None
    return cell.value


@pytest.fixture(scope="module")
def small() -> tuple[Sheet, Key]:
    return retrieval_set(8, ("ann", "bob"))


def workbook(rows: Sequence[AnswerRow], header_at: int = 1) -> bytes:
    book = openpyxl.Workbook()
    page = book.active
    for k, name in enumerate(ANSWER_COLUMNS, 1):
        page.cell(header_at, k, name)
        for number, row in enumerate(rows, header_at + 1):
            page.cell(number, k).value = getattr(row, name)
    stream = io.BytesIO()
    book.save(stream)
    return stream.getvalue()


# What simulated people give


def test_people_without_error_give_exactly_the_key() -> None:
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
    assert found.second_looks == ()


def test_known_error_rates_give_the_known_accuracies_and_agreement() -> None:
    sheet, key = retrieval_set(800, ("ann", "bob"))
    first, second = 0.1, 0.25
    found = scored(sheet, key, answered(sheet, key, {"ann": first, "bob": second}, seed=3))
    people = cells_of(found)
    for scheme, rate in RATES.items():
        # an error turns a right into a wrong and the reverse; the mean of two people of n items each
        expected = sum(rate * (1 - e) + (1 - rate) * e for e in (first, second)) / 2
        variance = sum(e * (1 - e) for e in (first, second)) / 4 / 800
        assert value(people[scheme, "all"]) == pytest.approx(expected, abs=4 * variance**0.5)
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


def test_intervals_hold_the_true_rate_of_most_samples() -> None:
    # right with probability .7, judged without error: 19 of 20 intervals hold .7; of 40 at least 33 with p > .99
    n_hold = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truths = [("right" if rng.random() < 0.7 else "wrong", "right") for _ in range(100)]
        sheet, key = reasoning_set(truths)
        low, high = cells_of(scored(sheet, key, answered(sheet, key, {"ann": 0.0})))["opensu3d", "answer"].interval or (
            1,
            0,
        )
        n_hold += low <= 0.7 <= high
    assert 33 <= n_hold <= 40


def test_the_difference_of_two_schemes_is_tested_on_the_same_questions() -> None:
    sheet, key = retrieval_set(40)
    found = scored(sheet, key, answered(sheet, key, {"ann": 0.0}))
    tests = {(one.left, one.right, one.metric): one for one in found.tests}
    assert len(tests) == 6 * 5
    whole = tests[SCHEMES[0], SCHEMES[3], "all"]
    # .5 and .9 of 40: 16 questions differ, all one way: 2 x 2^-16
    assert (whole.n_items, whole.n_differ, whole.p) == (40, 16, 2.0**-15)
    assert whole.difference == pytest.approx(0.4)
    assert whole.interval is not None and 0.2 < whole.interval[0] < 0.4 < whole.interval[1] < 0.6
    one_kind = tests[SCHEMES[0], SCHEMES[1], "instance"]
    assert (one_kind.n_items, one_kind.n_differ, one_kind.p) == (10, 1, 1.0)


def test_the_paired_test_is_the_sign_flip_test_where_both_are_exact() -> None:
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
    # with halves, of two annotators, the signed sums of .5 .5 1: only +++ and --- are as far as 2
    assert paired_p(np.array([0.5, 0.5, 1.0])) == (0.25, 0.25, True)
    thirds = rng.integers(-3, 4, 25) / 3
    assert paired_p(thirds)[0] == pytest.approx(general(thirds), rel=1e-9)
    # many judges: no small step, so the general test
    odd = rng.random(12) - 0.3
    assert paired_p(odd)[0] == general(odd)


def test_labels_and_merging_of_the_paper_come_from_the_blinded_questions() -> None:
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
    names = ["label n", "label n'", "well-merged", "under-merged", "over-merged"]
    assert list(shares) == names
    assert [shares[name] for name in names] == pytest.approx([2 / 5, 3 / 5, 3 / 5, 1 / 5, 1 / 5])
    assert {cell.n_items for cell in people.values()} == {5}
    (test,) = found.tests
    assert (test.left, test.right) == ("opensu3d label n", "opensu3d label n'")
    assert (test.n_items, test.n_differ, test.p) == (5, 3, 1.0)  # two better, one worse
    assert test.difference == pytest.approx(1 / 5)
    # labels 1 and 2 are one question: 8 labels of 5 instances, of which two have the same label twice
    assert [one.ask for one in found.agreements] == ["label", "merging"]
    assert {one.ask: (one.n, one.n_equal, one.choices[0]) for one in found.confusions} == {
        "label": (8, 8, "right"),
        "merging": (5, 5, "well-merged"),
    }


def test_answers_and_objects_of_reasoning_are_counted_apart() -> None:
    sheet, key = reasoning_set([("right", "right"), ("right", "wrong"), ("wrong", "wrong"), ("right", "right")])
    people = cells_of(scored(sheet, key, answered(sheet, key, {"ann": 0.0})))
    assert value(people["opensu3d", "answer"]) == 0.75
    assert value(people["opensu3d", "objects"]) == 0.5


def test_cannot_tell_is_left_out_and_counted(small: tuple[Sheet, Key]) -> None:
    sheet, key = small
    rows = [replace(one, answer="cannot tell") if one.item_id == "item-0000" else one for one in both(small)]
    before, after = cells_of(scored(sheet, key, both(small))), cells_of(scored(sheet, key, rows))
    first = next(one for one in key.items if one.id == "item-0000")
    place = (first.methods[0], "all")
    assert after[place].n_items == before[place].n_items - 1
    assert (before[place].n_cannot_tell, after[place].n_cannot_tell) == (0, 2)


def test_an_item_judged_by_two_counts_once_with_the_share_of_them(small: tuple[Sheet, Key]) -> None:
    sheet, key = small
    rows = both(small)
    rows[0] = replace(rows[0], answer="wrong" if rows[0].answer == "right" else "right")
    found = scored(sheet, key, rows)
    cell = cells_of(found)[key.items[0].methods[0], "all"]
    before = cells_of(scored(sheet, key, both(small)))[key.items[0].methods[0], "all"]
    assert abs(value(cell) - value(before)) == pytest.approx(0.5 / 8)
    (look,) = found.second_looks
    assert (look.item_id, look.reason, look.pictures) == ("item-0000", "annotators disagree", ("item-0000.png",))


def test_a_judgement_against_the_truth_is_listed_for_a_second_look() -> None:
    sheet, key = retrieval_set(8)
    rows = answered(sheet, key, {"ann": 0.0})
    rows[3] = replace(rows[3], answer="right" if rows[3].answer == "wrong" else "wrong")
    (look,) = scored(sheet, key, rows).second_looks
    assert (look.item_id, look.reason, look.automatic) == (
        "item-0003",
        "against the truth",
        key.items[3].automatic["retrieval"],
    )


def test_scores_do_not_depend_on_the_order_of_rows(small: tuple[Sheet, Key]) -> None:
    sheet, key = small
    rows = answered(sheet, key, {"ann": 0.3, "bob": 0.4})
    assert scored(sheet, key, rows[::-1]) == scored(sheet, key, rows)


# What is refused


def both(small: tuple[Sheet, Key]) -> Rows:
    return answered(*small, {"ann": 0.0, "bob": 0.0})


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"item_id": "item-00O1"}, "item 'item-00O1' is not in this set; did you mean 'item-00"),
        ({"answer": ""}, "no answer (item 'item-0001', question 'retrieval'); answer, and export again"),
        ({"answer": "wrnog"}, "unknown answer 'wrnog' to 'retrieval'; did you mean 'wrong'?"),
        ({"answer": "=HYPERLINK(1)"}, "unknown answer '=HYPERLINK(1)'"),
        ({"check": "c000000000000"}, "cells of item 'item-0001' were changed ('check' does not fit)"),
        ({"question": "merging"}, "question 'merging' is not asked of item 'item-0001', but retrieval"),
        ({"annotator": "bop"}, "annotator 'bop' is not of this set; did you mean 'bob'?"),
        ({"annotator": ""}, "has no annotator; it has ann, bob"),
        ({"sheet_id": "retrieval-other"}, "belongs to the set 'retrieval-other', not to 'retrieval-0123456789ab'"),
        ({"sheet_id": ""}, "has no sheet_id, not to"),
    ],
)
def test_each_fault_names_file_and_row_and_what_to_do(
    small: tuple[Sheet, Key], change: dict[str, str], told: str
) -> None:
    rows = both(small)
    rows[1] = replace(rows[1], **change)
    fault = next(one for one in check_answers(small[0], rows).faults if told in one)
    assert fault.startswith("ann.csv: row 3: ") and "\n" not in fault


def test_answered_twice_names_both_places(small: tuple[Sheet, Key]) -> None:
    rows = [*both(small), replace(both(small)[0], at="again.csv: row 9")]
    (fault,) = check_answers(small[0], rows).faults
    assert fault == "again.csv: row 9: is answered a second time, first at ann.csv: row 2; keep one of the two"


def test_what_an_annotator_left_out_is_one_line(small: tuple[Sheet, Key]) -> None:
    (fault,) = check_answers(small[0], both(small)[2:]).faults
    n = len(small[0].items)
    assert fault.startswith(f"annotator 'ann': 2 answers of 2 of {n} items are not there (item-0000, item-0001);")


def test_an_annotator_without_any_answer_is_named_but_no_fault(small: tuple[Sheet, Key]) -> None:
    checked = check_answers(small[0], [one for one in both(small) if one.annotator == "ann"])
    assert (checked.faults, checked.silent) == ((), ("bob",))


def test_rows_without_an_answer_are_one_line_a_file(small: tuple[Sheet, Key]) -> None:
    rows = [replace(one, answer="") if one.item_id < "item-0005" else one for one in both(small)]
    faults = check_answers(small[0], [one for one in rows if one.annotator == "ann"]).faults
    assert faults == (
        "ann.csv: row 2 and 4 more rows: no answer (item 'item-0000', question 'retrieval'); answer, and export again",
    )


def test_all_faults_are_told_at_once(small: tuple[Sheet, Key]) -> None:
    rows = both(small)
    rows[0], rows[2] = replace(rows[0], answer="yes"), replace(rows[2], check="c")
    rows[-1] = replace(rows[-1], sheet_id="retrieval-of-last-year")
    assert len(check_answers(small[0], rows).faults) == 4  # the last is also missing


def test_rows_of_another_set_are_one_fault_a_file(small: tuple[Sheet, Key]) -> None:
    rows = [replace(one, sheet_id="retrieval-fff") for one in both(small) if one.annotator == "ann"]
    (fault,) = check_answers(small[0], rows).faults
    assert f" and {len(rows) - 1} more rows: belongs to the set 'retrieval-fff'" in fault


def test_capitals_and_blanks_make_no_other_answer(small: tuple[Sheet, Key]) -> None:
    rows = both(small)
    rows[0] = replace(rows[0], answer="Cannot  TELL")
    checked = check_answers(small[0], rows)
    assert checked.faults == () and checked.judgements[0].answer == "cannot tell"


def test_a_damaged_key_is_refused_or_counted_but_never_breaks(tmp_path: Path) -> None:
    sheet, key = annotation_set([("right", "wrong", "well-merged"), ("right", "right", "over-merged")])
    checked = check_answers(sheet, answered(sheet, key, {"ann": 0.0}))
    content, copy = write_key(tmp_path, key).read_bytes(), tmp_path / "copy.json"

    def use(damaged: bytes) -> Scores:
        copy.write_bytes(damaged)
        found = read_key(copy)
        try:
            check_key(sheet, found)
        except DataError as error:
            raise DataError(f"copy.json: {error}") from error
        return score(sheet, found, checked.judgements)

    n_read, n_refused = outcomes(use, damages(content, 150), must_name="copy.json")
    assert n_read and n_refused


@pytest.mark.parametrize(
    "change",
    [
        {"sheet_id": "retrieval-other"},
        {"kind": "annotation"},
        {"items": ()},
        {"methods": ("opensu3d",)},
    ],
)
def test_a_key_of_another_set_is_refused(small: tuple[Sheet, Key], change: dict[str, object]) -> None:
    with pytest.raises(DataError, match=r"^key: "):
        check_key(small[0], replace(small[1], **change))  # type: ignore[arg-type]


# Files


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_csv_is_read_as_pages_and_spreadsheets_write_it(small: tuple[Sheet, Key], separator: str, mark: str) -> None:
    content = (mark + as_csv(both(small), separator)).encode()
    found = parse_csv(content, "ann.csv")
    assert [replace(one, at="") for one in found] == [replace(one, at="") for one in both(small)]
    assert found[0].at == "ann.csv: row 2"


def test_columns_may_stand_in_any_order_among_others(small: tuple[Sheet, Key]) -> None:
    row = both(small)[0]
    text = (
        f"note,check,answer,question,annotator,item_id,sheet_id\nx,{row.check},right,retrieval,'=ann,item-1,s\n,,,,,,\n"
    )
    (found,) = parse_csv(text.encode(), "a.csv")
    assert (found.annotator, found.item_id, found.answer) == ("=ann", "item-1", "right")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "a.csv: the first line lacks sheet_id"),
        (b"sheet_id,item_id,annotator,question,answer\n", "a.csv: the first line lacks check"),
        (b"sheet_id,item_id,annotator,question,answer,check,check\n", "names a column twice"),
        (b"\xff\xfes\x00", "a.csv: is not UTF-8; save it as 'CSV UTF-8'"),
        (",".join(ANSWER_COLUMNS).encode() + b'\n"a', "a.csv: is no CSV"),
        (
            ",".join(ANSWER_COLUMNS).encode() + b"\na,b,\x1b[2J,d,e,f\n",
            r"a.csv: row 2: 'annotator' is too long or holds control",
        ),
    ],
)
def test_a_csv_that_is_none_is_refused(content: bytes, told: str) -> None:
    with pytest.raises(DataError) as caught:
        parse_csv(content, "a.csv")
    assert told in str(caught.value)


def test_a_workbook_gives_the_same_rows_as_a_csv(small: tuple[Sheet, Key], tmp_path: Path) -> None:
    file = tmp_path / "ann.xlsx"
    file.write_bytes(workbook(both(small), header_at=5))
    found = read_answers(file)
    assert [replace(one, at="") for one in found] == [replace(one, at="") for one in both(small)]
    assert found[0].at == f"{file}: Sheet: row 6"


def test_a_formula_in_a_workbook_is_no_answer(small: tuple[Sheet, Key]) -> None:
    rows = both(small)
    rows[0] = replace(rows[0], answer='=IF(1,"right","wrong")')
    checked = check_answers(small[0], parse_workbook(workbook(rows), "a.xlsx"))
    assert len(checked.faults) == 1 and "unknown answer '=IF(1" in checked.faults[0]


def rezipped(content: bytes, change: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, change.get(name, old.read(name)))
    return stream.getvalue()


def test_a_workbook_that_swells_is_refused_before_it_does(small: tuple[Sheet, Key]) -> None:
    bomb = rezipped(workbook(both(small)), {"xl/worksheets/sheet1.xml": b" " * (40 << 20)})
    assert len(bomb) < 1 << 20
    with pytest.raises(DataError, match=r"unpacks to \d+ parts and 40 MiB of text"):
        parse_workbook(bomb, "a.xlsx")


def test_a_workbook_with_entities_is_refused(small: tuple[Sheet, Key]) -> None:
    entity = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "bb">]><workbook/>'
    with pytest.raises(DataError, match="defines entities"):
        parse_workbook(rezipped(workbook(both(small)), {"xl/workbook.xml": entity}), "a.xlsx")


def test_a_row_with_a_huge_number_does_not_make_millions_of_rows(small: tuple[Sheet, Key]) -> None:
    content = workbook(both(small)[:1])
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        page = archive.read("xl/worksheets/sheet1.xml")
    far = page.replace(b'<row r="2"', b'<row r="9999999999"')
    assert far != page
    assert parse_workbook(rezipped(content, {"xl/worksheets/sheet1.xml": far}), "a.xlsx") == []


def test_damaged_answers_are_refused_or_read_but_never_break() -> None:
    sheet, key = retrieval_set(4)
    rows = answered(sheet, key, {"ann": 0.0})
    text = as_csv(rows).encode()
    n_read, n_refused = outcomes(lambda copy: parse_csv(copy, "a.csv"), damages(text, 400), must_name="a.csv")
    assert n_read and n_refused
    short = as_csv(rows[:1]).encode()
    assert outcomes(lambda copy: parse_csv(copy, "a.csv"), truncations(short), must_name="a.csv")[1]
    book = workbook(rows)
    n_read, n_refused = outcomes(lambda copy: parse_workbook(copy, "a.xlsx"), damages(book, 250), must_name="a.xlsx")
    assert n_refused


def test_damaged_scores_are_refused_or_read_but_never_break(tmp_path: Path, small: tuple[Sheet, Key]) -> None:
    scores = scored(*small, both(small))
    file = write_scores(tmp_path, scores)
    assert read_scores(file) == read_scores(tmp_path) == scores
    content, copy = file.read_bytes(), tmp_path / "copy.json"

    def read(damaged: bytes) -> Scores:
        copy.write_bytes(damaged)
        return read_scores(copy)

    n_read, n_refused = outcomes(read, damages(content, 200), must_name="copy.json")
    assert n_read + n_refused == 200 and n_refused
    with pytest.raises(DataError, match="no share"):
        read(content.replace(b'"value": 0.5,', b'"value": 7.5,', 1))


# What is shown


HOSTILE = '<script>alert(1)</script>=HYPERLINK("x") \\input{x} \u202ecba \U0001f600' + "x" * 10_000


def test_hostile_texts_do_no_harm_in_tables_and_lists(small: tuple[Sheet, Key]) -> None:
    scores = scored(*small, answered(*small, {"ann": 0.0, "bob": 0.5}))
    looks = [replace(one, text=HOSTILE, pictures=("../../x.png", 'a".png')) for one in scores.second_looks]
    content = asdict(replace(scores, run=HOSTILE, automatic_rule=HOSTILE, second_looks=tuple(looks)))
    page = second_looks_page(content["second_looks"], "../sheet/pictures", "=1+1")
    listed = second_looks_csv([{**one, "text": "=HYPERLINK(1)"} for one in content["second_looks"]])
    for text in (page, html_page(sheet_tables(content)), markdown(sheet_tables(content))):
        assert "<script" not in text and "\u202e" not in text
        assert max(map(len, text.splitlines())) < 8000
    assert "x.png" not in page and "a%22.png" in page
    assert ",'=HYPERLINK(1)," in listed
    assert not any(line.startswith(("=", "+", "@")) for line in csv_text(sheet_tables(content)).splitlines())


def test_the_tables_say_what_was_counted(small: tuple[Sheet, Key]) -> None:
    scores = scored(*small, answered(*small, {"ann": 0.0, "bob": 0.25}, seed=1))
    tables = {one.name: one for one in sheet_tables(asdict(scores))}
    assert list(tables) == ["retrieval-rooms", "differences", "agreement", "pairs", "confusion-retrieval"]
    main_table = tables["retrieval-rooms"]
    assert main_table.columns == (*KINDS, "all")
    assert [row.label for row in main_table.rows] == [
        f"{scheme} ({who})" for who in ("people", "ground truth") for scheme in SCHEMES
    ]
    n_different = sum(one.n_differ > 0 for one in scores.tests)
    assert 0 < n_different < 30 == len(scores.tests)
    assert len(tables["differences"].rows) == n_different
    assert f"{30 - n_different} of 30 comparisons are left out: nothing differs" in tables["differences"].notes
    truth = main_table.rows[4].cells[-1]
    assert truth.text == "50.0" and truth.beside.endswith("n=8")
    n = len(small[0].items)
    assert f"{n} of {n} items judged; judgements by ann {n}, bob {n}" in main_table.notes[1]


def test_one_annotator_agrees_with_nobody() -> None:
    sheet, key = retrieval_set(8)
    tables = sheet_tables(asdict(scored(sheet, key, answered(sheet, key, {"ann": 0.0}))))
    assert [one.name for one in tables] == ["retrieval-rooms", "differences", "confusion-retrieval"]


# The verb


@pytest.fixture
def folder(tmp_path: Path, small: tuple[Sheet, Key]) -> Path:
    for name in ("sheet", "key", "answers"):
        (tmp_path / name).mkdir()
    write_sheet(tmp_path / "sheet", small[0])
    write_key(tmp_path / "key", small[1])
    rows = both(small)
    (tmp_path / "answers" / "ann.csv").write_text(as_csv([one for one in rows if one.annotator == "ann"]))
    (tmp_path / "answers" / "bob.xlsx").write_bytes(workbook([one for one in rows if one.annotator == "bob"]))
    return tmp_path


def test_files_are_scored_from_the_command_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(folder / "answers" / name) for name in ("ann.csv", "bob.xlsx")]
    words = ["sheets", "score", *files, "--key", str(folder / "key"), "--out", str(folder / "scores")]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert "Retrieval by text" in shown and "To look at again: 0 where annotators disagree" in shown
    names = {one.name for one in (folder / "scores").iterdir()}
    assert names == {"scores.json", "tables.md", "tables.csv", "tables.html", "second_looks.csv", "second_looks.html"}
    assert main([*words[:-2], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["n_judged"] == found["n_items"] == read_scores(folder / "scores").n_judged > 0


def test_faults_of_all_files_are_listed_and_nothing_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ann = folder / "answers" / "ann.csv"
    ann.write_text(ann.read_text().replace(",right,", ",yes,", 2))
    (folder / "answers" / "bob.xlsx").write_bytes(b"no")
    files = [str(one) for one in sorted((folder / "answers").iterdir())]
    words = ["sheets", "score", *files, "--key", str(folder / "key"), "--out", str(folder / "scores")]
    assert main(words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[0].rpartition("/")[2] for line in lines] == [
        "bob.xlsx",
        "ann.csv",
        "ann.csv",
        "su3d-bench",
    ]
    assert lines[-1] == "su3d-bench: answers: 3 faults, listed above; nothing was scored; mend them first"
    assert not (folder / "scores").exists()
    assert main([*words, "--json"]) == 2
    assert len(json.loads(capsys.readouterr().out)["faults"]) == 3


def test_without_files_the_ground_truth_alone_is_scored(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sheets", "score", "--key", str(folder / "key"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {one["judge"] for one in found["cells"]} == {"automatic"} and found["n_judged"] == 0
    assert sum(one["n_items"] for one in found["cells"]) > 0 and found["tests"] == found["second_looks"] == []
    assert main(["sheets", "score", "--key", str(folder / "key")]) == 0
    told = capsys.readouterr()
    assert "no person judged" in told.out and "no answers from" not in told.err
