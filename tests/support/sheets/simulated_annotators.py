"""Sets of sheets with a known truth, and people who answer them with known error rates."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np

from su3d_bench.questions.model import KINDS
from su3d_bench.sheets.answers import AnswerRow
from su3d_bench.sheets.items import (
    ANSWER_COLUMNS,
    ASKS,
    CANNOT_TELL,
    AnnotatorShare,
    Key,
    KeyItem,
    Sheet,
    SheetItem,
    SheetKind,
    new_item,
)

SCHEMES = tuple(f"opensu3d@scheme{k}" for k in range(1, 5))
RATES = {SCHEMES[0]: 0.5, SCHEMES[1]: 0.6, SCHEMES[2]: 0.7, SCHEMES[3]: 0.9}  # how often each is right, in truth
SET_ID = "-0123456789ab"


def retrieval_set(
    n_questions: int, annotators: Sequence[str] = ("ann",), scenes: Sequence[str] = ("rooms/a",)
) -> tuple[Sheet, Key]:
    """Sheet and key of ``n_questions`` to each of ``SCHEMES``, each as often right as ``RATES`` says.

    All schemes that are right retrieve the same instance, which is one item; so do all that are wrong.
    """
    items: list[SheetItem] = []
    keys: list[KeyItem] = []
    for k in range(n_questions):
        kind, scene = KINDS[k % len(KINDS)], scenes[k % len(scenes)]
        place = (k // len(KINDS) + 0.5) / (n_questions // len(KINDS))  # the same shares in each kind
        for choice in ("right", "wrong"):
            methods = tuple(one for one in SCHEMES if (place < RATES[one]) == (choice == "right"))
            if methods:
                items.append(_item("retrieval", len(items), f"{kind} {k}", ("retrieval",)))
                told = (scene, methods, (k,) * len(methods), f"q{k}", kind)
                keys.append(KeyItem(items[-1].id, *told, {}, {"retrieval": choice}))
    return _set("retrieval", items, keys, SCHEMES, annotators)


def annotation_set(truths: Sequence[tuple[str, str, str]], annotators: Sequence[str] = ("ann",)) -> tuple[Sheet, Key]:
    """One instance for each (label n, label n', merging) of the truth; equal labels are asked once.

    Where they are not, label 1 is n' in every other item. An empty label n': these labels leave the instance out.
    """
    items: list[SheetItem] = []
    keys: list[KeyItem] = []
    for k, (first, second, merging) in enumerate(truths):
        if second in ("", first):
            stands_for: dict[str, tuple[str, ...]] = {"label 1": ("n", "n'") if second else ("n",)}
            automatic = {"label 1": first, "merging": merging}
        elif k % 2:
            stands_for = {"label 1": ("n'",), "label 2": ("n",)}
            automatic = {"label 1": second, "label 2": first, "merging": merging}
        else:
            stands_for = {"label 1": ("n",), "label 2": ("n'",)}
            automatic = {"label 1": first, "label 2": second, "merging": merging}
        items.append(_item("annotation", k, f"labels of {k}", tuple(automatic)))
        keys.append(KeyItem(items[-1].id, "rooms/a", ("opensu3d",), (k,), "", "", stands_for, automatic))
    return _set("annotation", items, keys, ("opensu3d",), annotators)


def reasoning_set(truths: Sequence[tuple[str, str]], annotators: Sequence[str] = ("ann",)) -> tuple[Sheet, Key]:
    """One question for each (answer, objects) of the truth."""
    items = [_item("reasoning", k, f"question {k}", ("answer", "objects")) for k in range(len(truths))]
    keys = [
        KeyItem(
            item.id, "rooms/a", ("opensu3d",), (-1,), f"q{k}", "reasoning", {}, dict(zip(item.asks, truth, strict=True))
        )
        for k, (item, truth) in enumerate(zip(items, truths, strict=True))
    ]
    return _set("reasoning", items, keys, ("opensu3d",), annotators)


def _item(kind: SheetKind, number: int, text: str, asks: tuple[str, ...]) -> SheetItem:
    name = f"item-{number:04d}"
    return new_item(kind + SET_ID, name, text, asks, [f"{name}.png"], ["ab"])


def _set(
    kind: SheetKind,
    items: Sequence[SheetItem],
    keys: Sequence[KeyItem],
    methods: tuple[str, ...],
    annotators: Sequence[str],
) -> tuple[Sheet, Key]:
    shares = tuple(AnnotatorShare(name, tuple(one.id for one in items)) for name in annotators)
    sheet = Sheet(kind + SET_ID, kind, 7, ASKS[kind], tuple(items), shares)
    return sheet, Key(sheet.id, kind, "runs/made", "0", methods, "a made truth", tuple(keys))


def answered(sheet: Sheet, key: Key, error_rates: Mapping[str, float], seed: int = 0) -> list[AnswerRow]:
    """The rows of people who err in so many of their answers, choosing any other choice but "cannot tell"."""
    rng = np.random.default_rng(seed)
    truth = {one.id: one.automatic for one in key.items}
    rows: list[AnswerRow] = []
    for name, rate in error_rates.items():
        for item in sheet.items:
            for ask in item.asks:
                right = truth[item.id][ask]
                others = [one for one in sheet.ask(ask).choices if one not in (right, CANNOT_TELL)]
                answer = others[int(rng.integers(len(others)))] if rng.random() < rate else right
                at = f"{name}.csv: row {len(rows) + 2}"
                rows.append(AnswerRow(at, sheet.id, item.id, name, ask, answer, item.check))
    return rows


def as_csv(rows: Sequence[AnswerRow], separator: str = ",") -> str:
    """The rows as a page exports them."""
    text = io.StringIO()
    writer = csv.writer(text, delimiter=separator)
    writer.writerow(ANSWER_COLUMNS)
    writer.writerows([[getattr(one, name) for name in ANSWER_COLUMNS] for one in rows])
    return text.getvalue()
