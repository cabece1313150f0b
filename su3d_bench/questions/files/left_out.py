"""The ids of questions that are not to be asked, in a CSV file as ``sheets score --disputed`` writes it."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from su3d_bench.core.errors import DataError, printable
from su3d_bench.formats.tables.csv_text import separated_rows
from su3d_bench.formats.text_files import read_text
from su3d_bench.questions.files.queries import MOST_BYTES

COLUMN = "question_id"  # others are for the reader alone
_ID = re.compile(r"[0-9a-f]{12}")


def read_left_out(path: Path) -> frozenset[str]:
    """The ids in the column ``question_id``, separated by ``,`` ``;`` or tab, as spreadsheets save it too."""
    where = printable(str(path), 200)
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise DataError(f"{where}: has more than {MOST_BYTES >> 20} MiB; it lists no questions")
    text = read_text(path, where, "name a CSV file, such as sheets score --disputed writes")
    separator = max(",;\t", key=text.partition("\n")[0].count)
    try:
        rows = separated_rows(text, separator)
    except csv.Error as error:
        raise DataError(f"{where}: not CSV ({printable(str(error), 120)})") from error
    header = [word.strip() for word in rows[0]] if rows else []
    if header.count(COLUMN) != 1:
        raise DataError(f"{where}: the first line must name one column {COLUMN}, as sheets score --disputed writes it")
    place = header.index(COLUMN)
    found = {}
    for number, row in enumerate(rows[1:], 2):
        if any(row):
            found[(row[place] if place < len(row) else "").strip()] = number
    for question, number in found.items():
        if not _ID.fullmatch(question):
            raise DataError(
                f"{where}: row {number}: '{printable(question, 40)}' is no id of a question; give the file as sheets "
                "score --disputed wrote it"
            )
    return frozenset(found)
