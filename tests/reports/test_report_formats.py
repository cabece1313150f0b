"""Tables for papers: every format, and hostile texts in it."""

from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import markdown_it
import pytest
from measured_rows import measured, measured_instances

from su3d_bench.core.errors import printable
from su3d_bench.formats.tables.table import Cell, Origin, Prose, Table, TableRow
from su3d_bench.reports.tables.ablation import SweepRow, ablation_table
from su3d_bench.reports.tables.formats import csv_text, html_page, markdown
from su3d_bench.reports.tables.latex import latex, origin_comment, printed_cells
from su3d_bench.reports.tables.paper import Figure, Shown, paper_table, protocol_table

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


def hostile_table() -> Table:
    rows = [measured(name, 0.1 + 0.05 * k, caveat=name) for k, name in enumerate(HOSTILE)]
    figures = [
        Figure(method=name, dataset="d", setup=name, source=name, values={"mAcc": "1.0"}) for name in HOSTILE[:3]
    ]
    table = protocol_table(rows, Shown(intervals=True), figures)
    return replace(table, caption=" ".join(HOSTILE), head=HOSTILE[2], columns=(HOSTILE[4], HOSTILE[5]))


def test_hostile_text_is_never_a_latex_command() -> None:
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


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.words: list[str] = []

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}


def test_hostile_text_is_never_html() -> None:
    page = _Page()
    page.feed(html_page([hostile_table()]))
    assert page.tags <= {
        "html", "main", "h1", "meta", "title", "style", "section", "div", "table", "caption", "thead", "tbody", "tr",
        "th", "td", "span", "strong", "ul", "li",
    }  # fmt: skip
    known = {"lang", "charset", "name", "content", "class", "scope", "tabindex", "role", "aria-label"}
    assert page.attributes <= known
    assert "<script" not in markdown([hostile_table()])


MARKUP = (
    "[a](http://b)", "![a](http://b)", "[a][b] [a]: http://b", "<http://b>", "`code`", "*a* **b** _c_ __d__ ~~e~~",
    "# heading", "> quote", "- item", "+ item", "1. item", "1) item", "&lt;b&gt; &#60;", "a \\* b \\\\ c", "***",
    "a_b_c [1, 2]",
)  # fmt: skip


@pytest.mark.parametrize("text", [*MARKUP, *HOSTILE])
def test_markdown_shows_text_literally(text: str) -> None:
    page = _Page()
    parts: list[Table | Prose] = [
        Prose((text,)),
        Prose((text,), is_list=True),
        Table("t", text, text, (text,), (TableRow(text, (Cell(text),)),), (text,)),
    ]
    page.feed(markdown_it.MarkdownIt("commonmark").enable("table").render(markdown(parts)))
    assert page.tags <= {"p", "ul", "li", "table", "thead", "tbody", "tr", "th", "td"}
    assert [word for line in page.words if (word := line.strip())] == [printable(text)] * 8


def test_text_is_never_a_spreadsheet_formula() -> None:
    table = Table("=1+1", "c", "h", ("+x",), (TableRow("@SUM(A1)", (Cell("-"), )), TableRow("\t=x", (Cell("=2"),))), ("-n",))  # fmt: skip  # noqa: E501
    for line in csv.reader(io.StringIO(csv_text([table]))):
        for value in line:
            assert value == "-" or not value.startswith(("=", "+", "-", "@", "\t", "\r"))
    assert "'@SUM(A1)" in csv_text([table])


def test_csv_has_full_precision_and_each_note_once() -> None:
    table = protocol_table([measured(accuracy=1 / 3)], Shown(intervals=True), [])
    lines = list(csv.DictReader(io.StringIO(csv_text([table]))))
    assert float(lines[0]["value"]) == 1 / 3
    assert float(lines[0]["low"]) == 1 / 3 - 0.05
    assert [line["text"] for line in lines if line["kind"] == "note"] == list(table.notes)


def test_latex_comment_round_trips_with_hostile_names() -> None:
    for name in HOSTILE:
        origin = Origin(f"runs/{name}", name, "rooms-semantic", 3, "F-mIoU", "value", 1 / 3, (0.1, 0.2))
        line = f"      & \\textbf{{33.3}} {{[}}10.0, 20.0{{]}} {origin_comment(origin)}"
        assert "\n" not in line
        (cell,) = printed_cells(line)
        assert cell.origin == origin
        assert cell.numbers == ["33.3", "10.0", "20.0"]


def wide_and_high(n_rows: int) -> Table:
    """A table wider and higher than a page, with labels that must wrap."""
    columns = tuple(f"column {k}" for k in range(9))
    label = "opensu3d@crop_ratios=[0.8,1.0,1.2,1.4,1.6]: refined label (n'), ground truth"
    cells = tuple(Cell(f"{k}2.3", "[41.2, 61.8]") for k in range(9))
    rows = tuple(TableRow(f"{label} {k}", cells, group=str(k // 30)) for k in range(n_rows))
    return Table("wide", "A wide table.", "method, judge", columns, rows, ("a note of the table " * 12,))


def test_table_wider_than_a_page_is_split_without_loss() -> None:
    text = latex([wide_and_high(40)])
    assert text.count(r"\begin{table*}") == 3 and text.count(r"\begin{tabular}") > 1  # a page holds a third
    assert text.count("{[}41.2, 61.8{]}") == 40 * 9


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed (texlive-latex-base, booktabs)")
def test_latex_tables_compile_without_warnings(tmp_path: Path) -> None:
    shown = Shown(intervals=True, ceilings=True, scenes_count=True)
    rows = [measured("opensu3d", 0.41), measured("conceptgraphs-detector", 0.387), measured("sam3d@a=[1.0,2.0]", 0.2)]
    instances = [measured_instances("opensu3d", 0.41), measured_instances("openmask3d-segment3d", 0.387)]
    tables = [
        *paper_table("II", rows, Shown(), with_published=True),
        *paper_table("II", rows, shown, with_published=True),
        *paper_table("III", instances, shown, with_published=True),
        ablation_table([*rows, *instances], [SweepRow("m", "5", "opensu3d")], Shown(), with_published=True),
        replace(hostile_table(), columns=("=f", "<b>")),
        wide_and_high(6),
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
