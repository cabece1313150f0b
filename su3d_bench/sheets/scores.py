"""What the answers to a set of sheets add up to: accuracies, tests between methods, agreement, people beside truth."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Literal

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.numerics.statistics import percentile_interval, resample_weights, sign_flip_test
from su3d_bench.questions.model import ALL_KINDS
from su3d_bench.sheets.agreement import Agreement, Interval, agreement, cohen_kappa
from su3d_bench.sheets.answers import LABELS, Judgement
from su3d_bench.sheets.items import CANNOT_TELL, MERGES, RIGHT, Key, KeyItem, Sheet

Judge = Literal["people", "automatic"]
SCHEMA = 1
STEPS = (1, 2, 6, 12, 60)  # of which shares of up to 1, 2, 3, 4, 6 judges, and their differences, are whole numbers
MOST_STEPS = 50_000  # a distribution of 100,001 sums, some seconds for as many items
WELL_MERGED, UNDER_MERGED, OVER_MERGED = MERGES[:3]
OF_ALL_KINDS = "all"
LABEL_METRICS = (f"label {LABELS[0]}", f"label {LABELS[1]}")
# As the protocols that let the ground truth judge call the same numbers.
METRICS = (*ALL_KINDS, OF_ALL_KINDS, *LABEL_METRICS, WELL_MERGED, UNDER_MERGED, OVER_MERGED, "answer", "objects")


@dataclass(frozen=True)
class ScoreCell:
    """One number: the mean over ``n_items`` items of the share of an item's judgements that speak for it.

    "Cannot tell" is left out and counted. ``value`` is None where nothing remains; ``interval`` is over resampled
    items, None for a single one. ``per_scene``: the same mean of each scene. ``judge``: ``automatic`` is the ground
    truth's answer to the very same items.
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
    """``right`` less ``left`` over the ``n_items`` questions or instances that both have, as people judged them.

    ``p``: two-sided sign-flip test over the ``n_differ`` that differ, McNemar's exact test where each is judged once;
    1 where none differs. ``smallest_p`` is the least that so many can give.
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
    """How far annotators agree on one question; "cannot tell" is an answer like any other."""

    ask: str
    agreement: Agreement


@dataclass(frozen=True)
class Confusion:
    """People's judgements (rows, in the order of ``choices``) by what the ground truth says (columns).

    ``n_equal`` of ``n`` judgements other than "cannot tell" are the truth's; ``kappa`` is Cohen's of the two.
    """

    ask: str
    choices: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]
    n: int
    n_equal: int
    kappa: float | None


@dataclass(frozen=True)
class SecondLook:
    """An item on which annotators differ, or most of them from the truth. ``automatic`` is '' where nobody knows."""

    item_id: str
    ask: str
    text: str
    scene: str
    methods: tuple[str, ...]
    pictures: tuple[str, ...]
    answers: Mapping[str, str]
    automatic: str
    reason: Literal["annotators disagree", "against the truth"]


@dataclass(frozen=True)
class Scores:
    """All that is known of a set; ``annotators``: name -> number of judgements, ``silent`` those without any."""

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
    second_looks: tuple[SecondLook, ...]
    answered_by: str = ""
    schema_version: int = SCHEMA


@dataclass(frozen=True)
class _Value:
    """What one item gives to one metric of each of its methods; ``unit`` is what methods are compared over."""

    metric: str
    unit: str
    key: KeyItem
    values: tuple[float, ...]
    n_cannot_tell: int

    @property
    def mean(self) -> float:
        return float(np.mean(self.values))


def score(sheet: Sheet, key: Key, judgements: Sequence[Judgement], silent: Sequence[str] = ()) -> Scores:
    """The scores of judgements that ``check_answers`` found without fault; without any, what the truth says of all."""
    keys = {one.id: one for one in key.items}
    told = [(keys[one.item_id], one.ask, one.answer) for one in judgements]
    by_people = _values(told)
    judged = {(one.item_id, one.ask) for one in judgements}
    truth = [
        (one, ask, choice)
        for one in key.items
        for ask, choice in one.automatic.items()
        if (one.id, ask) in judged or not judgements
    ]
    ratings = _ratings(told, judgements)
    return Scores(
        sheet_id=sheet.id,
        kind=sheet.kind,
        run=key.run,
        automatic_rule=key.automatic_rule,
        methods=key.methods,
        annotators=dict(sorted(Counter(one.annotator for one in judgements).items())),
        silent=tuple(silent),
        n_items=len(sheet.items),
        n_judged=len({one.item_id for one in judgements}),
        cells=(*_cells("people", key.methods, by_people), *_cells("automatic", key.methods, _values(truth))),
        tests=tuple(_label_tests(key, by_people) if sheet.kind == "annotation" else _method_tests(key, by_people)),
        agreements=tuple(AskAgreement(what, agreement(items)) for what, items in ratings.items()),
        confusions=tuple(one for what in ratings if (one := _confusion(sheet, what, told)) is not None),
        second_looks=tuple(_second_looks(sheet, keys, judgements)),
        answered_by=key.answered_by,
    )


_Told = tuple[KeyItem, str, str]  # an item, one of its asks, the answer


def _ratings(told: Sequence[_Told], judgements: Sequence[Judgement]) -> dict[str, dict[str, dict[str, str]]]:
    """What is asked -> item and ask -> annotator -> answer."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    for (key, ask, answer), one in zip(told, judgements, strict=True):
        found.setdefault(_asked(key, ask), {}).setdefault(f"{key.id}\0{ask}", {})[one.annotator] = answer
    return found


def _asked(key: KeyItem, ask: str) -> str:
    """The name of what is asked: labels 1 and 2 change places from item to item and ask the same."""
    return "label" if ask in key.stands_for else ask


def _values(told: Iterable[_Told]) -> list[_Value]:
    """What items give to metrics, each metric of an item once, in the order of the sheet."""
    answers: dict[tuple[str, str], list[str]] = defaultdict(list)
    keys: dict[str, KeyItem] = {}
    for key, ask, answer in told:
        answers[key.id, ask].append(answer)
        keys[key.id] = key
    found = []
    for (item, ask), given in answers.items():
        key = keys[item]
        clear = [answer for answer in given if answer != CANNOT_TELL]
        unit = f"{key.scene}\0{key.question_id or item}"
        for metric, choice in _metrics(key, ask):
            found.append(
                _Value(metric, unit, key, tuple(float(one == choice) for one in clear), len(given) - len(clear))
            )
    return found


def _metrics(key: KeyItem, ask: str) -> list[tuple[str, str]]:
    """The metrics that an ask of an item speaks to, and the choice that speaks for each."""
    if ask == "retrieval":
        return [(key.question_kind, RIGHT), (OF_ALL_KINDS, RIGHT)]
    if ask == "merging":
        return [(name, name) for name in (WELL_MERGED, UNDER_MERGED, OVER_MERGED)]
    if ask in key.stands_for:
        return [(f"label {name}", RIGHT) for name in key.stands_for[ask]]
    return [(ask, RIGHT)]


def _cells(judge: Judge, methods: Sequence[str], values: Sequence[_Value]) -> list[ScoreCell]:
    groups: dict[tuple[str, str, str], list[_Value]] = defaultdict(list)
    for one in values:
        for method in one.key.methods:
            groups[method, one.key.scene.partition("/")[0], one.metric].append(one)

    def order(place: tuple[str, str, str]) -> tuple[str, int, int]:
        return place[1], methods.index(place[0]), METRICS.index(place[2])

    return [_cell(judge, *place, groups[place]) for place in sorted(groups, key=order)]


def _cell(judge: Judge, method: str, dataset: str, metric: str, group: Sequence[_Value]) -> ScoreCell:
    clear = [one for one in group if one.values]
    scenes: dict[str, list[float]] = defaultdict(list)
    for one in clear:
        scenes[one.key.scene].append(one.mean)
    means = np.array([one.mean for one in clear], np.float64)
    return ScoreCell(
        judge=judge,
        method=method,
        dataset=dataset,
        metric=metric,
        value=float(means.mean()) if len(means) else None,
        interval=_interval(means),
        n_items=len(clear),
        n_judgements=sum(len(one.values) for one in group),
        n_cannot_tell=sum(one.n_cannot_tell for one in group),
        per_scene={scene: float(np.mean(found)) for scene, found in sorted(scenes.items())},
    )


def _interval(means: Float64Array) -> Interval | None:
    """Of the mean, over items drawn with replacement; None for a single one."""
    if len(means) < 2:
        return None
    return percentile_interval(_draws(len(means)) @ means / len(means))


@lru_cache(maxsize=4)
def _draws(n_items: int) -> Float64Array:
    """How often each item is drawn (R, N), the same for every number of as many items."""
    return resample_weights(n_items).astype(np.float64)


def _method_tests(key: Key, values: Sequence[_Value]) -> list[PairTest]:
    """Each pair of methods under each metric, over the questions that were asked of both."""
    found: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    for one in values:
        place = one.key.scene.partition("/")[0], one.metric
        for method in one.key.methods if one.values else ():
            found.setdefault(place, {}).setdefault(method, {})[one.unit] = one.mean
    tests = []
    for (dataset, metric), of_method in sorted(found.items(), key=lambda one: (one[0][0], METRICS.index(one[0][1]))):
        for left, right in combinations([method for method in key.methods if method in of_method], 2):
            tests.append(_test(left, right, dataset, metric, of_method[left], of_method[right]))
    return [one for one in tests if one.n_items]


def _label_tests(key: Key, values: Sequence[_Value]) -> list[PairTest]:
    """Label n' against n of each method over its instances; other methods have other instances."""
    found: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    for one in values:
        for method in one.key.methods if one.values else ():
            place = one.key.scene.partition("/")[0], method
            found.setdefault(place, {}).setdefault(one.metric, {})[one.unit] = one.mean
    left, right = LABEL_METRICS
    tests = [
        _test(f"{method} {left}", f"{method} {right}", dataset, "label", labels.get(left, {}), labels.get(right, {}))
        for (dataset, method), labels in sorted(found.items(), key=lambda one: key.methods.index(one[0][1]))
    ]
    return [one for one in tests if one.n_items]


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
        interval=_interval(changes),
        n_items=len(changes),
        n_differ=int(np.count_nonzero(changes)),
        p=p,
        smallest_p=smallest_p,
        is_exact=is_exact,
    )


def paired_p(changes: Float64Array) -> tuple[float, float, bool]:
    """The two-sided p of the sign-flip test of ``changes``, the least that so many can give, and whether it is exact.

    What does not change no sign can move. Shares of a few judges are multiples of one small step, so that the sums of
    all patterns of signs can be counted, however many there are; where each item is judged once, this is McNemar's
    exact test. Beyond ``MOST_STEPS`` it is ``sign_flip_test``.

    >>> paired_p(np.array([1.0, 1.0, 1.0, 0.0]))
    (0.25, 0.25, True)
    """
    differ = changes[changes != 0]
    if not len(differ):
        return 1.0, 1.0, True
    for n_steps in STEPS:
        steps = np.rint(differ * n_steps)
        if np.abs(steps / n_steps - differ).max() < 1e-9 and np.abs(steps).sum() <= MOST_STEPS:
            return _sign_flip_of_steps(steps.astype(np.int64)), min(1.0, 2.0 ** (1 - len(differ))), True
    test = sign_flip_test(differ)
    assert test is not None
    return test.p, test.smallest_p, test.is_exact


def _sign_flip_of_steps(steps: Int64Array) -> float:
    """How likely a sum of ``steps`` with random signs is as far from 0 as theirs, from the distribution of the sum."""
    sizes = np.abs(steps)
    far = int(sizes.sum())
    shares = np.zeros(2 * far + 1)
    shares[far] = 1.0
    for size in sizes:
        # the ends are 0 until the last step, so that nothing comes round
        shares = (np.roll(shares, size) + np.roll(shares, -size)) / 2.0
    at_least = abs(int(steps.sum()))
    return min(1.0, float(shares[np.abs(np.arange(-far, far + 1)) >= at_least].sum()))


def _confusion(sheet: Sheet, what: str, told: Sequence[_Told]) -> Confusion | None:
    """None where the truth is known of no judged item."""
    known = [(key, ask, answer) for key, ask, answer in told if _asked(key, ask) == what and ask in key.automatic]
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
        n_equal=sum(one == other for one, other in clear),
        kappa=cohen_kappa([one for one, _ in clear], [other for _, other in clear]),
    )


def _second_looks(sheet: Sheet, keys: Mapping[str, KeyItem], judgements: Iterable[Judgement]) -> list[SecondLook]:
    """What somebody should look at again, in the order of the sheet."""
    given: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for one in judgements:
        given[one.item_id, one.ask][one.annotator] = one.answer
    found = []
    for item in sheet.items:
        key = keys[item.id]
        for ask in item.asks:
            answers = given[item.id, ask]
            automatic = key.automatic.get(ask, "")
            reason = _reason(list(answers.values()), automatic)
            if reason is not None:
                found.append(
                    SecondLook(
                        item.id, ask, item.text, key.scene, key.methods, item.pictures, answers, automatic, reason
                    )
                )
    return found


def _reason(answers: Sequence[str], automatic: str) -> Literal["annotators disagree", "against the truth"] | None:
    if len(set(answers)) > 1:
        return "annotators disagree"
    is_against = bool(answers) and automatic not in ("", CANNOT_TELL) and answers[0] not in (automatic, CANNOT_TELL)
    return "against the truth" if is_against else None
