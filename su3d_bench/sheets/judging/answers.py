"""Answers that came back from annotators: CSV files as the page exports or a spreadsheet saves them, and workbooks.

Formulas are never evaluated: one that stands in the place of an answer is read as its text, which is no answer.
"""

from __future__ import annotations

import csv
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import DataError, nearest, printable, reading, suggest
from su3d_bench.core.system.files import file_bytes
from su3d_bench.formats.tables.csv_text import meant, separated_rows
from su3d_bench.formats.tables.workbooks import read_workbook
from su3d_bench.questions.model import KINDS
from su3d_bench.sheets.items import ANSWER_COLUMNS, ASKS, Key, KeyItem, Sheet, SheetItem

MOST_BYTES = 256 << 20  # of one file: a workbook holds its pictures
MOST_TEXT_BYTES = 32 << 20  # of a CSV file: some hundred thousand answers
MOST_CHARACTERS = 1000  # of one cell that is read
HEADER_WITHIN = 30  # rows of a worksheet above its header, which may hold instructions


@dataclass(frozen=True)
class AnswerRow:
    """One answer as it stands in a file, nothing checked but that all is text; ``at`` names file and row."""

    at: str
    sheet_id: str
    item_id: str
    annotator: str
    question: str
    answer: str
    check: str


def read_answers(path: Path) -> list[AnswerRow]:
    """Every row of a CSV file or XLSX workbook in its order; ``DataError`` where it is no file of answers."""
    where = printable(str(path), 200)
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".xlsx"):
        raise DataError(f"{where}: is neither .csv nor .xlsx; export a CSV from the page or save an .xlsx workbook")
    with reading(where, DataError):
        size = path.stat().st_size
        if size > (MOST_TEXT_BYTES if suffix == ".csv" else MOST_BYTES):
            raise DataError(f"{where}: has {size >> 20} MiB; a file of answers is smaller")
        content = file_bytes(path)
    return parse_csv(content, where) if suffix == ".csv" else parse_workbook(content, where)


def csv_rows(content: bytes, where: str) -> list[list[str]]:
    """The rows of a CSV file: UTF-8, with or without the mark that Excel writes, separated by ``,`` ``;`` or tab."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: is not UTF-8; save it as 'CSV UTF-8'") from error
    first = text.partition("\n")[0]
    separator = max(",;\t", key=first.count)
    try:
        return separated_rows(text, separator)
    except csv.Error as error:
        raise DataError(f"{where}: is no CSV ({printable(str(error), 120)}); export it again") from error


def parse_csv(content: bytes, where: str) -> list[AnswerRow]:
    """The answers of a CSV file."""
    rows = csv_rows(content, where)
    columns = _columns(rows[0]) if rows else None
    if columns is None:
        missing = [name for name in ANSWER_COLUMNS if not rows or name not in _names(rows[0])]
        fault = f"lacks {', '.join(missing)}" if missing else "names a column twice"
        raise DataError(f"{where}: the first line {fault}; export it again, or put the columns' names back")
    return list(_rows(enumerate(rows[1:], 2), columns, where))


def parse_workbook(content: bytes, where: str) -> list[AnswerRow]:
    """The answers of every worksheet of an XLSX workbook that has their columns."""
    answers: list[AnswerRow] = []
    has_columns = False
    for page in read_workbook(content, where):
        rows = iter(page.rows)
        columns = next((found for number, row in rows if number <= HEADER_WITHIN and (found := _columns(row))), None)
        if columns is not None:
            has_columns = True
            answers += _rows(rows, columns, f"{where}: {printable(page.name, 60)}")
    if not has_columns:
        raise DataError(f"{where}: no worksheet has the columns {', '.join(ANSWER_COLUMNS)}; put their names back")
    return answers


def _names(row: Iterable[str | None]) -> list[str]:
    return [(cell or "").strip().lower() for cell in row]


def _columns(row: Sequence[str | None]) -> dict[str, int] | None:
    """Where each column stands; None where the row is not their header."""
    names = _names(row)
    if any(names.count(name) != 1 for name in ANSWER_COLUMNS):
        return None
    return {name: names.index(name) for name in ANSWER_COLUMNS}


def _rows(rows: Iterable[tuple[int, Sequence[str | None]]], columns: dict[str, int], where: str) -> Iterator[AnswerRow]:
    for number, row in rows:
        if all(cell is None or cell == "" for cell in row):
            continue
        at = f"{where}: row {number}"
        cells = {name: cell_text(row[k] if k < len(row) else None, name, at) for name, k in columns.items()}
        if any(cells[name] for name in ANSWER_COLUMNS if name != "annotator"):
            yield AnswerRow(at, **cells)


def cell_text(value: str | None, name: str, at: str) -> str:
    """The text of a cell, without the mark that keeps a text from being a formula."""
    text = (value or "").strip()
    # as files that a spreadsheet is to open have it before text that would be taken for a formula
    text = meant(text)
    if len(text) > MOST_CHARACTERS or any(unicodedata.category(character) in ("Cc", "Cs") for character in text):
        raise DataError(f"{at}: '{name}' is too long or holds control characters: '{printable(text, 40)}'")
    return text


LABELS = ("n", "n'")  # as the paper calls them: the name of the best view, and that out of the names of several
SHOWN_ITEMS = 5  # of many that are missing


@dataclass(frozen=True)
class Judgement:
    """What one annotator said of one item to one of its questions."""

    item_id: str
    annotator: str
    ask: str
    answer: str


@dataclass(frozen=True)
class Checked:
    """``judgements`` in the order of the sheet, and in ``faults`` one line each for what must be mended first.

    ``silent``: annotators of the set of whom no answer is there.
    """

    judgements: tuple[Judgement, ...]
    faults: tuple[str, ...]
    silent: tuple[str, ...]


def check_key(sheet: Sheet, key: Key) -> None:
    """Raise ``DataError`` where the key is not that of the sheet."""
    if (sheet.id, sheet.kind) != (key.sheet_id, key.kind):
        raise DataError(
            f"key: is of the set '{printable(key.sheet_id, 60)}', the sheet is '{printable(sheet.id, 60)}'; give the "
            f"key that was made with it"
        )
    known = {item.id for item in sheet.items}
    keyed = [item.id for item in key.items]
    if set(keyed) != known or len(keyed) != len(known):
        raise DataError(f"key: has {len(keyed)} items, the sheet {len(known)}; give the key that was made with it")
    if {ask.name: ask.choices for ask in sheet.asks} != {ask.name: ask.choices for ask in ASKS[sheet.kind]}:
        raise DataError(f"sheet: asks something else than '{sheet.kind}' sheets of this version do; make it again")
    asks = {item.id: item.asks for item in sheet.items}
    for item in key.items:
        if not _fits(sheet, asks[item.id], item, key.methods):
            raise DataError(f"key: item '{printable(item.id, 40)}' does not fit the sheet; make the sheets again")


def _fits(sheet: Sheet, asks: Sequence[str], item: KeyItem, methods: Sequence[str]) -> bool:
    """Whether what the key says of an item can be counted."""
    labels = [label for named in item.stands_for.values() for label in named]
    return (
        set(item.methods) <= set(methods)
        and (sheet.kind != "retrieval" or item.question_kind in KINDS)
        and set(item.stands_for) == {ask for ask in asks if ask.startswith("label ")}
        and set(labels) <= set(LABELS)
        and len(set(labels)) == len(labels)
        and all(name in asks and choice in sheet.ask(name).choices for name, choice in item.automatic.items())
    )


def check_answers(sheet: Sheet, rows: Sequence[AnswerRow]) -> Checked:
    """Every row held against the sheet, then what each annotator who answered has left out."""
    faults, own = _of_other_sets(sheet, rows)
    items = {item.id: item for item in sheet.items}
    shares = {share.name: set(share.item_ids) for share in sheet.annotators}
    first: dict[tuple[str, str, str], AnswerRow] = {}
    given: dict[tuple[str, str, str], str] = {}
    empty: dict[str, list[AnswerRow]] = defaultdict(list)
    for row in own:
        place = (row.annotator, row.item_id, row.question)
        fault = _identity_fault(row, items, shares)
        if fault is None and place in first:
            fault = f"is answered a second time, first at {first[place].at}; keep one of the two"
        if fault is None:
            first[place] = row
            if not row.answer:
                empty[_file_of(row)].append(row)
                continue
            given[place], fault = _choice(sheet, row)
        if fault is not None:
            faults.append(f"{row.at}: {fault}")
    faults += [_unanswered(open_rows) for open_rows in empty.values()]
    there = {(row.annotator, row.item_id, row.question) for row in own}  # with a fault of its own or without
    answered = {name for name, _, _ in there}
    for share in sheet.annotators:
        if share.name in answered:
            faults += _left_out(share.name, [items[item_id] for item_id in share.item_ids], there)
    order = {item.id: k for k, item in enumerate(sheet.items)}
    names = {ask.name: k for k, ask in enumerate(sheet.asks)}
    places = sorted(given, key=lambda place: (order[place[1]], names[place[2]], place[0]))
    judgements = tuple(Judgement(item, who, ask, given[who, item, ask]) for who, item, ask in places)
    silent = tuple(share.name for share in sheet.annotators if share.name not in answered)
    return Checked(judgements, tuple(faults), silent)


def _of_other_sets(sheet: Sheet, rows: Iterable[AnswerRow]) -> tuple[list[str], list[AnswerRow]]:
    """A fault for each other set in each file, with the number of its rows, and the rows of this set."""
    others: dict[tuple[str, str], list[AnswerRow]] = defaultdict(list)
    own = []
    for row in rows:
        if row.sheet_id == sheet.id:
            own.append(row)
        else:
            others[_file_of(row), row.sheet_id].append(row)
    faults = []
    for (_, other), foreign in others.items():
        what = f"belongs to the set '{printable(other, 60)}'" if other else "has no sheet_id"
        faults.append(
            f"{_places(foreign)}: {what}, not to '{sheet.id}' (another kind, seed or run, or a changed cell); "
            f"score each set with its own sheet and key"
        )
    return faults, own


def _identity_fault(row: AnswerRow, items: dict[str, SheetItem], shares: dict[str, set[str]]) -> str | None:
    """What is wrong with whom and what the row speaks of."""
    item = items.get(row.item_id)
    if item is None:
        near = nearest(row.item_id, items)
        return f"item '{printable(row.item_id, 40)}' is not in this set{near or '; put its id back'}"
    if row.check != item.check:
        return f"cells of item '{item.id}' were changed ('check' does not fit); put back what stood there"
    if row.question not in item.asks:
        known = ", ".join(item.asks)
        return f"question '{printable(row.question, 40)}' is not asked of item '{item.id}', but {known}; put it back"
    if row.annotator not in shares:
        who = f"annotator '{printable(row.annotator, 40)}' is not of this set" if row.annotator else "has no annotator"
        return f"{who}{suggest(row.annotator, sorted(shares), 'it has')}"
    if row.item_id not in shares[row.annotator]:
        return f"item '{item.id}' is not in the share of '{printable(row.annotator, 40)}'; put the name back"
    return None


def _choice(sheet: Sheet, row: AnswerRow) -> tuple[str, str | None]:
    """The choice that was made, whatever its capitals, and what is wrong with it."""
    choices = sheet.ask(row.question).choices
    for choice in choices:
        if " ".join(row.answer.split()).casefold() == choice.casefold():
            return choice, None
    near = suggest(row.answer, choices, "choose one of")
    return "", f"unknown answer '{printable(row.answer, 40)}' to '{row.question}'{near}"


def _unanswered(rows: Sequence[AnswerRow]) -> str:
    """One line for all rows of a file without an answer."""
    first = rows[0]
    return f"{_places(rows)}: no answer (item '{first.item_id}', question '{first.question}'); answer, and export again"


def _file_of(row: AnswerRow) -> str:
    return row.at.rpartition(": row ")[0]


def _places(rows: Sequence[AnswerRow]) -> str:
    """Where rows of one file stand: the first, and how many more."""
    n_more = len(rows) - 1
    return f"{rows[0].at}{f' and {n_more} more row' if n_more else ''}{'s' if n_more > 1 else ''}"


def _left_out(who: str, share: Sequence[SheetItem], there: set[tuple[str, str, str]]) -> list[str]:
    """A line for the items of an annotator of which rows are missing."""
    missing = Counter(item.id for item in share for ask in item.asks if (who, item.id, ask) not in there)
    if not missing:
        return []
    names = ", ".join(list(missing)[:SHOWN_ITEMS]) + (", ..." if len(missing) > SHOWN_ITEMS else "")
    return [
        f"annotator '{printable(who, 40)}': {missing.total()} answers of {len(missing)} of {len(share)} items are not "
        f"there ({names}); answer them, or give the rest of the files"
    ]
