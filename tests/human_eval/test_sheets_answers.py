"""The answers of annotators, their files and keys: reading them, and errors."""

from __future__ import annotations

import csv
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from simulated_annotators import as_csv, both, retrieval_set

from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import write_json
from su3d_bench.human_eval.answers import check_answers, check_key, read_answers
from su3d_bench.human_eval.items import ANSWER_COLUMNS, COMMENT, SCHEMA, Key, Sheet
from su3d_bench.human_eval.scores import read_scores, review_items_csv, review_items_page, score
from su3d_bench.reports.tables.judged import sheet_tables


@pytest.fixture(scope="module")
def small() -> tuple[Sheet, Key]:
    return retrieval_set(8, ("ann", "bob"))


# Errors


def test_duplicate_answer_error_names_both_rows(small: tuple[Sheet, Key]) -> None:
    rows = [*both(small), replace(both(small)[0], at="again.csv: row 9")]
    (fault,) = check_answers(small[0], rows).faults
    assert fault == "again.csv: row 9: duplicate answer, first at ann.csv: row 2; remove one of them"


@pytest.mark.parametrize("change", [{"sheet_id": "retrieval-other"}, {"kind": "annotation"}, {"items": ()}])
def test_key_of_another_set_is_rejected(small: tuple[Sheet, Key], change: dict[str, object]) -> None:
    with pytest.raises(DataError, match=r"^key: "):
        check_key(small[0], replace(small[1], **change))  # type: ignore[arg-type]


# Files


@pytest.mark.parametrize(("separator", "mark"), [(",", ""), (";", ""), ("\t", "\ufeff")])
def test_csv_from_pages_and_spreadsheets_is_read(
    small: tuple[Sheet, Key], separator: str, mark: str, tmp_path: Path
) -> None:
    file = tmp_path / "ann.csv"
    file.write_text(mark + as_csv(both(small), separator), encoding="utf-8", newline="")
    found = read_answers(file)
    assert [replace(one, at="") for one in found] == [replace(one, at="") for one in both(small)]
    assert found[0].at == f"{file}: row 2"


@pytest.mark.parametrize(
    "change",
    [
        {"item_id": "item-00O1"},
        {"answer": ""},
        {"answer": "wrnog"},
        {"check": "c000000000000"},
        {"question": "merging"},
        {"annotator": "bop"},
        {"sheet_id": "retrieval-other"},
    ],
)
def test_each_error_names_its_file_and_row(small: tuple[Sheet, Key], change: dict[str, str]) -> None:
    rows = both(small)
    rows[1] = replace(rows[1], **change)
    faults = check_answers(small[0], rows).faults
    assert sum(fault.startswith("ann.csv: row 3: ") for fault in faults) == 1
    assert not any("\n" in fault for fault in faults)


def test_unfinished_answers_are_scored_only_if_asked_for(small: tuple[Sheet, Key]) -> None:
    rows = both(small)
    n_of_ann = sum(row.annotator == "ann" for row in rows)
    unfinished = [replace(rows[0], answer="", comment="too dark"), *rows[1 : n_of_ann - 2]]  # none of bob's
    assert len(check_answers(small[0], unfinished).faults) == 2
    checked = check_answers(small[0], unfinished, is_partial=True)
    assert (checked.faults, checked.silent) == ((), ("bob",))
    assert checked.comments == {rows[0].item_id: {"ann": "too dark"}}
    found = score(*small, checked.judgements, checked.silent, checked.comments)
    assert found.annotators == {"ann": n_of_ann - 3} and found.n_judged == n_of_ann - 3
    notes = "; ".join(sheet_tables(asdict(found))[0].notes)
    assert f"judgements by ann {n_of_ann - 3} of {n_of_ann}; unanswered questions are excluded" in notes
    (look,) = found.review_items
    assert (look.reason, look.comments, look.answers) == ("comment", {"ann": "too dark"}, {})
    # other faults are still faults
    wrong = [*unfinished, replace(rows[0], answer="", check="c0"), replace(rows[1], answer="wrnog")]
    assert len(check_answers(small[0], wrong, is_partial=True).faults) == 2


def test_comments_are_optional_and_escaped(small: tuple[Sheet, Key], tmp_path: Path) -> None:
    rows = both(small)
    assert {one.comment for one in rows} == {""}  # files without the column
    hostile = '=HYPERLINK("x")<script>'
    rows[0] = replace(rows[0], comment=hostile)
    (tmp_path / "a.csv").write_text(as_csv(rows, columns=(*ANSWER_COLUMNS, COMMENT)))
    read = read_answers(tmp_path / "a.csv")
    assert [one.comment for one in read] == [hostile, *[""] * (len(rows) - 1)]
    checked = check_answers(small[0], read)
    looks = score(*small, checked.judgements, checked.silent, checked.comments).review_items
    assert not [
        cell for row in csv.reader(review_items_csv(looks).splitlines()) for cell in row if cell.startswith("=")
    ]
    page = review_items_page(looks, "pictures", "set")
    assert "comment, ann: =HYPERLINK" in page and "<script" not in page


def test_scores_without_newer_fields_are_read(small: tuple[Sheet, Key], tmp_path: Path) -> None:
    content = asdict(score(*small, check_answers(small[0], both(small)).judgements))
    del content["assigned"]
    for one in content["agreements"]:
        del one["agreement"]["ac1"]
    write_json(tmp_path / "scores.json", content | {"schema_version": SCHEMA, "digest": digest_json(content)})
    assert read_scores(tmp_path).agreements[0].agreement.ac1 is None


NO_WORDS = ",".join(ANSWER_COLUMNS).encode() + b"\na,b,\x1b[2J,d,e,f\n"


@pytest.mark.parametrize("content", [b"", b"sheet_id,item_id\n", b"\xff\xfes\x00", NO_WORDS])
def test_invalid_csv_fails(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.csv"):
        read_answers(tmp_path / "a.csv")


def test_formula_is_not_an_answer(small: tuple[Sheet, Key], tmp_path: Path) -> None:
    rows = both(small)
    rows[0] = replace(rows[0], answer='=IF(1,"right","wrong")')
    (tmp_path / "a.csv").write_text(as_csv(rows))
    assert len(check_answers(small[0], read_answers(tmp_path / "a.csv")).faults) == 1
