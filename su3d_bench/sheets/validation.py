"""Whether answers belong to a set of sheets: all that is wrong with them, at once."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from su3d_bench.core.errors import DataError, suggest
from su3d_bench.core.plain_text import printable
from su3d_bench.questions.model import KINDS
from su3d_bench.sheets.answers import AnswerRow
from su3d_bench.sheets.items import ASKS, Key, KeyItem, Sheet, SheetItem

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
    known = {one.id for one in sheet.items}
    keyed = [one.id for one in key.items]
    if set(keyed) != known or len(keyed) != len(known):
        raise DataError(f"key: has {len(keyed)} items, the sheet {len(known)}; give the key that was made with it")
    if {one.name: one.choices for one in sheet.asks} != {one.name: one.choices for one in ASKS[sheet.kind]}:
        raise DataError(f"sheet: asks something else than '{sheet.kind}' sheets of this version do; make it again")
    asks = {one.id: one.asks for one in sheet.items}
    for one in key.items:
        if not _fits(sheet, asks[one.id], one, key.methods):
            raise DataError(f"key: item '{printable(one.id, 40)}' does not fit the sheet; make the sheets again")


def _fits(sheet: Sheet, asks: Sequence[str], item: KeyItem, methods: Sequence[str]) -> bool:
    """Whether what the key says of an item can be counted."""
    labels = [label for named in item.stands_for.values() for label in named]
    return (
        set(item.methods) <= set(methods)
        and (sheet.kind != "retrieval" or item.question_kind in KINDS)
        and set(item.stands_for) == {one for one in asks if one.startswith("label ")}
        and set(labels) <= set(LABELS)
        and len(set(labels)) == len(labels)
        and all(name in asks and choice in sheet.ask(name).choices for name, choice in item.automatic.items())
    )


def check_answers(sheet: Sheet, rows: Sequence[AnswerRow]) -> Checked:
    """Every row held against the sheet, then what each annotator who answered has left out."""
    faults, own = _of_other_sets(sheet, rows)
    items = {one.id: one for one in sheet.items}
    shares = {one.name: set(one.item_ids) for one in sheet.annotators}
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
    faults += [_unanswered(found) for found in empty.values()]
    there = {(row.annotator, row.item_id, row.question) for row in own}  # with a fault of its own or without
    answered = {name for name, _, _ in there}
    for share in sheet.annotators:
        if share.name in answered:
            faults += _left_out(share.name, [items[one] for one in share.item_ids], there)
    order = {one.id: k for k, one in enumerate(sheet.items)}
    names = {one.name: k for k, one in enumerate(sheet.asks)}
    places = sorted(given, key=lambda place: (order[place[1]], names[place[2]], place[0]))
    judgements = tuple(Judgement(item, who, ask, given[who, item, ask]) for who, item, ask in places)
    silent = tuple(one.name for one in sheet.annotators if one.name not in answered)
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
    for (_, other), found in others.items():
        what = f"belongs to the set '{printable(other, 60)}'" if other else "has no sheet_id"
        faults.append(
            f"{_places(found)}: {what}, not to '{sheet.id}' (another kind, seed or run, or a changed cell); "
            f"score each set with its own sheet and key"
        )
    return faults, own


def _identity_fault(row: AnswerRow, items: dict[str, SheetItem], shares: dict[str, set[str]]) -> str | None:
    """What is wrong with whom and what the row speaks of."""
    item = items.get(row.item_id)
    if item is None:
        near = suggest(row.item_id, items)
        return f"item '{printable(row.item_id, 40)}' is not in this set{near or '; put its id back'}"
    if row.check != item.check:
        return f"cells of item '{item.id}' were changed ('check' does not fit); put back what stood there"
    if row.question not in item.asks:
        known = ", ".join(item.asks)
        return f"question '{printable(row.question, 40)}' is not asked of item '{item.id}', but {known}; put it back"
    if row.annotator not in shares:
        who = f"annotator '{printable(row.annotator, 40)}' is not of this set" if row.annotator else "has no annotator"
        return f"{who}{suggest(row.annotator, shares) or '; it has ' + printable(', '.join(sorted(shares)), 120)}"
    if row.item_id not in shares[row.annotator]:
        return f"item '{item.id}' is not in the share of '{printable(row.annotator, 40)}'; put the name back"
    return None


def _choice(sheet: Sheet, row: AnswerRow) -> tuple[str, str | None]:
    """The choice that was made, whatever its capitals, and what is wrong with it."""
    choices = sheet.ask(row.question).choices
    for one in choices:
        if " ".join(row.answer.split()).casefold() == one.casefold():
            return one, None
    near = suggest(row.answer, choices) or f"; choose {' | '.join(choices)}"
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
    missing = Counter(one.id for one in share for ask in one.asks if (who, one.id, ask) not in there)
    if not missing:
        return []
    names = ", ".join(list(missing)[:SHOWN_ITEMS]) + (", ..." if len(missing) > SHOWN_ITEMS else "")
    return [
        f"annotator '{printable(who, 40)}': {missing.total()} answers of {len(missing)} of {len(share)} items are not "
        f"there ({names}); answer them, or give the rest of the files"
    ]
