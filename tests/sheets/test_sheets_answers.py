"""The answers of annotators, their files and keys: what is read, and what is refused with which words."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from counted_sheets import both, rezipped, scored, workbook
from damage import damages, outcomes, truncations
from simulated_annotators import annotation_set, answered, as_csv, retrieval_set

from su3d_bench.core.errors import DataError
from su3d_bench.sheets.items import ANSWER_COLUMNS, Key, Sheet, read_key, write_key
from su3d_bench.sheets.judging.answers import check_answers, check_key, parse_csv, parse_workbook, read_answers
from su3d_bench.sheets.judging.scores import Scores, read_scores, score, write_scores


@pytest.fixture(scope="module")
def small() -> tuple[Sheet, Key]:
    return retrieval_set(8, ("ann", "bob"))


# What is refused


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

    use(content)  # what scores import counts as memory that was there before
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


def test_a_row_with_a_huge_number_does_not_make_millions_of_rows(small: tuple[Sheet, Key]) -> None:
    content = workbook(both(small)[:1])
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        page = archive.read("xl/worksheets/sheet1.xml")
    far = page.replace(b'<row r="2"', b'<row r="9999999999"')
    assert far != page
    with pytest.raises(DataError, match=r"a\.xlsx: has a row 9999999999; at most 200000 are read"):
        parse_workbook(rezipped(content, {"xl/worksheets/sheet1.xml": far}), "a.xlsx")


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
