"""Answers of annotators as scores, as a workbook, and without an error, for tests of annotation sheets."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence

import openpyxl
from simulated_annotators import answered

from su3d_bench.sheets.answers import AnswerRow, check_answers, check_key
from su3d_bench.sheets.items import ANSWER_COLUMNS, Key, Sheet
from su3d_bench.sheets.scores import Scores, score

Rows = list[AnswerRow]
SHEET = "xl/worksheets/sheet1.xml"


def scored(sheet: Sheet, key: Key, rows: Sequence[AnswerRow]) -> Scores:
    check_key(sheet, key)
    checked = check_answers(sheet, rows)
    assert checked.faults == ()
    return score(sheet, key, checked.judgements, checked.silent)


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


def rezipped(content: bytes, change: dict[str, bytes]) -> bytes:
    """An archive with other bytes in some of its members."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, change.get(name, old.read(name)))
    return stream.getvalue()


def both(small: tuple[Sheet, Key]) -> Rows:
    return answered(*small, {"ann": 0.0, "bob": 0.0})
