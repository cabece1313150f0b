"""Sets of sheets with known ground truth, annotators with known error rates, and the files they return."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from su3d_bench.human_eval.answers import AnswerRow, check_answers, check_key
from su3d_bench.human_eval.items import ANSWER_COLUMNS, ASKS, CANNOT_TELL, AnnotatorShare, Key, KeyItem, Sheet, new_item
from su3d_bench.human_eval.scores import Scores, score
from su3d_bench.questions.model import KINDS

SCHEMES = tuple(f"opensu3d@scheme{k}" for k in range(1, 5))
RATES = {SCHEMES[0]: 0.5, SCHEMES[1]: 0.6, SCHEMES[2]: 0.7, SCHEMES[3]: 0.9}  # true accuracy of each
SET_ID = "-0123456789ab"


def retrieval_set(
    n_questions: int, annotators: Sequence[str] = ("ann",), scenes: Sequence[str] = ("rooms/a",)
) -> tuple[Sheet, Key]:
    """Sheet and key of ``n_questions`` to each of ``SCHEMES``, each correct at its rate in ``RATES``.

    All correct schemes retrieve the same instance, which is one item; so do all wrong ones.
    """
    asked: list[tuple[str, KeyItem]] = []
    for k in range(n_questions):
        kind, scene = KINDS[k % len(KINDS)], scenes[k % len(scenes)]
        place = (k // len(KINDS) + 0.5) / (n_questions // len(KINDS))  # the same shares for each kind
        for choice in ("right", "wrong"):
            methods = tuple(one for one in SCHEMES if (place < RATES[one]) == (choice == "right"))
            if methods:
                ids = (k,) * len(methods)
                key = KeyItem("", scene, methods, ids, f"q{k}", kind, {}, {"retrieval": choice})
                asked.append((f"{kind} {k}", key))
    return _set("retrieval", asked, SCHEMES, annotators)


def annotation_set(truths: Sequence[tuple[str, str, str]], annotators: Sequence[str] = ("ann",)) -> tuple[Sheet, Key]:
    """One instance for each (label n, label n', merging) of the ground truth; equal labels are asked once.

    Otherwise label 1 is n' in every other item. An empty label n': these labels exclude the instance.
    """
    asked = []
    for k, (first, second, merging) in enumerate(truths):
        result = {"n": first, "n'": second}
        names: list[tuple[str, ...]] = [("n'",), ("n",)] if k % 2 else [("n",), ("n'",)]
        if second in ("", first):
            names = [("n", "n'") if second else ("n",)]
        represents = {f"label {place}": what for place, what in enumerate(names, 1)}
        automatic = {ask: result[what[0]] for ask, what in represents.items()} | {"merging": merging}
        key = KeyItem("", "rooms/a", ("opensu3d",), (k,), "", "", represents, automatic)
        asked.append((f"labels of {k}", key))
    return _set("annotation", asked, ("opensu3d",), annotators)


def reasoning_set(truths: Sequence[tuple[str, str]], annotators: Sequence[str] = ("ann",)) -> tuple[Sheet, Key]:
    """One question for each (answer, objects) of the ground truth."""
    asked = []
    for k, (answer, objects) in enumerate(truths):
        truth = {"answer": answer, "objects": objects}
        asked.append((f"question {k}", KeyItem("", "rooms/a", ("opensu3d",), (-1,), f"q{k}", "reasoning", {}, truth)))
    return _set("reasoning", asked, ("opensu3d",), annotators)


def _set(
    kind: Any, asked: Sequence[tuple[str, KeyItem]], methods: tuple[str, ...], annotators: Sequence[str]
) -> tuple[Sheet, Key]:
    """A set of texts to ask, each with its key, which describes the question and is numbered here."""
    set_id, names = kind + SET_ID, [f"item-{number:04d}" for number in range(len(asked))]
    keys = tuple(replace(key, id=name) for name, (_, key) in zip(names, asked, strict=True))
    items = tuple(
        new_item(set_id, key.id, text, tuple(key.automatic), [f"{key.id}.png"], ["ab"])
        for key, (text, _) in zip(keys, asked, strict=True)
    )
    shares = tuple(AnnotatorShare(name, tuple(names)) for name in annotators)
    key = Key(set_id, kind, "runs/made", "0", methods, "a made truth", keys)
    return Sheet(set_id, kind, 7, ASKS[kind], items, shares), key


def answered(sheet: Sheet, key: Key, error_rates: Mapping[str, float], seed: int = 0) -> list[AnswerRow]:
    """The rows of annotators who err in that many of their answers, choosing any other choice but "cannot tell"."""
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


def as_csv(rows: Sequence[AnswerRow], separator: str = ",", columns: Sequence[str] = ANSWER_COLUMNS) -> str:
    """The rows as exported by a page."""
    text = io.StringIO()
    writer = csv.writer(text, delimiter=separator)
    writer.writerow(columns)
    writer.writerows([[getattr(one, name) for name in columns] for one in rows])
    return text.getvalue()


def both(small: tuple[Sheet, Key]) -> list[AnswerRow]:
    """The answers of two annotators without errors."""
    return answered(*small, {"ann": 0.0, "bob": 0.0})


def scored(sheet: Sheet, key: Key, rows: Sequence[AnswerRow]) -> Scores:
    check_key(sheet, key)
    checked = check_answers(sheet, rows)
    assert checked.faults == ()
    return score(sheet, key, checked.judgements, checked.silent)
