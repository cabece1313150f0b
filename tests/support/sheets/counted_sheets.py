"""Answers of annotators as scores, as a workbook, and without an error, for tests of annotation sheets."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Sequence

import openpyxl
from simulated_annotators import answered

from su3d_bench.sheets.answers import AnswerRow, check_answers, check_key
from su3d_bench.sheets.items import ANSWER_COLUMNS, Key, Sheet
from su3d_bench.sheets.scores import Scores, score

Rows = list[AnswerRow]
SHEET, STRINGS, RELATIONS = "xl/worksheets/sheet1.xml", "xl/sharedStrings.xml", "xl/_rels/workbook.xml.rels"
MOVED = {SHEET: "xl/media/image1.png", STRINGS: "xl/media/image2.png"}


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


def rezipped(content: bytes, change: dict[str, bytes], moved: dict[str, str] | None = None) -> bytes:
    """An archive with other bytes in some of its members, and some of them under other names."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr((moved or {}).get(name, name), change.get(name, old.read(name)))
    return stream.getvalue()


def sharing(content: bytes) -> bytes:
    """The same workbook with the texts of its cells in a part of their own, as spreadsheets save it."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        page, relations = archive.read(SHEET).decode(), archive.read(RELATIONS).decode()
    texts: list[str] = []

    def shared(match: re.Match[str]) -> str:
        texts.append(match[2])
        return f'<c{match[1]} t="s"><v>{len(texts) - 1}</v></c>'

    page = re.sub(r'<c([^>]*) t="inlineStr">(?:<is>)(.*?)</is></c>', shared, page)
    assert texts and STRINGS not in relations
    kind = "http://schemas.openxmlformats.org/officeDocument/2006/relationships/sharedStrings"
    relation = f'<Relationship Id="shared" Type="{kind}" Target="/{STRINGS}"/></Relationships>'
    change = {SHEET: page.encode(), RELATIONS: relations.replace("</Relationships>", relation).encode()}
    stream = io.BytesIO(rezipped(content, change))
    space = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    with zipfile.ZipFile(stream, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(STRINGS, f'<sst xmlns="{space}">{"".join(f"<si>{text}</si>" for text in texts)}</sst>')
    return stream.getvalue()


def elsewhere(content: bytes) -> bytes:
    """The same workbook with its worksheet and its shared texts among the pictures, as its relationships say."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        relations = archive.read(RELATIONS)
    for old, new in MOVED.items():
        relations = relations.replace(f"/{old}".encode(), f"/{new}".encode())
    return rezipped(content, {RELATIONS: relations}, MOVED)


def both(small: tuple[Sheet, Key]) -> Rows:
    return answered(*small, {"ann": 0.0, "bob": 0.0})
