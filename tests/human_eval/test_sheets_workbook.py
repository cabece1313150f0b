from __future__ import annotations

import io
import shutil
import subprocess
import zipfile
from pathlib import Path

import openpyxl
import pytest
from synthetic_sheets import HOSTILE, made

from su3d_bench.human_eval.answers import read_answers
from su3d_bench.human_eval.sets import COLUMNS, HEADER_ROW, HIDDEN, GeneratedSheets, workbook_bytes

OFFICE = shutil.which("soffice") or shutil.which("libreoffice")


def book_of(both: GeneratedSheets) -> bytes:
    return workbook_bytes(both.sheet, both.sheet.annotators[0], both.pictures, "title")


@pytest.fixture(scope="module")
def hostile() -> tuple[GeneratedSheets, bytes]:
    both = made("annotation", HOSTILE)
    return both, book_of(both)


def test_workbook_cells_are_text_except_one_formula(hostile: tuple[GeneratedSheets, bytes]) -> None:
    for page in openpyxl.load_workbook(io.BytesIO(hostile[1])).worksheets:
        formulas = [cell.coordinate for row in page.iter_rows() for cell in row if cell.data_type == "f"]
        assert formulas == (["B2"] if page.title == "answers" else [])
    with zipfile.ZipFile(io.BytesIO(hostile[1])) as archive:
        texts = b"".join(archive.read(name) for name in archive.namelist() if name.endswith(".xml"))
    assert texts.count(b"<f>") == 1 and b"<script>" not in texts and b"<hyperlink" not in texts


def test_answers_are_chosen_from_lists_and_other_cells_are_locked(hostile: tuple[GeneratedSheets, bytes]) -> None:
    page = openpyxl.load_workbook(io.BytesIO(hostile[1]))["answers"]
    letter = "ABCDEFGHIJ"[COLUMNS.index("answer")]
    lists = {
        one.formula1: {str(part) for part in str(one.sqref).split()} for one in page.data_validations.dataValidation
    }
    assert set(lists) == {'"right,wrong,cannot tell"', '"well-merged,under-merged,over-merged,cannot tell"'}
    assert f"{letter}6" in lists['"well-merged,under-merged,over-merged,cannot tell"']
    assert page.protection.sheet and page.freeze_panes == "B4"
    for row in page.iter_rows(min_row=HEADER_ROW + 1):
        assert [cell.coordinate[0] for cell in row if not cell.protection.locked] == [letter, "F"]
    hidden = [name for name, one in zip(COLUMNS, "ABCDEFGHIJ", strict=True) if page.column_dimensions[one].hidden]
    assert tuple(hidden) == HIDDEN


@pytest.mark.skipif(OFFICE is None, reason="no LibreOffice: install libreoffice-calc")
def test_libreoffice_preserves_the_workbook(tmp_path: Path, hostile: tuple[GeneratedSheets, bytes]) -> None:
    assert OFFICE is not None
    (tmp_path / "sheet.xlsx").write_bytes(hostile[1])
    profile = f"-env:UserInstallation={(tmp_path / 'profile').as_uri()}"
    (tmp_path / "out").mkdir()
    command = [OFFICE, profile, "--headless", "--convert-to", "xlsx", "--outdir", str(tmp_path / "out")]
    done = subprocess.run([*command, str(tmp_path / "sheet.xlsx")], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Error" not in done.stdout + done.stderr
    kept = openpyxl.load_workbook(tmp_path / "out" / "sheet.xlsx", data_only=True)["answers"]
    assert kept["B2"].value == f"0 of {3 * len(HOSTILE)} answered"
    assert len(kept._images) == len(HOSTILE)
    items = {item.text for item in hostile[0].sheet.items}
    column = COLUMNS.index("text")
    assert {row[column] for row in kept.iter_rows(min_row=HEADER_ROW + 1, values_only=True)} == items
    rows = read_answers(tmp_path / "out" / "sheet.xlsx")
    assert len(rows) == 3 * len(HOSTILE) and {row.answer for row in rows} == {""}
