"""Workbooks that are made to harm who scores them: what swells, what defines entities, what hides its sheets."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable

import pytest
from bombs import MIB, Member, deflated, whole_member, zip_of
from counted_sheets import MOVED, RELATIONS, SHEET, STRINGS, both, elsewhere, rezipped, sharing, workbook
from damage import assert_fit
from memory import bounded_addresses, peak_bytes, reset_peak
from simulated_annotators import retrieval_set

from su3d_bench.core.errors import DataError
from su3d_bench.formats.tables import workbooks
from su3d_bench.sheets.judging.answers import AnswerRow, parse_workbook

MOST_BYTES = 400 * MIB  # of memory that reading any of them may take
KNOWN = ("utf-8", "utf-16", "iso-8859-1", "cp1252")  # encodings; the parser takes the others for damage
STRICT = b"http://purl.oclc.org/ooxml"


@pytest.fixture(scope="module")
def book() -> bytes:
    return sharing(workbook(both(retrieval_set(4, ("ann", "bob")))))


def members_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def swollen(content: bytes, name: str, first: bytes, n_mebibytes: int, piece: bytes = b"") -> bytes:
    """``content`` with mebibytes of blanks, or of ``piece`` again and again, in place of the member ``name``."""
    kept = [whole_member(one, text) for one, text in members_of(content).items() if one != name]
    if piece:
        return zip_of([*kept, whole_member(name, first + piece * (n_mebibytes * MIB // len(piece)))])
    size = len(first) + n_mebibytes * MIB
    return zip_of([*kept, Member(name, deflated(first, n_mebibytes, ord(" ")), size)])


def refusal(content: bytes) -> str:
    """What is said of a workbook that is refused in little memory."""
    with bounded_addresses(2 * MOST_BYTES):
        before = reset_peak()
        with pytest.raises(DataError) as caught:
            parse_workbook(content, "a.xlsx")
        assert peak_bytes() - before < MOST_BYTES
    assert_fit(caught.value, "a.xlsx")
    return str(caught.value)


@pytest.mark.parametrize("name", [SHEET, STRINGS])
@pytest.mark.parametrize("place", [lambda one: one, elsewhere], ids=["in its place", "among pictures"])
def test_a_part_that_swells_is_refused_wherever_it_lies(
    book: bytes, name: str, place: Callable[[bytes], bytes]
) -> None:
    content = place(book)
    name = name if place is not elsewhere else MOVED[name]
    bomb = swollen(content, name, b"<a>", 2000)
    assert len(bomb) < 3 * MIB
    assert "unpacks to more than 32 MiB of text" in refusal(bomb)


@pytest.mark.parametrize(
    ("name", "first", "piece", "told"),
    [
        (STRINGS, b"<sst>", b"<si/>", "has more than 2000000 cells or shared texts"),
        (SHEET, b"<worksheet><sheetData><row>", b"<c/>", "has more than 2000000 cells"),
        (SHEET, b"<worksheet><sheetData>", b"<row/>", "has a row 200001; at most 200000 are read"),
        (SHEET, b"", b"<a>", "lies 65 elements deep"),
        (STRINGS, b"<sst><si><t>", b"aaaaaaaa", "a cell holds more than 32767 characters"),
    ],
)
def test_cells_rows_texts_and_depth_have_a_bound(book: bytes, name: str, first: bytes, piece: bytes, told: str) -> None:
    assert told in refusal(swollen(elsewhere(book), MOVED[name], first, 16, piece))


def test_a_sheet_that_is_named_a_thousand_times_is_unpacked_no_further_than_all_may_be(book: bytes) -> None:
    parts = members_of(book)
    page, sheet = parts["xl/workbook.xml"], parts["xl/workbook.xml"].split(b"<sheet ", 1)[1].split(b"/>", 1)[0]
    many = page.replace(b"<sheet " + sheet + b"/>", (b"<sheet " + sheet + b"/>") * 900)
    large = rezipped(book, {"xl/workbook.xml": many, SHEET: b"<a>" + b" " * MIB + b"</a>"})
    assert "unpacks to more than 32 MiB" in refusal(large)


def test_a_member_whose_packing_has_no_bound_is_refused(book: bytes) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_BZIP2) as archive:
        for name, text in members_of(book).items():
            archive.writestr(name, text)
    assert "packed in an unusual way" in refusal(stream.getvalue())


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "iso-8859-1", "cp1252", "utf-16-le", "utf-7", "cp037"])
@pytest.mark.parametrize(
    "name", ["_rels/.rels", RELATIONS, "xl/workbook.xml", SHEET, STRINGS], ids=lambda name: name.rpartition("/")[2]
)
def test_a_document_type_is_refused_in_every_encoding_and_part(book: bytes, name: str, encoding: str) -> None:
    text = members_of(book)[name].decode().split("?>", 1)[-1]
    hostile = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE a [<!ENTITY b "bb">]>{text}'
    told = refusal(elsewhere(rezipped(book, {name: hostile.encode(encoding)})))
    assert ("defines entities" if encoding in KNOWN else "is no whole .xlsx file") in told


def rows_without_place(content: bytes) -> list[AnswerRow]:
    return parse_workbook(content, "a.xlsx")


def test_the_relationships_say_which_part_is_a_sheet(book: bytes) -> None:
    assert rows_without_place(elsewhere(book)) == rows_without_place(book) != []
    unnamed = rezipped(book, {RELATIONS: members_of(book)[RELATIONS].replace(b"/worksheet", b"/chartsheet")})
    assert "no worksheet has the columns" in refusal(unnamed)


def test_a_workbook_in_the_strict_form_is_read(book: bytes) -> None:
    old = b"http://schemas.openxmlformats.org"
    changed = {name: text.replace(old, STRICT) for name, text in members_of(book).items()}
    assert rows_without_place(rezipped(book, changed)) == rows_without_place(book)


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        ('<c r="A1"><v>7</v></c>', "7"),
        ('<c r="A1"><v>0.10000000000000001</v></c>', "0.1"),
        ('<c r="A1" t="b"><v>1</v></c>', "TRUE"),
        ('<c r="A1" t="e"><v>#N/A</v></c>', "#N/A"),
        ('<c r="A1" t="str"><f>A2&amp;"x"</f><v>yes</v></c>', '=A2&"x"'),
        ('<c r="A1" t="inlineStr"><is><r><t>wr</t></r><r><t>ong</t></r><rPh><t>x</t></rPh></is></c>', "wrong"),
        ('<c r="A1" t="s"><v>1</v></c>', "b"),
        ('<c r="A1" t="s"><v>9</v></c>', None),
        ("<c><v>1</v></c>", "1"),
    ],
)
def test_a_cell_is_read_as_its_text(cell: str, text: str | None) -> None:
    types = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    relation = '<Relationship Id="{0}" Type="' + types + '/{1}" Target="{2}"/>'
    parts = {
        "_rels/.rels": "<R>" + relation.format("r", "officeDocument", "/book.xml") + "</R>",
        "book.xml": f'<w xmlns:r="{types}"><sheets><sheet name="one" r:id="p"/></sheets></w>',
        "_rels/book.xml.rels": f"<R>{relation.format('p', 'worksheet', 'p.xml')}"
        f"{relation.format('s', 'sharedStrings', 's.xml')}</R>",
        "p.xml": f'<worksheet><sheetData><row r="3">{cell}</row></sheetData></worksheet>',
        "s.xml": "<sst><si><t>a</t></si><si><t>b</t></si></sst>",
    }
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, one in parts.items():
            archive.writestr(name, one)
    (page,) = workbooks.read_workbook(stream.getvalue(), "a.xlsx")
    assert page.name == "one"
    assert page.rows == ([(3, [text])] if text is not None else [(3, [])])
