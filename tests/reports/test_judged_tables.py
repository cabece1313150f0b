"""Tables IV and V of the paper: from what people judged, from what the ground truth judged, side by side."""

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
from su3d_bench.core.errors import ConfigError
from su3d_bench.reports.tables.judged import judged_table
from su3d_bench.reports.tables.latex import latex
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.paper import Shown
from su3d_bench.sheets.answers import check_answers
from su3d_bench.sheets.scores import score, write_scores

LABELS = [
    ("right", "right", "well-merged"),
    ("wrong", "right", "well-merged"),
    ("wrong", "wrong", "under-merged"),
    ("wrong", "", "over-merged"),  # labels n' leave it out
]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Scores of a retrieval set and of an annotation set."""
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


def told(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    capsys.readouterr()
    assert main(["report", "tables", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def texts(table: Any) -> dict[str, list[str]]:
    return {row["label"]: [cell["text"] for cell in row["cells"]] for row in table["rows"] if not row["is_reported"]}


def test_table_iv_is_made_of_what_people_judged(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    (table,) = told(capsys, str(folders[0]), "--table", "IV")
    assert table["columns"] == ["instance", "affordance", "property", "relative", "scenes"]
    assert texts(table) == {f"{one}, people": [f"{100 * RATES[one]:.1f}"] * 4 + ["1"] for one in SCHEMES}
    assert [row["cells"][0]["is_best"] for row in table["rows"][:4]] == [False, False, False, True]
    assert any("judged by 1 person, 40 items" in note for note in table["notes"])
    assert sum(row["is_reported"] for row in table["rows"]) == 8
    assert "not the paper's data" in table["caption"]  # the rooms


def test_table_v_has_a_row_for_each_label(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    (table,) = told(capsys, str(folders[1]), "--table", "V", "--no-published")
    assert table["columns"] == ["label-accuracy", "merge-accuracy", "scenes"]
    assert texts(table) == {
        "opensu3d: direct label (n), people": ["25.0", "50.0", "1"],
        "opensu3d: refined label (n'), people": ["66.7", "66.7", "1"],
    }
    origins = [cell["origin"] for row in table["rows"] for cell in row["cells"][:2]]
    assert [(one["method"], one["metric"]) for one in origins] == [
        ("opensu3d", "label n"),
        ("opensu3d", "well-merged"),
        ("opensu3d", "label n'"),
        ("opensu3d", "well-merged n'"),
    ]


@pytest.mark.parametrize(
    ("warning", "label"),
    [
        ("every scene: n': the vote of the names of 5 views, no language model", "(n' is a vote)"),
        ("replica/a: n': the model gpt-4 of su3d-bench refine, names of 5 views", "(n' by the model gpt-4)"),
        ("no label n': the map keeps no names of views", "(n')"),
    ],
)
def test_the_row_of_label_n_prime_says_who_made_it(warning: str, label: str) -> None:
    values = {"label n": 0.7, "label n'": 0.8, "well-merged": 0.5, "well-merged n'": 0.6}
    row = replace(by_truth("opensu3d", "annotation", "replica", **values), warnings=(warning,))
    (table,) = judged_table("V", [row], Shown(), with_published=True)
    assert [(one.label, [cell.text for cell in one.cells[:2]]) for one in table.rows[:2]] == [
        ("opensu3d: direct label (n), ground truth", ["70.0", "50.0"]),
        (f"opensu3d: refined label {label}, ground truth", ["80.0", "60.0"]),
    ]
    assert [[cell.text for cell in one.cells[:2]] for one in table.rows if one.is_reported] == [
        ["83", "87"],
        ["87", "88"],
    ]


def test_people_and_ground_truth_stand_apart_in_one_table(folders: tuple[Path, Path]) -> None:
    people = measured_results([folders[0]])
    truth = by_truth(SCHEMES[0], "retrieval", "rooms", instance=0.99, affordance=0.9, property=0.8, relative=0.1)
    (table,) = judged_table("IV", [truth, *people], Shown(), with_published=False)
    assert [(row.label, row.group) for row in table.rows] == [
        *((f"{one}, people", "people") for one in SCHEMES),
        (f"{SCHEMES[0]}, ground truth", "ground truth"),
    ]
    assert [row.cells[0].is_best for row in table.rows] == [False, False, False, True, False]


def test_each_dataset_has_a_table_with_the_papers_rows_for_it() -> None:
    values = {"instance": 0.8, "affordance": 0.7, "property": 0.6, "relative": 0.5}
    rows = [by_truth("opensu3d", "retrieval", dataset, **values) for dataset in ("replica", "scannet")]
    tables = judged_table("IV", rows, Shown(), with_published=True)
    assert [one.name for one in tables] == ["IV-replica", "IV-scannet"]
    reported = [row for row in tables[1].rows if row.is_reported]
    assert [cell.text for cell in reported[-1].cells[:4]] == ["90", "70", "70", "70"]  # scheme 4 on ScanNet
    assert all("not the paper's" not in one.caption for one in tables)


def test_reasoning_has_its_scores_above_the_papers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet, key = reasoning_set([("right", "right"), ("right", "wrong"), ("wrong", "wrong"), ("right", "right")])
    checked = check_answers(sheet, answered(sheet, key, {"ann": 0.0}))
    write_scores(tmp_path, score(sheet, key, checked.judgements))
    (table,) = told(capsys, str(tmp_path), "--table", "reasoning")
    assert table["columns"] == ["reasoning-accuracy", "objects", "scenes"]
    assert list(texts(table).values()) == [["75.0", "50.0", "1"]]
    reported = [row for row in table["rows"] if row["is_reported"]]
    assert [row["cells"][0]["text"] for row in reported] == ["83", "68"]
    assert all("70 questions" in row["label"] for row in reported)
    assert len({row["mark"] for row in reported}) == 2
    told_by = "every scene: answers by the language model gpt-4"
    truth = by_truth("a: b", "reasoning", "rooms", answer=0.6, objects=0.5)
    rows = [*measured_results([tmp_path]), replace(truth, warnings=(told_by,)), replace(truth, method="c")]
    tables = judged_table("reasoning", rows, Shown(), with_published=True)
    measured_rows = [row for row in tables[0].rows if not row.is_reported]
    assert [row.cells[0].text for row in measured_rows] == ["75.0", "60.0", "60.0"]
    assert measured_rows[1].label == "a: b, answers by the language model gpt-4, ground truth"
    paper = tmp_path / "paper.tex"
    paper.write_text(latex(judged_table("reasoning", rows[:1], Shown(), with_published=True)))
    checks = check_paper(paper)
    assert len(checks) == 3 and [check.fault for check in checks if check.fault] == []


def test_without_judged_rows_the_message_says_what_makes_them() -> None:
    with pytest.raises(ConfigError) as caught:
        judged_table("V", [measured()], Shown(), with_published=True)
    assert "needs protocol rooms-annotation" in str(caught.value) and "sheets of kind annotation" in str(caught.value)


def test_a_paper_with_peoples_numbers_is_checked_against_their_scores(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    rows = measured_results(folders)
    shown = Shown(intervals=True)
    tables = [
        *judged_table("IV", rows, shown, with_published=True),
        *judged_table("V", rows, shown, with_published=True),
    ]
    paper = tmp_path / "paper.tex"
    paper.write_text(latex(tables))
    checks = check_paper(paper)
    assert len(checks) == 4 * 5 + 2 * 3
    assert [check.fault for check in checks if check.fault] == []
    paper.write_text(latex(tables).replace("& 90.0", "& 91.0").replace("& \\textbf{90.0}", "& \\textbf{91.0}"))
    assert sum(check.fault is not None for check in check_paper(paper)) == 4


def test_scores_alone_give_a_table_of_all_that_was_judged(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    tables = told(capsys, str(folders[1] / "scores.json"))
    assert [one["name"] for one in tables] == ["rooms-annotation-people"]
    assert tables[0]["columns"][:3] == ["label n", "label n'", "well-merged"]
