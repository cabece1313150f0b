"""Tables for papers: built from runs on the command line and verified in LaTeX sources."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from painted import ColourPerception
from painted_runs import consistent, see_painted
from places import SCENES

from su3d_bench.analysis.tables import measured_results
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on four painted scenes with a method and two variants of it."""
    out = tmp_path_factory.mktemp("sweep") / "runs" / "a run"
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        patch.setattr(ColourPerception, "regions", lambda self: None, raising=False)
        patch.setenv("SU3D_DATA", str(out.parent / "data"))
        words = ["ablate", "--method", f"{SCENES}/painted.py:Collector", "--vary", "noise_m=0.0,0.3", "drop=1"]
        words += ["--scenes", f"{SCENES}/painted.py:Painted/*", "--protocols", "rooms-semantic", "rooms-instance"]
        assert main([*words, "--no-pictures", "--out", str(out), "--jobs", "1", "--quiet"]) == 0
    return out


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["report", *words]) == 0
    return capsys.readouterr().out


def test_tables_of_a_run_have_the_numbers_of_metrics_json(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = json.loads(answer(capsys, "tables", str(sweep), "--tables", "II", "III", "--json"))
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


def test_verify_finds_each_modified_cell(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(sweep.parent.parent)
    paper = tmp_path / "paper.tex"
    words = ["--format", "latex", "--intervals", "--ceiling", "--scenes-count", "--out", str(paper), "--tables"]
    answer(capsys, "tables", "runs/a run", *words, "I", "III")
    assert re.search(r"^(\d+) cells checked, 0 differ$", answer(capsys, "verify", str(paper)), re.MULTILINE)
    answer(capsys, "tables", "runs/a run", *words, "II")
    assert re.search(r"^(\d+) cells checked, 0 differ$", answer(capsys, "verify", str(paper)), re.MULTILINE)
    text = paper.read_text()
    changes: list[Callable[[str], str]] = [
        lambda t: re.sub(r"(& 67\.5 \{\[\})(\d\d\.\d)", r"\g<1>11.1", t, count=1),
        lambda t: t.replace("method=collector ", "method=colector ", 1),
        lambda t: t.replace("run=runs/a%20run", "run=runs/gone", 1),
        lambda t: re.sub(r"version=\d", "version=9", t, count=1),
        lambda t: t.replace("value=1.0", "value=1.x", 1),
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


def test_verify_checks_files_included_from_the_papers_folder(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paper, outside = tmp_path / "paper", tmp_path / "outside.tex"
    assert main(["report", "tables", str(sweep), "--format", "latex", "--out", str(paper / "tables" / "all.tex")]) == 0
    outside.write_text((paper / "tables" / "all.tex").read_text())
    names = ("tables/all", "tables/all.tex", "main", "../outside", "gone", "/", "é" * 200)
    (paper / "main.tex").write_text("% \\input{none}\n" + "\n".join(f"\\input{{{name}}}" for name in names))
    capsys.readouterr()
    assert main(["report", "verify", str(paper / "main.tex")]) == 0
    n_cells = (paper / "tables" / "all.tex").read_text().count("% run=")
    assert capsys.readouterr().out == f"{n_cells} cells checked, 0 differ\n"


def raise_metrics(run: Path) -> None:
    record = json.loads((run / "metrics.json").read_text())
    for one in record["results"]:
        one["result"]["metrics"] = dict.fromkeys(one["result"]["metrics"], 0.123)
    (run / "metrics.json").write_text(json.dumps(record))


def name_a_key_twice(run: Path) -> None:
    text = (run / "metrics.json").read_text()
    (run / "metrics.json").write_text(text.replace('"limit": 0', '"limit": 0, "limit": 0', 1))


JOB = "scenes/painted.a/collector"
EDITS: dict[str, tuple[Callable[[Path], object], str]] = {
    "numbers": (raise_metrics, "does not follow from the counts"),
    "a key twice": (name_a_key_twice, "metrics.json: has the key 'limit' twice"),
    "no counts": (lambda run: (run / JOB / "counts.npz").unlink(), "counts.npz is missing"),
    "faster": (lambda run: (run / JOB / "updates.csv").write_text("total_ms\n1\n"), "updates.csv is not the file"),
}


@pytest.mark.parametrize("verb", ["tables", "html", "timing", "instances", "bundle", "attribution --method collector"])
@pytest.mark.parametrize("edit", EDITS)
def test_reports_of_edited_runs_are_refused(
    edit: str, verb: str, sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(sweep, tmp_path / "run")
    change, message = EDITS[edit]
    change(tmp_path / "run")
    out = tmp_path / ("out.pdf" if "attribution" in verb else "out.zip")
    assert main(["report", *verb.split(), str(tmp_path / "run"), "--out", str(out)]) == 2
    assert message in capsys.readouterr().err and not out.exists()


def test_runs_on_different_data_are_not_combined(sweep: Path, tmp_path: Path) -> None:
    copy = tmp_path / "other"
    shutil.copytree(sweep, copy)
    record = json.loads((copy / "run.json").read_text())
    record["data_digests"] = dict.fromkeys(record["data_digests"], "0" * 64)
    (copy / "run.json").write_text(json.dumps(record))
    consistent(copy)
    with pytest.raises(ConfigError, match="cannot be compared: data digest of painted/a"):
        measured_results([sweep, copy])
    assert len(measured_results([sweep, sweep])) == len(measured_results([sweep]))
