"""Scores of a set of sheets: accuracies, paired tests, inter-annotator agreement, comparison with ground truth.

``scores.json`` stores them; tables can be recreated from it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array, Interval
from su3d_bench.formats.tables.table import csv_lines
from su3d_bench.human_eval import items
from su3d_bench.human_eval.answers import LABELS, Agreement, Judgement, agreement, cohen_kappa
from su3d_bench.human_eval.items import CANNOT_TELL, MERGES, RIGHT, Key, KeyItem, Sheet
from su3d_bench.numerics.statistics import DIFFERENCE, MIN_ITEMS, mean_interval, share_interval, sign_flip_test
from su3d_bench.questions.model import ALL_KINDS
from su3d_bench.reports.sheet.page import Entry, list_page

if TYPE_CHECKING:
    import pandas


REVIEW_COLUMNS = (
    *("item_id", "question", "reason", "answers", "truth", "comments", "scene", "methods", "text", "pictures"),
)


Judge = Literal["people", "automatic"]
Reason = Literal["annotators disagree", "against the truth", "comment"]
STEPS = (1, 2, 6, 12, 60)  # denominators for shares of up to 1, 2, 3, 4, 6 judges, and their differences
MAX_STEPS = 50_000  # a distribution of 100,001 sums takes a few seconds for as many items
ANY_KIND = "all"
LABEL_METRICS = (f"label {LABELS[0]}", f"label {LABELS[1]}")
# The same names as in the protocols that compute these numbers from ground truth.
METRICS = (
    *(*ALL_KINDS, ANY_KIND, *LABEL_METRICS, *MERGES[:3], *(f"{name} {LABELS[1]}" for name in MERGES[:3])),
    *("answer", "objects"),
)
_PLACE = ["method", "dataset", "metric"]  # identifies a cell


@dataclass(frozen=True)
class ScoreCell:
    """One number: the mean over ``n_items`` items of the share of an item's judgements that support the metric.

    "Cannot tell" is excluded and counted separately. ``value`` and its ``interval`` over items are None if no judgement
    remains. ``per_scene``: the same mean for each scene. ``judge``: ``automatic`` is the ground truth's judgement of
    the same items.
    """

    judge: Judge
    method: str
    dataset: str
    metric: str
    value: float | None
    interval: Interval | None
    n_items: int
    n_judgements: int
    n_cannot_tell: int
    per_scene: Mapping[str, float]


@dataclass(frozen=True)
class PairTest:
    """``right`` minus ``left`` over the ``n_items`` questions or instances that both have, as judged by annotators.

    ``p``: two-sided sign-flip test over the ``n_differ`` that differ, McNemar's exact test if each is judged once; 1 if
    none differs. ``smallest_p`` is the smallest possible p for that many.
    """

    left: str
    right: str
    dataset: str
    metric: str
    difference: float
    interval: Interval | None
    n_items: int
    n_differ: int
    p: float
    smallest_p: float
    is_exact: bool


@dataclass(frozen=True)
class AskAgreement:
    """Agreement on one question; "cannot tell" counts as an answer."""

    ask: str
    agreement: Agreement


@dataclass(frozen=True)
class Confusion:
    """Annotators' judgements (rows, in the order of ``choices``) by those of the ground truth (columns).

    ``n_equal`` of ``n`` judgements other than "cannot tell" agree with it; ``kappa`` is Cohen's of the two.
    """

    ask: str
    choices: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]
    n: int
    n_equal: int
    kappa: float | None


@dataclass(frozen=True)
class ReviewItem:
    """An item on which annotators disagree, comment or contradict the ground truth.

    ``automatic`` is '' if unknown; ``comments``: annotator -> text.
    """

    item_id: str
    ask: str
    text: str
    scene: str
    methods: tuple[str, ...]
    pictures: tuple[str, ...]
    answers: Mapping[str, str]
    automatic: str
    reason: Reason
    comments: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Scores(items.JudgedRun):
    """All results of a set; ``annotators``: name -> number of judgements, ``silent`` those without any.

    ``assigned``: name -> number of questions to answer.
    """

    sheet_id: str
    kind: str
    run: str
    automatic_rule: str
    methods: tuple[str, ...]
    annotators: Mapping[str, int]
    silent: tuple[str, ...]
    n_items: int
    n_judged: int
    cells: tuple[ScoreCell, ...]
    tests: tuple[PairTest, ...]
    agreements: tuple[AskAgreement, ...]
    confusions: tuple[Confusion, ...]
    review_items: tuple[ReviewItem, ...]
    assigned: Mapping[str, int] = field(default_factory=dict)


def score(
    sheet: Sheet,
    key: Key,
    judgements: Sequence[Judgement],
    silent: Sequence[str] = (),
    comments: Mapping[str, Mapping[str, str]] | None = None,
) -> Scores:
    """The scores of judgements validated by ``check_answers``; without any, the ground truth's judgements of all."""
    keys = {item.id: item for item in key.items}
    given = [(keys[judgement.item_id], judgement.ask, judgement.answer) for judgement in judgements]
    by_people = _shares(given)
    clear = by_people[by_people["n_clear"] > 0]
    judged = {(judgement.item_id, judgement.ask) for judgement in judgements}
    truth = [
        (item, ask, choice)
        for item in key.items
        for ask, choice in item.automatic.items()
        if (item.id, ask) in judged or not judgements
    ]
    ratings = _ratings(given, judgements)
    return Scores(
        sheet_id=sheet.id,
        kind=sheet.kind,
        run=key.run,
        automatic_rule=key.automatic_rule,
        methods=key.methods,
        annotators=dict(sorted(Counter(judgement.annotator for judgement in judgements).items())),
        silent=tuple(silent),
        n_items=len(sheet.items),
        n_judged=len({judgement.item_id for judgement in judgements}),
        cells=(*_cells("people", key.methods, by_people), *_cells("automatic", key.methods, _shares(truth))),
        tests=tuple(test for test in _tests(sheet, key, clear) if test.n_items),
        agreements=tuple(AskAgreement(what, _agreement(sheet, of_ask)) for what, of_ask in ratings.items()),
        confusions=tuple(confusion for what in ratings if (confusion := _confusion(sheet, what, given)) is not None),
        review_items=tuple(_review_items(sheet, keys, judgements, comments or {})),
        assigned={share.name: sum(len(one.asks) for one in sheet.items_of(share)) for share in sheet.annotators},
        **key.provenance_remarks(),
    )


_Given = tuple[KeyItem, str, str]  # an item, one of its asks, the answer


def _ratings(given: Sequence[_Given], judgements: Sequence[Judgement]) -> dict[str, dict[str, dict[str, str]]]:
    """Kind of ask -> item and ask -> annotator -> answer."""
    ratings: dict[str, dict[str, dict[str, str]]] = {}
    for (key, ask, answer), judgement in zip(given, judgements, strict=True):
        ratings.setdefault(_asked(key, ask), {}).setdefault(f"{key.id}\0{ask}", {})[judgement.annotator] = answer
    return ratings


def _agreement(sheet: Sheet, ratings: Mapping[str, Mapping[str, str]]) -> Agreement:
    """The agreement on one kind of ask."""
    ask = next(iter(ratings)).partition("\0")[2]
    return agreement(ratings, sheet.ask(ask).choices)


def _asked(key: KeyItem, ask: str) -> str:
    """The kind of an ask: labels 1 and 2 are in random order, so that both are of the kind "label"."""
    return "label" if ask in key.represents else ask


def _shares(given: Iterable[_Given]) -> pandas.DataFrame:
    """One row per method, metric and ask of an item, in the order of the sheet: numbers of answers and of clear ones.

    ``share`` of the clear ones supports the metric, NaN if there is none; methods are compared over ``unit``.
    """
    import pandas

    names = [*_PLACE, "scene", "unit", "item", "ask"]
    rows = [
        (
            *(method, key.scene.partition("/")[0], metric, key.scene),
            *(f"{key.scene}\0{key.question_id or key.id}", key.id, ask),
            np.nan if answer == CANNOT_TELL else float(answer == choice),
        )
        for key, ask, answer in given
        for metric, choice in _metrics(key, ask)
        for method in key.methods
    ]
    table = pandas.DataFrame(rows, columns=[*names, "share"]).astype({"share": np.float64})
    return table.groupby(names, sort=False)["share"].agg(share="mean", n="size", n_clear="count").reset_index()


def _metrics(key: KeyItem, ask: str) -> list[tuple[str, str]]:
    """The metrics of an ask of an item, and the choice that supports each."""
    if ask == "retrieval":
        return [(key.question_kind, RIGHT), (ANY_KIND, RIGHT)]
    if ask == "merging":
        # instances excluded by labels n' have no label n', and do not count in the merging under them
        is_kept = any(LABELS[1] in named for named in key.represents.values())
        ends = ("", f" {LABELS[1]}") if is_kept else ("",)
        return [(f"{name}{end}", name) for end in ends for name in MERGES[:3]]
    if ask in key.represents:
        return [(f"label {name}", RIGHT) for name in key.represents[ask]]
    return [(ask, RIGHT)]


def _cells(judge: Judge, methods: Sequence[str], shares: pandas.DataFrame) -> list[ScoreCell]:
    groups = dict(iter(shares.groupby(_PLACE)))

    def order(place: tuple[str, str, str]) -> tuple[str, int, int]:
        return place[1], methods.index(place[0]), METRICS.index(place[2])

    return [_cell(judge, place, groups[place]) for place in sorted(groups, key=order)]


def _cell(judge: Judge, place: tuple[str, str, str], group: pandas.DataFrame) -> ScoreCell:
    method, dataset, metric = place
    clear = group[group["n_clear"] > 0]
    means = clear["share"].to_numpy()
    return ScoreCell(
        judge=judge,
        method=method,
        dataset=dataset,
        metric=metric,
        value=float(means.mean()) if len(means) else None,
        interval=share_interval(float(means.mean()), len(means)) if len(means) else None,
        n_items=len(clear),
        n_judgements=int(group["n_clear"].sum()),
        n_cannot_tell=int((group["n"] - group["n_clear"]).sum()),
        per_scene={scene: float(shares.to_numpy().mean()) for scene, shares in clear.groupby("scene")["share"]},
    )


def _tests(sheet: Sheet, key: Key, clear: pandas.DataFrame) -> Iterator[PairTest]:
    """Each pair of methods under each metric over the questions asked for both; for labels, n' compared with n of each
    method over its instances, because instances differ between methods."""
    if sheet.kind == "annotation":
        left, right = LABEL_METRICS
        for method in key.methods:
            for dataset, group in clear[clear["method"] == method].groupby("dataset", sort=False):
                shares = _by_unit(group, "metric")
                before, after = shares.get(left, {}), shares.get(right, {})
                yield _test(f"{method} {left}", f"{method} {right}", dataset, "label", before, after)
        return
    groups = dict(iter(clear.groupby(["dataset", "metric"])))
    for dataset, metric in sorted(groups, key=lambda place: (place[0], METRICS.index(place[1]))):
        shares = _by_unit(groups[dataset, metric], "method")
        for left, right in combinations([method for method in key.methods if method in shares], 2):
            yield _test(left, right, dataset, metric, shares[left], shares[right])


def _by_unit(group: pandas.DataFrame, column: str) -> dict[str, dict[str, float]]:
    """``column`` value -> unit -> share."""
    return {name: dict(zip(own["unit"], own["share"], strict=True)) for name, own in group.groupby(column)}


def _test(
    left: str, right: str, dataset: str, metric: str, before: Mapping[str, float], after: Mapping[str, float]
) -> PairTest:
    changes = np.array([after[unit] - before[unit] for unit in before if unit in after], np.float64)
    p, smallest_p, is_exact = paired_p(changes)
    return PairTest(
        left=left,
        right=right,
        dataset=dataset,
        metric=metric,
        difference=float(changes.mean()) if len(changes) else 0.0,
        interval=mean_interval(changes, DIFFERENCE) if len(changes) >= MIN_ITEMS else None,
        n_items=len(changes),
        n_differ=int(np.count_nonzero(changes)),
        p=p,
        smallest_p=smallest_p,
        is_exact=is_exact,
    )


def paired_p(changes: Float64Array) -> tuple[float, float, bool]:
    """The two-sided p of the sign-flip test of ``changes``, the smallest possible one, and whether it is exact.

    Zero changes are ignored. Shares of a few judges are multiples of one small step, so that the sums over all sign
    patterns can be counted; if each item is judged once, this is McNemar's exact test. Beyond ``MAX_STEPS`` it is
    ``sign_flip_test``.

    >>> paired_p(np.array([1.0, 1.0, 1.0, 0.0]))
    (0.25, 0.25, True)
    """
    differ = changes[changes != 0]
    if not len(differ):
        return 1.0, 1.0, True
    for n_steps in STEPS:
        steps = np.rint(differ * n_steps)
        if np.abs(steps / n_steps - differ).max() < 1e-9 and np.abs(steps).sum() <= MAX_STEPS:
            return _sign_flip_of_steps(steps.astype(np.int64)), min(1.0, 2.0 ** (1 - len(differ))), True
    test = sign_flip_test(differ)
    assert test is not None
    return test.p, test.smallest_p, test.is_exact


def _sign_flip_of_steps(steps: Int64Array) -> float:
    """The probability that a sum of ``steps`` with random signs is at least as far from 0, from its distribution."""
    sizes = np.abs(steps)
    far = int(sizes.sum())
    shares = np.zeros(2 * far + 1)
    shares[far] = 1.0
    for size in sizes:
        # the ends are 0 until the last step, so that nothing wraps around
        shares = (np.roll(shares, size) + np.roll(shares, -size)) / 2.0
    at_least = abs(int(steps.sum()))
    return min(1.0, float(shares[np.abs(np.arange(-far, far + 1)) >= at_least].sum()))


def _confusion(sheet: Sheet, what: str, given: Sequence[_Given]) -> Confusion | None:
    """The comparison with ground truth; None if no judged item has any."""
    known = [(key, ask, answer) for key, ask, answer in given if _asked(key, ask) == what and ask in key.automatic]
    if not known:
        return None
    choices = sheet.ask(known[0][1]).choices
    pairs = [(answer, key.automatic[ask]) for key, ask, answer in known]
    counts = Counter(pairs)
    clear = [pair for pair in pairs if CANNOT_TELL not in pair]
    return Confusion(
        ask=what,
        choices=choices,
        counts=tuple(tuple(counts[row, column] for column in choices) for row in choices),
        n=len(clear),
        n_equal=sum(answer == other for answer, other in clear),
        kappa=cohen_kappa([answer for answer, _ in clear], [other for _, other in clear]),
    )


def _review_items(
    sheet: Sheet,
    keys: Mapping[str, KeyItem],
    judgements: Iterable[Judgement],
    comments: Mapping[str, Mapping[str, str]],
) -> list[ReviewItem]:
    """Items to review, in the order of the sheet."""
    given: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for judgement in judgements:
        given[judgement.item_id, judgement.ask][judgement.annotator] = judgement.answer
    looks = []
    for item in sheet.items:
        key = keys[item.id]
        for ask in item.asks:
            answers = given[item.id, ask]
            automatic = key.automatic.get(ask, "")
            reason = _reason(list(answers.values()), automatic)
            if reason is None and item.id in comments and ask == item.asks[0]:
                reason = "comment"
            if reason is not None:
                shown = (item.text, key.scene, key.methods, item.pictures, answers, automatic, reason)
                looks.append(ReviewItem(item.id, ask, *shown, comments.get(item.id, {})))
    return looks


def _reason(answers: Sequence[str], automatic: str) -> Reason | None:
    if len(set(answers)) > 1:
        return "annotators disagree"
    is_against = bool(answers) and automatic not in ("", CANNOT_TELL) and answers[0] not in (automatic, CANNOT_TELL)
    return "against the truth" if is_against else None


FILE = "scores.json"


def write_scores(folder: Path, scores: Scores) -> Path:
    """Write ``scores.json`` into ``folder``; returns its path."""
    return items.write_record(folder / FILE, scores)


def read_scores(path: Path) -> Scores:
    """The scores in a file or its folder; ``DataError`` if it was not written by ``sheets score``."""
    return items.read_record(path / FILE if path.is_dir() else path, Scores, "sheets score")


def review_items_csv(looks: Sequence[ReviewItem]) -> str:
    """One line per item and question."""
    rows = [REVIEW_COLUMNS]
    for one in looks:
        listed = ", ".join(one.methods), one.text, ", ".join(one.pictures)
        given, comments = _of_each(one.answers), _of_each(one.comments)
        rows.append((one.item_id, one.ask, one.reason, given, one.automatic, comments, one.scene, *listed))
    return csv_lines(rows)


def _of_each(texts: Mapping[str, str]) -> str:
    return "; ".join(f"{name}: {text}" for name, text in texts.items())


def review_items_page(looks: Sequence[ReviewItem], pictures: str, sheet_id: str) -> str:
    """An HTML page without scripts; ``pictures`` is the relative path of its picture files."""
    return list_page(f"Items to review of {sheet_id}: {len(looks)}", "", [_entry(look) for look in looks], pictures)


def _entry(look: ReviewItem) -> Entry:
    truth = f"; ground truth: {look.automatic}" if look.automatic else ""
    head = f"{look.item_id}, {look.scene}, {', '.join(look.methods)}"
    comments = (f"comment, {_of_each(look.comments)}",) if look.comments else ()
    lines = (f"{look.reason}, {look.ask}: {_of_each(look.answers)}{truth}", *comments)
    return Entry(head, look.text, lines, look.pictures)
