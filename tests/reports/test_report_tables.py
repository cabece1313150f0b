"""Tables for papers: numbers, marks of best values, and notes, in every format."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import pytest
from measured_rows import SCENES, measured, measured_instances

from su3d_bench.core.errors import ConfigError
from su3d_bench.formats.tables.table import Prose, Table
from su3d_bench.reports.tables.ablation import SweepRow, ablation_table
from su3d_bench.reports.tables.formats import csv_text, html_page, markdown
from su3d_bench.reports.tables.latex import latex
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.paper import Shown, paper_table, protocol_table
from su3d_bench.reports.tables.run import run_tables

SEMANTIC = "replica-openmask3d-semantic"


def texts(table: Table) -> list[list[str]]:
    return [[row.title, *(cell.whole for cell in row.cells)] for row in table.rows]


def best(table: Table) -> list[list[bool]]:
    return [[cell.is_best for cell in row.cells] for row in table.rows if not row.is_reported]


def test_published_rows_are_marked_in_every_format() -> None:
    (table,) = paper_table("II", [measured()], Shown(), with_published=True)
    assert texts(table)[0] == ["opensu3d", "40.0", "20.0"]
    assert texts(table)[-1] == ["opensu3d (as reported [e])", "42.6", "40.9"]
    assert [row.is_reported for row in table.rows] == [False] + [True] * 5
    assert all(cell.origin is None and not cell.is_best for row in table.rows[1:] for cell in row.cells)
    assert sum(note.startswith("[") and "OpenSU3D" in note for note in table.notes) == 5
    assert any("frames: every 5th (README at 5c4da70)" in note for note in table.notes)
    for text in (markdown([table]), html_page([table])):
        assert text.count("as reported [") == 5
    assert latex([table]).count("as reported, not measured here") == 1
    lines = list(csv.DictReader(io.StringIO(csv_text([table]))))
    assert {line["kind"] for line in lines if line["text"] in {"42.6", "40.9"}} == {"reported"}


def test_rows_of_different_scenes_are_not_compared() -> None:
    few = {scene: values for scene, values in measured().per_scene.items() if scene != SCENES[3]}
    table = protocol_table([measured(per_scene=few), measured("sam3d", 0.5)], Shown(), [])
    assert not any(map(any, best(table)))
    assert any("different scenes" in note for note in table.notes)


def test_best_value_per_column_is_marked_including_ties() -> None:
    rows = [measured(), measured("sam3d", 0.4002), measured("conceptgraphs", 0.3)]
    assert best(protocol_table(rows, Shown(), [])) == [[True, True], [True, True], [False, False]]
    assert best(protocol_table([measured(), measured("sam3d", 0.5)], Shown(), [])) == [[False, False], [True, True]]
    assert best(protocol_table([measured()], Shown(), [])) == [[False, False]]


def test_only_significant_best_values_are_marked_on_request() -> None:
    clear = [measured(), measured("sam3d", 0.5)]
    table = protocol_table(clear, Shown(only_significant=True), [])
    assert best(table) == [[False, False], [True, True]]
    assert any(
        "corrected by Holm for 2 metrics; with these scenes p cannot be below 0.016" in note for note in table.notes
    )
    mixed = {
        scene: {"mAcc": 0.4 + (0.3 if k % 2 else -0.2), "F-mIoU": 0.3} for k, scene in enumerate(SCENES)
    }  # higher overall, but not in every scene
    unclear = [measured(), measured("sam3d", 0.45, per_scene=mixed)]
    assert best(protocol_table(unclear, Shown(only_significant=True), [])) == [[False, False], [False, True]]
    assert best(protocol_table(unclear, Shown(), [])) == [[False, False], [True, True]]


def test_papers_protocol_is_preferred_and_other_setups_are_stated() -> None:
    own = measured(protocol="rooms-semantic")
    (table,) = paper_table("II", [own, measured()], Shown(), with_published=False)
    result = "Semantic segmentation on replica, replica-conceptgraphs-ex6"
    assert table.caption == f"{result}; not the paper's set-up: other perception."
    whole = measured(profile="paper", encoder="ViT-H-14/laion2b_s32b_b79k")
    assert paper_table("II", [whole], Shown(), with_published=False)[0].caption == f"{result}."
    others = [
        (measured(profile="paper", encoder="ViT-L-14-336/openai"), "encoder"),
        (measured(profile="paper", limit=20, encoder=whole.encoder), "frames"),
        (measured(profile="paper", changed=("stride = 10",), encoder=whole.encoder), "frames"),
        (measured(profile="paper", changed=("eps = 0.05",), encoder=whole.encoder), "settings"),
        (measured(profile="paper", encoder=whole.encoder, per_scene={"replica/kitchen0": {}}), "scenes"),
    ]
    for row, other_thing in others:
        assert paper_table("II", [row], Shown(), with_published=False)[0].caption.endswith(f": other {other_thing}.")
    lacking = measured(
        per_scene={}, metrics=dict.fromkeys(whole.metrics)
    )  # the files required by its protocol are missing
    (other,) = paper_table("II", [lacking, own], Shown(), with_published=False)
    assert [row.cells[0].text for row in other.rows] == ["40.0"]
    assert other.caption.endswith("rooms-semantic; not the paper's set-up: other protocol, perception.")
    with pytest.raises(ConfigError, match="Table III: needs AP, AP50, AP25"):
        paper_table("III", [own], Shown(), with_published=False)


SWEEP = [
    SweepRow("m", "1", "opensu3d@top_m=1"),
    SweepRow("m", "5", "opensu3d", is_default=True),
    SweepRow("k", "3", "opensu3d", is_default=True),
    SweepRow("k", "1", "opensu3d@crop_ratios=[1.0]"),
]


def swept(scenes: tuple[str, ...], **accuracy: float) -> list[Measured]:
    """The rows of ``SWEEP`` on some scenes, with the same difference from the default in every scene."""
    names = {"own": "opensu3d", "m1": "opensu3d@top_m=1", "k1": "opensu3d@crop_ratios=[1.0]"}
    rows = []
    for short, name in names.items():
        for make in (measured, measured_instances):
            row = make(name, accuracy[short])
            kept = {scene: row.per_scene[scene] for scene in scenes}
            rows.append(replace(row, per_scene=kept, n_planned=len(scenes)))
    return [replace(row, protocol=SEMANTIC) if row.kind == "semantic" else row for row in rows]


def test_table_i_compares_each_row_with_the_default_with_holms_correction() -> None:
    table = ablation_table(swept(SCENES, own=0.4, m1=0.3, k1=0.45), SWEEP, Shown(), with_published=True)
    own = [row for row in table.rows if not row.is_reported]
    assert [row.label for row in own] == ["m = 1", "m = 5", "k = 3", "k = 1"]
    assert [cell.text for cell in own[1].cells] == ["40.0", "20.0", "40.0", "40.0", "40.0"]
    # two other rows: Holm's correction doubles the smaller p of 2 / 2**8
    assert [row.cells[0].beside for row in own] == ["(-10.0, p 0.016)", "", "", "(+5.0, p 0.016)"]
    assert [row.cells[0].is_best for row in own] == [False, True, False, True]
    assert {row.label for row in table.rows if row.is_reported} >= {"m = 10", "ratios = 0.1,1,1.1"}
    assert latex([table]).count(r"\midrule") == 2 * (2 + 3)  # split in two halves because of the width
    assert any("Holm's correction over the 2 other rows" in note for note in table.notes)
    assert table.caption == (
        "Ablation of single parameters on replica, replica-openmask3d-semantic and replica-openmask3d; not the "
        "paper's set-up: other perception."
    )


def test_run_without_scores_has_one_list_instead_of_empty_tables() -> None:
    results = [{"protocol": name, "method": "m", "result": None, "failed": ["a/b"]} for name in ("x", "y")]
    (part,) = run_tables({"results": results})
    assert part == Prose(("m failed on a/b",), is_list=True)
