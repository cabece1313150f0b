"""Tables IV and V of the paper, judged by annotators and by ground truth, side by side."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from measured_rows import SCENES, measured
from simulated_annotators import RATES, SCHEMES, annotation_set, answered, reasoning_set, retrieval_set

from su3d_bench.analysis.tables import check_paper, measured_results
from su3d_bench.cli.main import main
from su3d_bench.human_eval.answers import check_answers
from su3d_bench.human_eval.scores import score, write_scores
from su3d_bench.reports.tables.judged import judged_table
from su3d_bench.reports.tables.latex import latex
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.paper import Shown

LABELS = [
    ("right", "right", "well-merged"),
    ("wrong", "right", "well-merged"),
    ("wrong", "wrong", "under-merged"),
    ("wrong", "", "over-merged"),  # excluded from labels n'
]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Scores of a retrieval sheet and of an annotation sheet."""
    found = []
    for name, (sheet, key) in (("retrieval", retrieval_set(40)), ("annotation", annotation_set(LABELS))):
        folder = tmp_path_factory.mktemp(name)
        checked = check_answers(sheet, answered(sheet, key, {"ann": 0.0}))
        write_scores(folder, score(sheet, key, checked.judgements))
        found.append(folder)
    return found[0], found[1]


def by_truth(method: str, kind: str, dataset: str, **values: float) -> Measured:
    scenes = [scene.replace("replica", dataset) for scene in SCENES]
    return measured(
        method,
        run="runs/auto",
        protocol=f"{dataset}-{kind}",
        kind=kind,
        headline=tuple(values),
        metrics=dict(values),
        intervals={},
        per_scene={scene: dict(values) for scene in scenes},
        ceilings={},
    )


def result(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    capsys.readouterr()
    assert main(["report", "tables", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def texts(table: Any) -> dict[str, list[str]]:
    return {row["label"]: [cell["text"] for cell in row["cells"]] for row in table["rows"] if not row["is_reported"]}


def test_table_iv_shows_annotators_judgements(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    (table,) = result(capsys, str(folders[0]), "--tables", "IV")
    assert table["columns"] == ["instance", "affordance", "property", "relative"]
    assert texts(table) == {f"{one}, annotators": [f"{RATES[one]:.3f}"] * 4 for one in SCHEMES}
    assert {cell["beside"] for row in table["rows"][:4] for cell in row["cells"]} == {"n=10"}
    assert not any(cell["is_best"] for row in table["rows"] for cell in row["cells"])  # 9 of 10 against 7 of 10
    assert sum("with so few items, p < 0.05 is impossible" in note for note in table["notes"]) == 1
    assert any("judged by 1 annotator, 40 items" in note for note in table["notes"])
    assert sum(row["is_reported"] for row in table["rows"]) == 8
    assert table["caption"] == "Retrieval by text on rooms; not the paper's set-up: other scenes."


def test_best_of_annotators_is_marked_by_the_test_over_items(tmp_path: Path) -> None:
    sheet, key = retrieval_set(160)
    checked = check_answers(sheet, answered(sheet, key, {"ann": 0.0}))
    write_scores(tmp_path, score(sheet, key, checked.judgements))
    table = judged_table("IV", measured_results([tmp_path]), Shown(), with_published=False)
    assert [row.cells[0].is_best for row in table.rows] == [False, False, False, True]  # 36 of 40 against 28
    assert any("sign-flip test over items" in note for note in table.notes)


def test_table_v_has_one_row_per_label(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    (table,) = result(capsys, str(folders[1]), "--tables", "V", "--no-published")
    assert table["columns"] == ["label-accuracy", "merge-accuracy"]
    assert texts(table) == {
        "opensu3d: direct label (n), annotators": ["0.250", "0.500"],
        "opensu3d: refined label (n'), annotators": ["0.667", "0.667"],
    }
    origins = [cell["origin"] for row in table["rows"] for cell in row["cells"][:2]]
    assert [(one["method"], one["metric"]) for one in origins] == [
        ("opensu3d", "label n"),
        ("opensu3d", "well-merged"),
        ("opensu3d", "label n'"),
        ("opensu3d", "well-merged n'"),
    ]


def test_two_datasets_share_one_table_with_the_papers_digits() -> None:
    values = {"instance": 0.8, "affordance": 0.7, "property": 0.6, "relative": 0.5}
    n = {f"n_{kind}": 40.0 + k for k, kind in enumerate(values)}
    rows = [by_truth("opensu3d", "retrieval", dataset, **values, **n) for dataset in ("replica", "scannet")]
    table = judged_table("IV", rows, Shown(), with_published=True)
    assert table.name == "IV-replica-scannet"
    assert table.columns == tuple(f"{dataset} {kind}" for dataset in ("replica", "scannet") for kind in values)
    own, *reported = table.rows
    assert [cell.whole for cell in own.cells[:4]] == ["0.800 n=40", "0.700 n=41", "0.600 n=42", "0.500 n=43"]
    assert [row.label for row in reported] == [f"scheme{k}" for k in range(1, 5)]
    assert [cell.text for cell in reported[-1].cells] == ["0.8", "0.9", "0.9", "0.6", "0.9", "0.7", "0.7", "0.7"]
    assert reported[0].mark == "a, b" and sum(note.startswith("[") for note in table.notes) == 2
    assert table.caption.endswith("; not the paper's set-up: other scenes, perception, judges.")


def test_reasoning_table_shows_measured_and_published_scores(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet, key = reasoning_set([("right", "right"), ("right", "wrong"), ("wrong", "wrong"), ("right", "right")])
    checked = check_answers(sheet, answered(sheet, key, {"ann": 0.0}))
    write_scores(tmp_path, score(sheet, key, checked.judgements))
    (table,) = result(capsys, str(tmp_path), "--tables", "reasoning")
    assert table["columns"] == ["reasoning-accuracy", "objects"]
    assert list(texts(table).values()) == [["0.750", "0.500"]]
    reported = [row for row in table["rows"] if row["is_reported"]]
    assert [row["cells"][0]["text"] for row in reported] == ["0.83", "0.68"]
    assert all("70 questions" in row["label"] for row in reported)
    assert len({row["mark"] for row in reported}) == 2
    told_by = "every scene: answers by the language model gpt-4"
    truth = by_truth("a: b", "reasoning", "rooms", answer=0.6, n_answer=50.0, objects=0.5)
    rows = [*measured_results([tmp_path]), replace(truth, warnings=(told_by,)), replace(truth, method="c")]
    both = judged_table("reasoning", rows, Shown(), with_published=True)
    measured_rows = [row for row in both.rows if not row.is_reported]
    assert [row.cells[0].whole for row in measured_rows] == ["0.750 n=4", "0.600 n=50", "0.600 n=50"]
    assert measured_rows[1].label == "a: b, answers by the language model gpt-4, ground truth"
    paper = tmp_path / "paper.tex"
    paper.write_text(latex([judged_table("reasoning", rows[:1], Shown(), with_published=True)]))
    checks = check_paper(paper)
    assert len(checks) == 2 and [check.fault for check in checks if check.fault] == []


def test_verify_checks_annotators_numbers_against_their_scores(folders: tuple[Path, Path], tmp_path: Path) -> None:
    rows = measured_results(folders)
    shown = Shown(intervals=True)
    tables = [
        judged_table("IV", rows, shown, with_published=True),
        judged_table("V", rows, shown, with_published=True),
    ]
    paper = tmp_path / "paper.tex"
    paper.write_text(latex(tables))
    checks = check_paper(paper)
    assert len(checks) == 4 * 4 + 2 * 2
    assert [check.fault for check in checks if check.fault] == []
    paper.write_text(latex(tables).replace("& 0.900", "& 0.901"))
    assert sum(check.fault is not None for check in check_paper(paper)) == 4
