"""Sheets as created, filled by simulated annotators with known error rates as tables, and scored."""

from __future__ import annotations

import csv
import io
import json
import random
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from su3d_bench.cli.main import main
from su3d_bench.human_eval.drafts import Draft
from su3d_bench.human_eval.items import CANNOT_TELL, Key, Sheet, SheetKind
from su3d_bench.human_eval.sets import TABLE, make_sheets, write_sheets

HOSTILE = '=HYPERLINK("x") <script>alert(1)</script> \u202eabc " , ; \U0001f600'


def drafts(kind: SheetKind, n: int) -> list[Draft]:
    """``n`` items to judge, for which the ground truth has all possible judgements in turn."""
    found = []
    for k in range(n):
        right, other = ("right", "wrong") if k % 3 else ("wrong", "right")
        more: dict[str, Any] = {}
        if kind == "retrieval":
            more = {"asks": ("retrieval",), "automatic": {"retrieval": right}, "question_kind": "instance"}
        elif kind == "annotation":
            merging = ("well-merged", "under-merged", "over-merged")[k % 3]
            more = {"asks": ("label 1", "label 2", "merging"), "represents": {"label 1": ("n'",), "label 2": ("n",)}}
            more["automatic"] = {"label 1": right, "label 2": other, "merging": merging}
        else:
            more = {"asks": ("answer", "objects"), "automatic": {"answer": right, "objects": other}}
            more["question_kind"] = "closer"
        more["question_id"] = "" if kind == "annotation" else f"q{k}"
        found.append(Draft(kind, "rooms/a", ("opensu3d",), (k,), (k,), (HOSTILE,), f"{HOSTILE} {k}", **more))
    return found


def fill(sheet: Sheet, key: Key, folder: Path, name: str, error_rate: float) -> Path:
    """The file of an annotator with all answers."""
    rng = random.Random(name)
    truth = {one.id: one.automatic for one in key.items}

    def answer(item: str, ask: str) -> str:
        right = truth[item][ask]
        others = [one for one in sheet.ask(ask).choices if one not in (right, CANNOT_TELL)]
        return rng.choice(others) if rng.random() < error_rate else right

    path = folder / name / TABLE
    table = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline="")))
    for cells in table[1:]:
        cells[table[0].index("answer")] = answer(cells[1], cells[3])
    with path.open("w", encoding="utf-8-sig", newline="") as stream:
        csv.writer(stream, delimiter=";").writerows(table)  # as saved by a spreadsheet with another locale
    return path


@pytest.mark.parametrize("kind", ["retrieval", "annotation", "reasoning"])
def test_annotator_answers_are_scored_end_to_end(kind: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    png = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    origin = Key("", kind, "runs/made", "0", ("opensu3d",), "a made truth", ())
    made = make_sheets(origin, drafts(kind, 30), [png] * 30, seed=5, annotators=3, overlap=0.4)
    folder, apart = tmp_path / "sheets" / kind, tmp_path / "sheets" / f"{kind}-key"
    write_sheets(made, folder, apart)
    rates = {"annotator-1": 0.0, "annotator-2": 0.0, "annotator-3": 0.8}
    files = [fill(made.sheet, made.key, folder, name, rate) for name, rate in rates.items()]
    capsys.readouterr()
    assert main(["sheets", "score", *map(str, files[:2]), "--key", str(apart), "--json"]) == 0
    result = capsys.readouterr()
    found = json.loads(result.out)
    assert "no answers from annotator-3" in result.err and found["silent"] == ["annotator-3"]
    values = {(one["judge"], one["metric"]): (one["value"], one["n_items"]) for one in found["cells"]}
    metrics = {metric for _, metric in values}
    assert found["n_judged"] == 24  # the 12 shared by all, and 6 of each of two annotators
    assert {metric: values["people", metric] for metric in metrics} == {m: values["automatic", m] for m in metrics}
    assert all(
        one["agreement"]["alpha"] == 1.0 and one["agreement"]["n_items"] % 12 == 0 for one in found["agreements"]
    )
    assert found["review_items"] == []

    out = tmp_path / "scores"
    assert main(["sheets", "score", *map(str, files), "--key", str(apart), "--out", str(out), "--quiet"]) == 0
    found = json.loads((out / "scores.json").read_text())
    assert found["n_judged"] == 30 and found["review_items"]
    assert {one["reason"] for one in found["review_items"]} == {"annotators disagree", "against the truth"}
    assert all(one["agreement"]["alpha"] < 1.0 for one in found["agreements"])
    page = (out / "review_items.html").read_text()
    assert f"../sheets/{kind}/pictures/item-" in page and "<script" not in page
    assert "\u202e" not in page + (out / "review_items.csv").read_text()
