"""Tables for papers: which numbers stand in them, what is marked, what is said beside, in every format."""

from __future__ import annotations

import csv
import io
from typing import Any

import pytest
from measured_rows import SCENES, measured, measured_instances

from su3d_bench.core.errors import ConfigError
from su3d_bench.reports.tables.formats import csv_text, html_page, markdown
from su3d_bench.reports.tables.latex import latex
from su3d_bench.reports.tables.model import Table
from su3d_bench.reports.tables.paper import (
    Shown,
    SweepRow,
    ablation_table,
    paper_table,
    protocol_table,
    selection_tables,
)


def texts(table: Table) -> list[list[str]]:
    return [[row.title, *(cell.whole for cell in row.cells)] for row in table.rows]


def best(table: Table) -> list[list[bool]]:
    return [[cell.is_best for cell in row.cells] for row in table.rows if not row.is_reported]


def test_measured_and_reported_rows_never_stand_without_a_mark() -> None:
    (table,) = paper_table("II", [measured()], Shown(), with_published=True)
    assert texts(table)[0] == ["opensu3d", "40.0", "20.0"]
    assert texts(table)[-1] == ["opensu3d (as reported [c])", "42.6", "40.9"]
    assert [row.is_reported for row in table.rows] == [False] + [True] * 5
    assert all(cell.origin is None and not cell.is_best for row in table.rows[1:] for cell in row.cells)
    assert sum(note.startswith("[") and "OpenSU3D" in note for note in table.notes) == 3
    for text in (markdown([table]), html_page([table])):
        assert text.count("as reported [") == 5
    assert latex([table]).count("as reported, not measured here") == 1
    lines = list(csv.DictReader(io.StringIO(csv_text([table]))))
    assert {line["kind"] for line in lines if line["text"] in {"42.6", "40.9"}} == {"reported"}


def test_published_rows_can_be_left_out() -> None:
    (table,) = paper_table("II", [measured()], Shown(), with_published=False)
    assert len(table.rows) == 1


def test_intervals_scores_of_the_truth_and_scenes_are_shown_on_request() -> None:
    table = protocol_table([measured()], Shown(intervals=True, ceilings=True, scenes_count=True), [])
    assert table.columns == ("mAcc", "F-mIoU", "mAcc (truth)", "F-mIoU (truth)", "scenes")
    assert texts(table) == [["opensu3d", "40.0 [35.0, 45.0]", "20.0", "98.0", "100.0", "8"]]
    assert protocol_table([measured()], Shown(), []).columns == ("mAcc", "F-mIoU")


def test_missing_scenes_and_partial_runs_are_shown_unasked() -> None:
    few = {scene: values for scene, values in measured().per_scene.items() if scene != SCENES[3]}
    seven = measured(per_scene=few, failed=(SCENES[3],))
    table = protocol_table([seven, measured("sam3d", 0.5)], Shown(), [])
    assert [row[-1] for row in texts(table)] == ["7/8", "8"]
    assert "opensu3d: INCOMPLETE: failed on replica/room3" in table.notes
    partial = protocol_table([measured(limit=20)], Shown(), [])
    assert texts(partial)[0][-1] == "8 partial"
    assert "opensu3d: PARTIAL: only the first 20 frames of each scene" in partial.notes


def test_a_method_that_failed_has_a_row_and_one_that_cannot_be_scored_a_note() -> None:
    empty: dict[str, Any] = {"metrics": {"mAcc": None, "F-mIoU": None}, "per_scene": {}, "ceilings": {}}
    failed = measured("conceptgraphs", failed=SCENES, **empty)
    unfit = measured("conceptfusion", unscored=SCENES, **empty)
    table = protocol_table([unfit, failed, measured(), measured("sam3d", 0.5)], Shown(), [])
    assert [row[0] for row in texts(table)] == ["conceptgraphs", "opensu3d", "sam3d"]
    assert texts(table)[0] == ["conceptgraphs", "-", "-", "0/8"]
    assert best(table)[2][:2] == [True, True]
    assert "not scored under this protocol: conceptfusion" in table.notes
    assert any(note.startswith("conceptgraphs: INCOMPLETE: failed on") for note in table.notes)
    with pytest.raises(ConfigError, match="scored none of conceptfusion"):
        protocol_table([unfit], Shown(), [])


def test_rows_of_different_scenes_are_not_compared() -> None:
    few = {scene: values for scene, values in measured().per_scene.items() if scene != SCENES[3]}
    table = protocol_table([measured(per_scene=few), measured("sam3d", 0.5)], Shown(), [])
    assert not any(map(any, best(table)))
    assert any("different scenes" in note for note in table.notes)


def test_the_caveat_of_the_perception_stands_beneath() -> None:
    table = protocol_table([measured(caveat="masks from the truth"), measured("sam3d", 0.5)], Shown(), [])
    assert "opensu3d: masks from the truth" in table.notes
    assert "all measured rows: perception embedded, encoder rooms-encoder" in table.notes


def test_the_best_is_marked_in_each_column_and_equal_ones_together() -> None:
    rows = [measured(), measured("sam3d", 0.4002), measured("conceptgraphs", 0.3)]
    assert best(protocol_table(rows, Shown(), [])) == [[True, True], [True, True], [False, False]]
    assert best(protocol_table([measured(), measured("sam3d", 0.5)], Shown(), [])) == [[False, False], [True, True]]
    assert best(protocol_table([measured()], Shown(), [])) == [[False, False]]


def test_a_method_that_knows_the_truth_competes_with_none() -> None:
    rows = [measured("oracle", 1.0), measured(), measured("sam3d", 0.3)]
    assert best(protocol_table(rows, Shown(), [])) == [[False, False], [True, True], [False, False]]


def test_only_a_significant_best_is_marked_on_request() -> None:
    clear = [measured(), measured("sam3d", 0.5)]
    table = protocol_table(clear, Shown(only_significant=True), [])
    assert best(table) == [[False, False], [True, True]]
    assert any("p cannot be below 0.0078" in note for note in table.notes)
    mixed = {
        scene: {"mAcc": 0.4 + (0.3 if k % 2 else -0.2), "F-mIoU": 0.3} for k, scene in enumerate(SCENES)
    }  # higher on the whole, but not in every scene
    unclear = [measured(), measured("sam3d", 0.45, per_scene=mixed)]
    assert best(protocol_table(unclear, Shown(only_significant=True), [])) == [[False, False], [False, True]]
    assert best(protocol_table(unclear, Shown(), [])) == [[False, False], [True, True]]


def test_three_scenes_can_make_nothing_significant_and_the_note_says_so() -> None:
    three = {scene: measured().per_scene[scene] for scene in SCENES[:3]}
    more = {scene: {"mAcc": 0.9, "F-mIoU": 0.9} for scene in SCENES[:3]}
    rows = [measured(per_scene=three, n_planned=3), measured("sam3d", 0.9, per_scene=more, n_planned=3)]
    table = protocol_table(rows, Shown(only_significant=True), [])
    assert not any(map(any, best(table)))
    assert any("p cannot be below 0.25" in note for note in table.notes)


def test_one_method_of_two_runs_is_told_apart_by_the_run() -> None:
    table = protocol_table([measured(), measured(run="runs/second", accuracy=0.5)], Shown(), [])
    assert [row.label for row in table.rows] == ["opensu3d (first)", "opensu3d (second)"]
    same = protocol_table([measured(run="a/x"), measured(run="b/x")], Shown(), [])
    assert [row.label for row in same.rows] == ["opensu3d (a/x)", "opensu3d (b/x)"]


def test_a_metric_may_be_chosen_and_an_undefined_one_is_a_dash() -> None:
    table = protocol_table([measured()], Shown(metrics=("mIoU", "mAcc")), [])
    assert texts(table) == [["opensu3d", "-", "40.0"]]
    assert table.rows[0].cells[0].origin is None
    with pytest.raises(ConfigError, match="has no metric 'mAc'; did you mean 'mAcc'"):
        protocol_table([measured()], Shown(metrics=("mAc",)), [])


def test_a_metric_that_one_row_alone_has_is_a_dash_in_the_others() -> None:
    """People judge label n' of the methods that have one."""
    without = measured("oracle", 0.3, metrics={"mAcc": 0.3})
    (table,) = selection_tables([measured(), without], Shown(), with_published=False)
    assert [cell.text for cell in table.rows[1].cells][:2] == ["30.0", "-"]


def test_the_papers_protocol_is_taken_where_it_is_there_and_others_say_that_they_are_not_it() -> None:
    own = measured(protocol="rooms-semantic")
    (table,) = paper_table("II", [own, measured()], Shown(), with_published=False)
    assert table.caption == "Semantic segmentation on replica, replica-conceptgraphs-ex6."
    (other,) = paper_table("II", [own], Shown(), with_published=False)
    assert other.caption == "Semantic segmentation on replica, rooms-semantic, not the paper's set-up."
    with pytest.raises(ConfigError, match="Table III: needs AP, AP50, AP25"):
        paper_table("III", [own], Shown(), with_published=False)


def test_every_protocol_of_a_selection_has_a_table_of_its_own() -> None:
    names = ("rooms-semantic", "replica-conceptgraphs-ex6")
    tables = selection_tables([measured(protocol=name) for name in names], Shown(), with_published=True)
    assert [table.name for table in tables] == list(names)
    assert [any(row.is_reported for row in table.rows) for table in tables] == [False, True]


def test_table_i_marks_the_best_of_each_parameter_and_shows_the_method_itself_in_each() -> None:
    sweep = [
        SweepRow("m", "1", "opensu3d@top_m=1"),
        SweepRow("m", "5", "opensu3d"),
        SweepRow("k", "3", "opensu3d"),
        SweepRow("k", "1", "opensu3d@crop_ratios=[1.0]"),
    ]
    values = {"opensu3d": 0.4, "opensu3d@top_m=1": 0.3, "opensu3d@crop_ratios=[1.0]": 0.45, "other": 0.9}
    found = [make(name, value) for name, value in values.items() for make in (measured, measured_instances)]
    table = ablation_table(found, sweep, Shown(), with_published=True)
    own = [row for row in table.rows if not row.is_reported]
    assert [row.label for row in own] == ["m = 1", "m = 5", "k = 3", "k = 1"]
    assert [cell.text for cell in own[1].cells] == ["40.0", "20.0", "40.0", "40.0", "40.0"]
    assert [row.cells[0].is_best for row in own] == [False, True, False, True]
    assert {row.label for row in table.rows if row.is_reported} >= {"m = 10", "ratios = 0.1,1,1.1"}
    assert latex([table]).count(r"\midrule") == 2 + 3
    with pytest.raises(ConfigError, match="Table I: no scores of gone"):
        ablation_table(found, [SweepRow("m", "1", "gone")], Shown(), with_published=False)
    with pytest.raises(ConfigError, match="Table I: needs AP, AP50, AP25"):
        ablation_table([measured()], sweep, Shown(), with_published=False)
