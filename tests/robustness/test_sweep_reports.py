"""Tables, figure and data sheet of eight methods under every corruption fit on a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.transforms import Bbox

from su3d_bench.analysis.sides import Numbers
from su3d_bench.corruptions.apply import CORRUPTIONS, Cell, parse_conditions
from su3d_bench.formats.tables.table import Table
from su3d_bench.reports.tables.formats import FORMATS
from su3d_bench.robustness import measures, pictures
from su3d_bench.robustness.measures import SweepResult
from su3d_bench.robustness.tables import sweep_tables, tolerance_tables
from su3d_bench.robustness.tolerance import Tolerance

METHODS = ("opensu3d", "conceptgraphs", "conceptfusion", "openmask3d", "hov-sg", "bbq", "open-fusion", "ovo-mapping")
SCENES = tuple(f"homes/test{k}" for k in range(8))
PAGE_LINES = 60  # of scriptsize type (8 pt on 9.5 pt) on a page of 9 in, with a caption


def numbers(of_scenes: np.ndarray) -> Numbers:
    without_each = [of_scenes.mean(), *((of_scenes.sum() - of_scenes) / (len(of_scenes) - 1))]
    return Numbers(float(of_scenes.mean()), of_scenes, np.array(without_each), None)


@pytest.fixture(scope="module")
def result() -> SweepResult:
    rng, methods = np.random.default_rng(0), []
    for k, method in enumerate(METHODS):
        clean = 0.1 + 0.05 * k + rng.normal(0, 0.02, len(SCENES))
        cells = [Cell(method, parse_conditions(f"{name}/{severity}")) for name in CORRUPTIONS for severity in (1, 3, 5)]
        found = {cell.name: numbers(clean * (1 - 0.15 * cell.conditions[0].severity)) for cell in cells}
        methods.append(measures._method_result(method, cells, {method: numbers(clean), **found}, SCENES))
    return SweepResult("homes-instance", "AP50", SCENES, METHODS[0], tuple(methods))


@pytest.fixture(scope="module")
def tolerances() -> list[Tolerance]:
    rng = np.random.default_rng(1)
    found = []
    for method in METHODS:
        for row in CORRUPTIONS.values():
            severity = float(rng.uniform(0.5, 4.5))
            ends = sorted((row.value_at(severity - 0.5), row.value_at(severity + 0.5)))
            found.append(Tolerance(method, row, severity, row.value_at(severity), (ends[0], ends[1]), False))
    return found


def lines_of_floats(text: str) -> list[int]:
    """The printed lines of each table of a LaTeX source, column titles with their line breaks."""

    def n_lines(line: str) -> int:
        titles = line.split("shortstack[r]")[1:]
        return line.endswith("\\\\") + max((title.partition("}")[0].count("\\\\") for title in titles), default=0)

    return [sum(map(n_lines, one.split("\n"))) for one in text.split("\\begin{table")[1:]]


def test_data_sheet_has_one_row_per_method_and_every_float_fits_on_a_page(tolerances: list[Tolerance]) -> None:
    tables = tolerance_tables(tolerances, "homes-instance", "AP50", 0.95, len(SCENES))
    columns = []
    for table in tables:
        assert isinstance(table, Table)
        assert tuple(row.label for row in table.rows) == METHODS
        columns += [f"{table.name.removeprefix('tolerance-')}/{name.partition(',')[0]}" for name in table.columns]
    assert columns == list(CORRUPTIONS)
    found = lines_of_floats(FORMATS["latex"](tables))
    assert len(found) == 8
    assert max(found) <= PAGE_LINES
    # on a page of a browser: a row of cells of 20 characters
    assert max(len(table.columns) for table in tables if isinstance(table, Table)) <= 10


def test_tables_of_a_sweep_fit_on_a_page(result: SweepResult) -> None:
    tables = sweep_tables(result, of_embedded=False)
    assert len(tables) == 1 + len(METHODS)
    assert max(lines_of_floats(FORMATS["latex"](tables))) <= PAGE_LINES


def test_pair_at_one_severity_is_in_the_column_of_that_severity() -> None:
    cells = [Cell("a", parse_conditions(text)) for text in ("depth/holes/3", "depth/holes/3+pose/jumps/3")]
    cells.append(Cell("a", parse_conditions("depth/holes/1+pose/jumps/3")))
    found = {cell.name: numbers(np.full(len(SCENES), 0.4)) for cell in cells}
    own = measures._method_result("a", cells, {"a": numbers(np.full(len(SCENES), 0.5)), **found}, SCENES)
    table = sweep_tables(SweepResult("homes-instance", "AP50", SCENES, "a", (own,)), of_embedded=False)[1]
    assert isinstance(table, Table)
    assert table.columns == ("unit", "severity 1+3", "severity 3")


def test_figure_fits_on_a_page_and_its_legend_covers_no_panel(
    result: SweepResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(pictures, "write_figure", lambda figure, path: drawn.append(figure))
    pictures.draw_sweep(result, tmp_path / "figure.png")
    (figure,) = drawn
    figure.draw_without_rendering()
    assert figure.get_figheight() <= 9
    assert len(figure.axes) == 8
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(METHODS)
    assert not any(Bbox.intersection(legend.get_window_extent(), one.get_window_extent()) for one in figure.axes)


def test_family_that_one_method_lacks_is_a_gap(result: SweepResult) -> None:
    first = result.methods[0]
    fewer = replace(first, families={name: one for name, one in first.families.items() if name != "depth"})
    table = sweep_tables(replace(result, methods=(fewer, *result.methods[1:])), of_embedded=False)[0]
    assert isinstance(table, Table)
    column = table.columns.index("depth")
    assert [row.cells[column].text == "-" for row in table.rows] == [True] + [False] * 7
