"""Workbooks that are made to harm who scores them: what swells, what defines entities, formulas."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace

import pytest
from counted_sheets import SHEET, both, rezipped, workbook
from simulated_annotators import retrieval_set

from su3d_bench.core.errors import DataError
from su3d_bench.sheets.answers import check_answers, parse_workbook

ENTITY = b'<?xml version="1.0"?><!DOCTYPE worksheet [<!ENTITY a "right">]><worksheet>&a;</worksheet>'


@pytest.fixture(scope="module")
def book() -> bytes:
    return workbook(both(retrieval_set(4, ("ann", "bob"))))


def page_of(book: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(book)) as archive:
        return archive.read(SHEET)


def test_a_part_that_swells_a_document_type_and_a_cut_file_are_refused(book: bytes) -> None:
    swollen = page_of(book).replace(b"</worksheet>", b" " * (300 << 20) + b"</worksheet>")
    for content in (rezipped(book, {SHEET: swollen}), rezipped(book, {SHEET: ENTITY}), book[: len(book) // 2], b""):
        with pytest.raises(DataError, match=r"^a\.xlsx"):
            parse_workbook(content, "a.xlsx")


def test_a_formula_is_no_answer() -> None:
    small = retrieval_set(4, ("ann", "bob"))
    rows = both(small)
    rows[0] = replace(rows[0], answer='=IF(1,"right","wrong")')
    assert len(check_answers(small[0], parse_workbook(workbook(rows), "a.xlsx")).faults) == 1
