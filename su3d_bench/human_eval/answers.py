"""Read the answers of annotators from CSV files, and measure inter-annotator agreement.

Formulas are never evaluated: a formula in an answer cell is read as its text, which is not a valid answer.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, counted, nearest, printable, some, suggest
from su3d_bench.core.types import Float64Array, Int64Array, Interval
from su3d_bench.formats.arrays import read_text
from su3d_bench.formats.tables.table import meant
from su3d_bench.human_eval.items import ANSWER_COLUMNS, COMMENT, Key, Sheet, SheetItem
from su3d_bench.numerics.statistics import DIFFERENCE, MIN_ITEMS, jackknife_interval, leave_one_out
from su3d_bench.questions.query_files import csv_rows

MAX_BYTES = 32 << 20  # per file: some hundred thousand answers
ADVICE = "pass the files returned by the annotators, tables saved as 'CSV UTF-8'"
MAX_CHARACTERS = 1000  # per cell


@dataclass(frozen=True)
class AnswerRow:
    """One unvalidated answer of a file; ``at`` names file and row."""

    at: str
    sheet_id: str
    item_id: str
    annotator: str
    question: str
    answer: str
    check: str
    comment: str = ""


def read_answers(path: Path) -> list[AnswerRow]:
    """All non-empty rows of a CSV file, in order; ``DataError`` if it is not an answers file."""
    where = printable(str(path), 200)
    if path.suffix.lower() != ".csv":
        raise DataError(f"{where}: not a .csv file; {ADVICE}")
    header, *rows = csv_rows(read_text(path, where, ADVICE, MAX_BYTES), where, ",;\t") or [[]]
    names = [cell.strip().lower() for cell in header]
    if any(names.count(name) != 1 for name in ANSWER_COLUMNS):
        raise DataError(f"{where}: missing or duplicate columns ({', '.join(ANSWER_COLUMNS)}); restore the header row")
    places = {name: names.index(name) for name in (*ANSWER_COLUMNS, COMMENT) if name in names}
    found = []
    for number, row in enumerate(rows, 2):
        at = f"{where}: row {number}"
        cells = {name: _text(row[k] if k < len(row) else "", name, at) for name, k in places.items()}
        if any(text for name, text in cells.items() if name not in ("annotator", COMMENT)):
            found.append(AnswerRow(at, **cells))
    return found


def _text(value: str, name: str, at: str) -> str:
    """Text of a cell without the leading mark that prevents evaluation as a formula."""
    text = meant(value.strip())
    if len(text) > MAX_CHARACTERS or any(unicodedata.category(character) in ("Cc", "Cs") for character in text):
        raise DataError(f"{at}: '{name}' is too long or has control characters: '{printable(text, 40)}'")
    return text


LABELS = ("n", "n'")  # as in the paper: the name of the best view, and the one chosen from the names of several views
SHOWN_ITEMS = 5  # maximum number of missing items in a message


@dataclass(frozen=True)
class Judgement:
    """The answer of one annotator to one question about an item."""

    item_id: str
    annotator: str
    ask: str
    answer: str


@dataclass(frozen=True)
class CheckedAnswers:
    """``judgements`` in the order of the sheet; ``faults`` has one line for each problem that must be fixed first.

    ``silent``: annotators of the set without any answer. ``comments``: item -> annotator -> text.
    """

    judgements: tuple[Judgement, ...]
    faults: tuple[str, ...]
    silent: tuple[str, ...]
    comments: Mapping[str, Mapping[str, str]]


def check_key(sheet: Sheet, key: Key) -> None:
    """Raise ``DataError`` if the key does not belong to the sheet."""
    if (sheet.id, sheet.kind) != (key.sheet_id, key.kind) or {one.id for one in sheet.items} != {
        one.id for one in key.items
    }:
        raise DataError(
            f"key: belongs to the set '{printable(key.sheet_id, 60)}', not '{printable(sheet.id, 60)}'; pass the "
            "key created with the sheet"
        )


def check_answers(sheet: Sheet, rows: Sequence[AnswerRow], *, is_partial: bool = False) -> CheckedAnswers:
    """Check every row against the sheet, then list the missing answers of each annotator, unless ``is_partial``."""
    items = {item.id: item for item in sheet.items}
    shares = {share.name: share.item_ids for share in sheet.annotators}
    first: dict[tuple[str, str, str], str] = {}
    judgements, faults = [], []
    comments: dict[str, dict[str, str]] = {}
    of_other_sets: set[tuple[str, str]] = set()
    for row in rows:
        place = (row.annotator, row.item_id, row.question)
        if row.sheet_id != sheet.id:  # one line for each file, not for each row
            source = (row.at.rpartition(": row ")[0], row.sheet_id)
            if source in of_other_sets:
                continue
            of_other_sets.add(source)
        fault = _fault(sheet, row, items, shares)
        if fault is None and row.comment:
            of_item = comments.setdefault(row.item_id, {})
            before = of_item.get(row.annotator)
            of_item[row.annotator] = row.comment if before in (None, row.comment) else f"{before}; {row.comment}"
        if fault is None and not row.answer:
            if is_partial:
                continue
            fault = f"missing answer (item '{row.item_id}', question '{row.question}'); answer it, or use --partial"
        if fault is None and place in first:
            fault = f"duplicate answer, first at {first[place]}; remove one of them"
        first.setdefault(place, row.at)
        if fault is None:
            judgements.append(Judgement(row.item_id, row.annotator, row.question, _plain(row.answer)))
        else:
            faults.append(f"{row.at}: {fault}")
    answered = {row.annotator for row in rows if row.sheet_id == sheet.id and (row.answer or not is_partial)}
    for name, share in shares.items():
        missing = [item_id for item_id in share for ask in items[item_id].asks if (name, item_id, ask) not in first]
        if name in answered and missing and not is_partial:
            faults.append(
                f"annotator '{printable(name, 40)}': {counted(len(missing), 'missing answer')} "
                f"({some(list(dict.fromkeys(missing)), SHOWN_ITEMS)}); complete the sheet, "
                "pass all files or use --partial"
            )
    order = {item.id: k for k, item in enumerate(sheet.items)}
    names = [ask.name for ask in sheet.asks]
    judgements.sort(key=lambda one: (order[one.item_id], names.index(one.ask), one.annotator))
    silent = tuple(name for name in shares if name not in answered)
    return CheckedAnswers(tuple(judgements), tuple(faults), silent, comments)


def _plain(answer: str) -> str:
    """The answer normalized to the spelling of a choice, ignoring case and whitespace."""
    return " ".join(answer.split()).casefold()


def _fault(
    sheet: Sheet, row: AnswerRow, items: Mapping[str, SheetItem], shares: Mapping[str, Sequence[str]]
) -> str | None:
    """The problem of a row and how to fix it."""
    item = items.get(row.item_id)
    if row.sheet_id != sheet.id:
        return f"belongs to the set '{printable(row.sheet_id, 60)}', not to '{sheet.id}'; use the key of that set"
    if item is None:
        near = nearest(row.item_id, items)
        return f"item '{printable(row.item_id, 40)}' is not in this set{near or '; restore its id'}"
    if row.check != item.check:
        return f"item '{item.id}': cells were changed ('check' does not match); restore the original cells"
    if row.question not in item.asks:
        known = ", ".join(item.asks)
        return f"question '{printable(row.question, 40)}' does not apply to item '{item.id}': {known}; restore it"
    if row.item_id not in shares.get(row.annotator, ()):
        hint = suggest(row.annotator, sorted(shares), "it has")
        return f"item '{item.id}' is not assigned to annotator '{printable(row.annotator, 40)}'{hint}"
    choices = sheet.ask(row.question).choices
    if row.answer and _plain(row.answer) not in choices:
        hint = suggest(row.answer, choices, "choose one of")
        return f"unknown answer '{printable(row.answer, 40)}' to '{row.question}'{hint}"
    return None


Ratings = Mapping[str, Mapping[str, str]]  # item -> annotator -> answer


@dataclass(frozen=True)
class PairAgreement:
    """Cohen's kappa of two annotators over the ``n`` items that both answered; None if undefined."""

    left: str
    right: str
    n: int
    n_equal: int
    kappa: float | None


@dataclass(frozen=True)
class Agreement:
    """Agreement coefficients of one question over its items with at least two answers.

    ``fleiss`` is of the ``n_fleiss`` items with ``n_raters`` answers each, the most common number. ``alpha``
    is Krippendorff's for nominal data over all items; its ``interval`` is over items and needs at least ten.
    ``ac1`` is Gwet's. None: undefined, because there are no items or (except for ``ac1``) only one answer occurs.
    """

    n_annotators: int
    n_items: int
    n_equal: int
    pairs: tuple[PairAgreement, ...]
    fleiss: float | None
    n_fleiss: int
    n_raters: int
    alpha: float | None
    interval: Interval | None
    ac1: float | None = None


def agreement(ratings: Ratings, choices: Sequence[str]) -> Agreement:
    """All coefficients for one question with these ``choices``.

    Items with a single answer are ignored, except for the shares of the answers in ``ac1``.
    """
    annotators = sorted({annotator for item in ratings.values() for annotator in item})
    given = [list(item.values()) for item in ratings.values()]
    every = np.array([[item.count(choice) for choice in choices] for item in given], np.int64)
    every = every.reshape(-1, len(choices))
    counts = every[every.sum(axis=1) >= 2]
    sizes = counts.sum(axis=1)
    n_raters = 0 if not len(sizes) else int(np.argmax(np.bincount(sizes)))
    even = counts[sizes == n_raters]
    alpha = krippendorff_alpha(counts)
    interval = None
    if alpha is not None and len(counts) >= MIN_ITEMS:
        # Fleiss and Davies, Jackknifing functions of multinomial frequencies, Am. J. of Epidemiology 115 (1982)
        values = krippendorff_alphas(counts, leave_one_out(len(counts)))
        interval = jackknife_interval(values, bounds=DIFFERENCE)
    return Agreement(
        n_annotators=len(annotators),
        n_items=len(counts),
        n_equal=int(np.count_nonzero(counts.max(axis=1, initial=0) == sizes)),
        pairs=tuple(_pair(ratings, left, right) for left, right in combinations(annotators, 2)),
        fleiss=fleiss_kappa(even),
        n_fleiss=len(even),
        n_raters=n_raters,
        alpha=alpha,
        interval=interval,
        ac1=gwet_ac1(every),
    )


def _pair(ratings: Ratings, left: str, right: str) -> PairAgreement:
    both = [(item[left], item[right]) for item in ratings.values() if left in item and right in item]
    kappa = cohen_kappa([answer for answer, _ in both], [other for _, other in both])
    return PairAgreement(left, right, len(both), sum(answer == other for answer, other in both), kappa)


def cohen_kappa(left: Sequence[str], right: Sequence[str]) -> float | None:
    """Cohen's kappa [Cohen 1960] of two annotators' answers to the same items, in the same order.

    None without items, or if both annotators always gave the same single answer (expected agreement is 1).
    """
    if len(set(left) | set(right)) < 2:
        return None
    from sklearn.metrics import cohen_kappa_score

    return float(cohen_kappa_score(list(left), list(right)))


def fleiss_kappa(counts: Int64Array) -> float | None:
    """Fleiss' kappa [Fleiss 1971, equation 7] of items (rows) by answers (columns); all rows have the same sum >= 2.

    None without items, or if only one answer occurs.

    >>> round(fleiss_kappa(np.array([[2, 0], [0, 2], [1, 1], [2, 0]])), 4)
    0.4667
    """
    if not len(counts) or np.count_nonzero(counts.sum(axis=0)) < 2:
        return None
    n = int(counts[0].sum())
    assert n >= 2 and np.all(counts.sum(axis=1) == n)
    observed = float(((counts**2).sum(axis=1) - n).sum()) / (len(counts) * n * (n - 1))
    shares = counts.sum(axis=0) / counts.sum()
    by_chance = float((shares**2).sum())
    return (observed - by_chance) / (1.0 - by_chance)


def krippendorff_alpha(counts: Int64Array) -> float | None:
    """Krippendorff's alpha for nominal data [Krippendorff 2011, section D] of items (rows) by answers (columns).

    Items may have any number of answers; those with fewer than two are ignored. None without such items, or
    if only one answer occurs.

    >>> round(krippendorff_alpha(np.array([[2, 0], [0, 2], [1, 1], [2, 0]])), 4)
    0.5333
    """
    pairable = counts[counts.sum(axis=1) >= 2]
    if not len(pairable) or np.count_nonzero(pairable.sum(axis=0)) < 2:
        return None
    return float(krippendorff_alphas(pairable, np.ones((1, len(pairable)), np.int64))[0])


def krippendorff_alphas(counts: Int64Array, weights: Int64Array) -> Float64Array:
    """Alpha for each row of item counts (R, N) of a resample; NaN if only one answer is left."""
    sizes = counts.sum(axis=1)
    # o_cc, the diagonal of the coincidence matrix: ordered pairs of equal answers in an item, over its size less one
    equal = (counts * (counts - 1)).sum(axis=1) / (sizes - 1)
    totals = (weights @ counts).astype(np.float64)  # n_c
    n = totals.sum(axis=1)
    observed = n - weights @ equal  # disagreeing pairs
    expected = (n**2 - (totals**2).sum(axis=1)) / (n - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        alphas: Float64Array = np.where(expected > 0, 1.0 - observed / expected, np.nan)
    return alphas


def gwet_ac1(counts: Int64Array) -> float | None:
    """Gwet's AC1 of items (rows) by possible answers (columns), used or not; None without items with two answers.

    Unlike kappa it is not low merely because nearly all answers are equal. Gwet, Computing inter-rater reliability and
    its variance in the presence of high agreement, British J. of Math. and Stat. Psychology 61 (2008). Items with one
    answer count in the shares of the answers only, as in his R package irrCAC.

    >>> round(gwet_ac1(np.array([[2, 0]] * 118 + [[1, 1]] * 7)), 4)  # Cohen's kappa: -0.02
    0.9408
    """
    rated = counts[counts.sum(axis=1) > 0]
    sizes = rated.sum(axis=1)
    if not (sizes >= 2).any():
        return None
    pairs = sizes * (sizes - 1)
    observed = float(((rated * (rated - 1)).sum(axis=1)[pairs > 0] / pairs[pairs > 0]).mean())
    shares = (rated / sizes[:, None]).mean(axis=0)
    by_chance = float((shares * (1 - shares)).sum()) / (len(shares) - 1)
    return (observed - by_chance) / (1.0 - by_chance)
