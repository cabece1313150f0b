"""ScanNet's labels: from the raw category that an annotator typed to NYU40 and to ScanNet200.

The table ``scannetv2-labels.combined.tsv`` comes with the data and is not shipped here. Two versions circulate, the
older one and the one updated for ScanNet200; both are read the same way. The first release has a table of its own,
``scannet-labels.combined.tsv``: raw categories stand in ``category``, and a raw id is the number of the row, from 1.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import LabelSet
from su3d_bench.formats.text_files import read_text

LABEL_SPACE = "scannet"
TABLE_NAME = "scannetv2-labels.combined.tsv"
FIRST_TABLE_NAME = "scannet-labels.combined.tsv"  # of the first release
CATEGORY, RAW_ID, NYU40_ID = COLUMNS = ("raw_category", "id", "nyu40id")
FIRST_COLUMNS = ("category", NYU40_ID)
MAX_RAW_ID, MAX_NYU40_ID = 65535, 40  # labels are stored as 16 bits; the released table ends at 1357


@dataclass(frozen=True)
class LabelTable:
    """``nyu40_of`` and ``raw_id_of`` a raw category; ``name_of_id``: the first category of each raw id.

    ``name``: of the file, which tells the release.
    """

    nyu40_of: Mapping[str, int]
    raw_id_of: Mapping[str, int]
    name_of_id: Mapping[int, str]
    name: str = TABLE_NAME


@cache
def _known_classes() -> dict[str, dict[int, str]]:
    """NYU40 by the names of nyu40class, those of the benchmark's 20 classes as the benchmark has them; ScanNet200."""
    tables = json.loads(file_text(Path(__file__).with_name("labels.json")))
    return {name: {int(row["id"]): str(row["name"]) for row in rows} for name, rows in tables.items()}


@cache
def nyu40_label_set() -> LabelSet:
    """The 40 classes of NYU40, the 20 of the benchmark among them."""
    classes = _known_classes()["nyu40"]
    return LabelSet(LABEL_SPACE, tuple(classes), tuple(classes.values()))


def raw_label_set(table: LabelTable) -> LabelSet:
    """Every raw id of the table and of ScanNet200, whose 200 names stand first; no other id bears one of them."""
    classes = dict(_known_classes()["scannet200"])
    taken = set(classes.values())
    for raw_id, name in sorted(table.name_of_id.items()):
        classes.setdefault(raw_id, f"{name} ({raw_id})" if name in taken else name)
    return LabelSet(LABEL_SPACE, tuple(classes), tuple(classes.values()))


def read_label_table(path: Path, where: str) -> LabelTable:
    """The table in ``path``; ``where`` begins each message.

    Of rows with the same category the first counts, as in ScanNet's scripts. Cells lose blanks at their ends, and lines
    may end in CR, LF or both, even mixed. In that of the first release a row may lack its class of NYU40.
    """
    is_first = path.name == FIRST_TABLE_NAME
    columns = FIRST_COLUMNS if is_first else COLUMNS
    where = f"{where}: {path.name}"
    text = read_text(path, where)
    lines = [(n, line) for n, line in enumerate(re.split(r"\r\n|\r|\n", text), 1) if line.strip()]
    header = [cell.strip() for cell in lines[0][1].split("\t")] if lines else []
    missing = [name for name in columns if name not in header]
    if missing:
        raise DataError(
            f"{where}: has no column '{missing[0]}'; expected the table of the release, tabs between columns"
        )
    at = [header.index(name) for name in columns]
    nyu40_of: dict[str, int] = {}
    raw_id_of: dict[str, int] = {}
    name_of_id: dict[int, str] = {}
    for row, (number, line) in enumerate(lines[1:], 1):
        cells = [cell.strip() for cell in line.split("\t")]
        if len(cells) <= max(at) or not cells[at[0]].isprintable() or not cells[at[0]]:
            raise DataError(f"{where} line {number}: has no {', '.join(columns)}; copy the file again")
        place = f"{where} line {number}"
        raw_id = row if is_first else _whole_number(cells[at[1]], MAX_RAW_ID, f"{place}: '{RAW_ID}'")
        raw_id_of.setdefault(cells[at[0]], raw_id)
        name_of_id.setdefault(raw_id, cells[at[0]])
        if not is_first or cells[at[-1]]:
            nyu40_of.setdefault(cells[at[0]], _whole_number(cells[at[-1]], MAX_NYU40_ID, f"{place}: '{NYU40_ID}'"))
    if not nyu40_of:
        raise DataError(f"{where}: has no row below its header; copy the file again")
    return LabelTable(nyu40_of, raw_id_of, name_of_id, path.name)


def _whole_number(text: str, most: int, where: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", text) or not 1 <= int(text) <= most:
        raise DataError(f"{where} is {text[:20]!r}; expected a whole number from 1 to {most}")
    return int(text)
