"""Tables for papers: which numbers stand in them, what is marked, what is said beside, in every format."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from painted import ColourPerception, colour_perception

from su3d_bench import scene_run
from su3d_bench.cli.main import main
from su3d_bench.errors import ConfigError
from su3d_bench.reports.ablation_table import SweepRow, ablation_table
from su3d_bench.reports.latex import escape, latex, origin_comment, printed_cells
from su3d_bench.reports.measured import Measured
from su3d_bench.reports.paper_tables import Shown, paper_table, protocol_table, selection_tables
from su3d_bench.reports.published import Figure
from su3d_bench.reports.table_formats import csv_text, html_page, markdown
from su3d_bench.reports.table_model import Cell, Origin, Table, TableRow
from su3d_bench.table_sources import check_paper, choose, measured_results

HERE = Path(__file__).parent
SCENES = tuple(f"replica/room{k}" for k in range(8))
HOSTILE = (
    "\\input{/etc/passwd}",
    "% run=x method=y",
    "a & b \\\\ c",
    "$x^2_3$ #1 ~{}",
    "=HYPERLINK(\"http://x\")",
    "<script>alert(1)</script>",
    "[2pt] *",
    "naïve \u0142 日本 \u202e",
    "line\nbreak\x1b[31m",
    "a | b -- ''q'' ?`",
)  # fmt: skip


def measured(method: str = "opensu3d", accuracy: float = 0.4, **more: Any) -> Measured:
    """Eight scenes under ConceptGraphs' rules, a little apart from each other."""
    per_scene: Mapping[str, Any] = {
        scene: {"mAcc": accuracy + 0.001 * k, "F-mIoU": accuracy / 2} for k, scene in enumerate(SCENES)
    }
    base = Measured(
        run="runs/first",
        method=method,
        protocol="replica-conceptgraphs-ex6",
        version=1,
        kind="semantic",
        headline=("mAcc", "F-mIoU"),
        metrics={"mAcc": accuracy, "F-mIoU": accuracy / 2, "mIoU": None},
        intervals={"mAcc": (accuracy - 0.05, accuracy + 0.05), "F-mIoU": None},
        per_scene=per_scene,
        ceilings={"mAcc": 0.98, "F-mIoU": 1.0},
        n_planned=8,
        failed=(),
        unscored=(),
        limit=0,
        profile="embedded",
        encoder="rooms-encoder",
        caveat=None,
    )
    return replace(base, **more)


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


def test_intervals_ceilings_and_scenes_are_shown_on_request() -> None:
    table = protocol_table([measured()], Shown(intervals=True, ceilings=True, scenes_count=True), [])
    assert table.columns == ("mAcc", "F-mIoU", "mAcc ceil.", "F-mIoU ceil.", "scenes")
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


def test_the_papers_protocol_is_taken_where_it_is_there_and_others_say_that_they_are_not_it() -> None:
    own = measured(protocol="rooms-semantic")
    (table,) = paper_table("II", [own, measured()], Shown(), with_published=False)
    assert table.caption == "Semantic segmentation under replica-conceptgraphs-ex6."
    (other,) = paper_table("II", [own], Shown(), with_published=False)
    assert other.caption == "Semantic segmentation under rooms-semantic, not the paper's set-up."
    with pytest.raises(ConfigError, match="Table III: needs AP, AP50, AP25"):
        paper_table("III", [own], Shown(), with_published=False)


def test_every_protocol_of_a_selection_has_a_table_of_its_own() -> None:
    names = ("rooms-semantic", "replica-conceptgraphs-ex6")
    tables = selection_tables([measured(protocol=name) for name in names], Shown(), with_published=True)
    assert [table.name for table in tables] == list(names)
    assert [any(row.is_reported for row in table.rows) for table in tables] == [False, True]


def ap(method: str, value: float) -> Measured:
    return measured(
        method,
        protocol="replica-openmask3d",
        kind="instance",
        headline=("AP", "AP50", "AP25"),
        metrics={"AP": value, "AP50": value, "AP25": value},
        intervals={},
        per_scene={scene: {"AP": value, "AP50": value, "AP25": value} for scene in SCENES},
    )


def test_table_i_marks_the_best_of_each_parameter_and_shows_the_method_itself_in_each() -> None:
    sweep = [
        SweepRow("m", "1", "opensu3d@top_m=1"),
        SweepRow("m", "5", "opensu3d"),
        SweepRow("k", "3", "opensu3d"),
        SweepRow("k", "1", "opensu3d@crop_ratios=[1.0]"),
    ]
    values = {"opensu3d": 0.4, "opensu3d@top_m=1": 0.3, "opensu3d@crop_ratios=[1.0]": 0.45, "other": 0.9}
    found = [make(name, value) for name, value in values.items() for make in (measured, ap)]
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


# Formats and what hostile texts may do to them


def hostile_table() -> Table:
    rows = [measured(name, 0.1 + 0.05 * k, caveat=name) for k, name in enumerate(HOSTILE)]
    figures = [
        Figure(method=name, dataset="d", setup=name, source=name, values={"mAcc": "1.0"}) for name in HOSTILE[:3]
    ]
    table = protocol_table(rows, Shown(intervals=True), figures)
    return replace(table, caption=" ".join(HOSTILE), head=HOSTILE[2], columns=(HOSTILE[4], HOSTILE[5]))


def test_no_text_can_be_a_latex_command() -> None:
    text = latex([hostile_table()])
    body = "\n".join(line.split("% run=")[0] if "value=" in line else line for line in text.splitlines()[1:])
    assert "\\input" not in body
    assert "\x1b" not in text
    assert text.isascii()
    allowed = {"begin", "end", "centering", "hbadness", "caption", "label", "small", "footnotesize", "scriptsize"}
    allowed |= {"setlength", "tabcolsep", "toprule", "midrule", "bottomrule", "multicolumn", "emph", "textbf", "par"}
    allowed |= {"textsuperscript", "smallskip", "linewidth", "raggedright", "textbackslash", "textasciitilde"}
    allowed |= {"textasciicircum", "textless", "textgreater", "textbar", "textasciigrave", "i"}
    assert set(re.findall(r"\\([A-Za-z]+)", body)) <= allowed
    assert not re.search(r"(?<!\\)[#$^~]", body)
    rows = [line for line in text.splitlines() if line.strip() == r"\\"]
    assert len(rows) == len(HOSTILE) + 3


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a_b%c", r"a\_b\%c"),
        ("--", "-{}-"),
        ("[x]*", "{[}x{]}{*}"),
        ("\\", r"\textbackslash{}"),
        ("é ß ł", r"\'{e} U+00DF U+0142"),
        ("ï", r"\"{\i}"),
        ("?`", r"?{}\textasciigrave{}"),
    ],
)
def test_letters_are_shown_as_they_are(text: str, shown: str) -> None:
    assert escape(text) == shown


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}


def test_no_text_can_be_html() -> None:
    page = _Page()
    page.feed(html_page([hostile_table()]))
    assert page.tags <= {
        "html", "meta", "title", "style", "section", "div", "table", "caption", "thead", "tbody", "tr", "th", "td",
        "strong", "ul", "li",
    }  # fmt: skip
    assert page.attributes <= {"lang", "charset", "name", "content", "class", "scope"}
    assert "<script" not in markdown([hostile_table()])


def test_no_text_can_be_a_formula_of_a_spreadsheet() -> None:
    table = Table("=1+1", "c", "h", ("+x",), (TableRow("@SUM(A1)", (Cell("-"), )), TableRow("\t=x", (Cell("=2"),))), ("-n",))  # fmt: skip  # noqa: E501
    for line in csv.reader(io.StringIO(csv_text([table]))):
        for value in line:
            assert value == "-" or not value.startswith(("=", "+", "-", "@", "\t", "\r"))
    assert "'@SUM(A1)" in csv_text([table])


def test_markdown_keeps_its_columns_whatever_the_names() -> None:
    lines = [line for line in markdown([hostile_table()]).splitlines() if line.startswith("|")]
    assert len({len(line) for line in lines}) == 1
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {4}


def test_csv_has_full_precision_and_every_note_once() -> None:
    table = protocol_table([measured(accuracy=1 / 3)], Shown(intervals=True), [])
    lines = list(csv.DictReader(io.StringIO(csv_text([table]))))
    assert float(lines[0]["value"]) == 1 / 3
    assert float(lines[0]["low"]) == 1 / 3 - 0.05
    assert [line["text"] for line in lines if line["kind"] == "note"] == list(table.notes)


def test_a_comment_reads_back_as_its_cell_whatever_the_names() -> None:
    for name in HOSTILE:
        origin = Origin(f"runs/{name}", name, "rooms-semantic", 3, "F-mIoU", "value", 1 / 3, (0.1, 0.2))
        line = f"      & \\textbf{{33.3}} {{[}}10.0, 20.0{{]}} {origin_comment(origin)}"
        assert "\n" not in line
        (cell,) = printed_cells(line)
        assert cell.origin == origin
        assert cell.numbers == ["33.3", "10.0", "20.0"]


def test_damaged_comments_are_found_as_cells_without_an_origin() -> None:
    for line in ("& 1.0 % run=a method=b", "& 1.0 % run=a method=b protocol=c version=1 metric=d what=value value=1e"):
        (cell,) = printed_cells(line)
        assert cell.origin is None


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed (texlive-latex-base, booktabs)")
def test_the_tables_compile_without_a_warning(tmp_path: Path) -> None:
    shown = Shown(intervals=True, ceilings=True, scenes_count=True)
    rows = [measured("opensu3d", 0.41), measured("conceptgraphs-detector", 0.387), measured("sam3d@a=[1.0,2.0]", 0.2)]
    instances = [ap("opensu3d", 0.41), ap("openmask3d-segment3d", 0.387)]
    tables = [
        *paper_table("II", rows, Shown(), with_published=True),
        *paper_table("II", rows, shown, with_published=True),
        *paper_table("III", instances, shown, with_published=True),
        ablation_table([*rows, *instances], [SweepRow("m", "5", "opensu3d")], Shown(), with_published=True),
        replace(hostile_table(), columns=("=f", "<b>")),
    ]
    tables = [replace(table, name=f"{table.name} {k}") for k, table in enumerate(tables)]
    (tmp_path / "tables.tex").write_text(latex(tables))
    (tmp_path / "paper.tex").write_text(
        "\\documentclass[10pt,twocolumn]{article}\n\\usepackage{booktabs}\n\\usepackage[margin=2cm]{geometry}\n"
        "\\begin{document}\n\\input{tables}\n\\end{document}\n"
    )
    for _ in range(2):
        done = subprocess.run(
            ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-no-shell-escape", "paper.tex"],
            cwd=tmp_path, capture_output=True, text=True, timeout=120, errors="replace",
        )  # fmt: skip
        assert done.returncode == 0, done.stdout[-2000:]
    faults = re.findall(r".*(?:Warning|Overfull|Underfull).*", done.stdout)
    assert not faults, faults


# From real runs, on the command line


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over four painted scenes with a method and two variants of it."""
    out = tmp_path_factory.mktemp("sweep") / "runs" / "a run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setattr(ColourPerception, "regions", lambda self: None, raising=False)
        patch.setenv("SU3D_DATA", str(out.parent / "data"))
        words = ["ablate", "--method", f"{HERE}/painted.py:Collector", "--vary", "noise_m=0.0,0.3", "drop=1"]
        words += ["--scenes", f"{HERE}/painted.py:Painted/*", "--protocols", "rooms-semantic", "rooms-instance"]
        assert main([*words, "--no-pictures", "--out", str(out), "--jobs", "1", "--quiet"]) == 0
    return out


def told(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["report", *words]) == 0
    return capsys.readouterr().out


def test_tables_of_a_run_hold_what_its_record_holds(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = json.loads(told(capsys, "tables", str(sweep), "--table", "II", "III", "--json"))
    record = json.loads((sweep / "metrics.json").read_text())
    expected = {
        (one["method"], name): one["result"]["metrics"][name] for one in record["results"] for name in one["headline"]
    }
    found = {
        (cell["origin"]["method"], cell["origin"]["metric"]): cell["origin"]["value"]
        for table in tables
        for row in table["rows"]
        for cell in row["cells"]
        if cell["origin"] is not None
    }
    assert found == expected


def test_verify_finds_every_cell_that_was_changed_by_hand(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(sweep.parent.parent)
    paper = tmp_path / "paper.tex"
    words = ["--table", "I", "II", "III", "--intervals", "--ceilings", "--scenes-count", "--format", "latex"]
    told(capsys, "tables", "runs/a run", *words, "--out", str(paper))
    assert re.search(r"^(\d+) cells checked, 0 differ$", told(capsys, "verify", str(paper)), re.MULTILINE)
    text = paper.read_text()
    changes: list[Callable[[str], str]] = [
        lambda t: t.replace("& 67.5 ", "& 67.6 ", 1),
        lambda t: re.sub(r"(& 67\.5 \{\[\})(\d\d\.\d)", r"\g<1>11.1", t, count=1),
        lambda t: t.replace("& 4 % run", "& 5 % run", 1),
        lambda t: t.replace("method=collector ", "method=colector ", 1),
        lambda t: t.replace("run=runs/a%20run", "run=runs/gone", 1),
        lambda t: t.replace("version=1", "version=2", 1),
        lambda t: t.replace("metric=mAcc", "metric=mAccuracy", 1),
        lambda t: t.replace("value=1.0", "value=1.x", 1),
        lambda t: t.replace("\\textbf{100.0}", "\\textbf{99.9}", 1),
        lambda t: t.replace("protocol=rooms-semantic", "protocol=replica-ovo51", 1),
    ]
    for change in changes:
        paper.write_text(change(text))
        assert paper.read_text() != text
        assert main(["report", "verify", str(paper)]) == 1
        out = capsys.readouterr().out
        assert ", 1 differ" in out, out
    paper.write_text(text)
    (paper.parent / "empty.tex").write_text("no table")
    assert main(["report", "verify", str(paper.parent / "empty.tex")]) == 2
    assert "no cell names its run" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    assert main(["report", "verify", str(paper)]) == 1
    capsys.readouterr()
    assert main(["report", "verify", str(paper), "--root", str(sweep.parent.parent)]) == 0


def test_numbers_come_from_the_counts_not_from_the_record(sweep: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(sweep, copy)
    record = json.loads((copy / "metrics.json").read_text())
    for one in record["results"]:
        one["result"]["metrics"] = dict.fromkeys(one["result"]["metrics"], 0.123)
    (copy / "metrics.json").write_text(json.dumps(record))
    found = measured_results([copy])
    paper = tmp_path / "paper.tex"
    paper.write_text(latex(selection_tables(found, Shown(), with_published=False)))
    assert sum(check.fault is not None for check in check_paper(paper)) == len(found) / 2 * 5


def test_runs_on_other_data_do_not_stand_in_one_table(sweep: Path, tmp_path: Path) -> None:
    copy = tmp_path / "other"
    shutil.copytree(sweep, copy)
    record = json.loads((copy / "run.json").read_text())
    record["data_digests"] = dict.fromkeys(record["data_digests"], "0" * 64)
    (copy / "run.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError, match="cannot be compared: data digest of painted/a"):
        measured_results([sweep, copy])
    assert len(measured_results([sweep, sweep])) == len(measured_results([sweep]))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--table", "IV"], "Table IV: is made of answers to text queries"),
        (["--table", "V"], "Table V: is made of labels and merges"),
        (["--methods", "colector"], "hold no scores of the method 'colector'; did you mean 'collector'?"),
        (["--protocols", "rooms"], "hold no scores of the protocol 'rooms'"),
        (["--metrics", "mAc"], "has no metric 'mAc'; did you mean 'mAcc'?"),
    ],
)
def test_what_a_run_cannot_tell_is_one_line(
    sweep: Path, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    assert main(["report", "tables", str(sweep), *words]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1


def test_a_run_that_is_no_sweep_makes_no_table_i(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(sweep, copy)
    (copy / "ablation.json").unlink()
    assert main(["report", "tables", str(copy), "--table", "I"]) == 2
    assert "make a sweep with su3d-bench ablate" in capsys.readouterr().err


def test_a_damaged_record_is_named(sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "run"
    shutil.copytree(sweep, copy)
    record = json.loads((copy / "metrics.json").read_text())
    record["results"][0]["result"]["per_scene"] = {"a": {"mAcc": "high"}}
    (copy / "metrics.json").write_text(json.dumps(record))
    assert main(["report", "tables", str(copy)]) == 2
    assert "metrics.json: results.0.result.per_scene.a.mAcc is not as a run writes it" in capsys.readouterr().err


def test_methods_and_protocols_stand_in_the_order_asked_for(sweep: Path) -> None:
    found = measured_results([sweep])
    names = list(dict.fromkeys(one.method for one in found))
    chosen = choose(found, names[::-1], ["rooms-instance"])
    assert [(one.method, one.protocol) for one in chosen] == [(name, "rooms-instance") for name in names[::-1]]
