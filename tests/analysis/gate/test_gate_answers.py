"""What the gate says, in every form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from gated_runs import edit, lowered, results_in

from su3d_bench.analysis.gate.check import check
from su3d_bench.analysis.gate.reference import Reference
from su3d_bench.cli.main import main
from su3d_bench.reports.gate import Finding, Verdict, github_lines, junit_xml, markdown, plain_lines
from su3d_bench.runs.finished import read_run


def test_the_command_fails_with_one_and_writes_what_a_pull_request_needs(
    gated_copy: Path, gate_reference_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 0
    lowered("metrics", "mAcc")(gated_copy)
    capsys.readouterr()
    words = ["check", str(gated_copy), "--against", str(gate_reference_file), "--github"]
    assert main([*words, "--markdown", str(tmp_path / "c.md"), "--junit", str(tmp_path / "j.xml")]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("failed: 2 differences from") and "::error title=su3d-bench::" in shown
    assert "| FAIL | collector / rooms-semantic / mAcc |" in (tmp_path / "c.md").read_text()
    suite = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert suite.get("failures") == "2" and len(suite.findall("testcase/failure")) == 2
    assert main([*words, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["passed"] is False


HOSTILE = "<script>|`$(x)`\n::error::\x00" + "é" * 400


def test_a_hostile_name_does_no_harm() -> None:
    verdict = Verdict("run", (Finding("changed", HOSTILE, HOSTILE),), 1, (HOSTILE,))
    assert "<script>" not in markdown(verdict).replace("\\<script\\>", "")
    ElementTree.fromstring(junit_xml(verdict))
    lines = "\n".join(github_lines(verdict)).split("\n")
    assert len(lines) == 2 and all(line.startswith("::") and " title=su3d-bench::" in line for line in lines)


@pytest.mark.parametrize(
    "words", [[], ["a"], ["a", "b", "--against", "r"], ["--learn", "a"], ["a", "--against", "r", "--cost-limit", "2"]]
)
def test_a_request_that_is_neither_check_nor_learn_is_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", *words]) == 2
    assert capsys.readouterr().err.startswith("su3d-bench: check: ")


def test_a_check_that_passes_shows_each_number_beside_the_reference_s(
    gated_copy: Path, gate_reference_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("passed: ")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| collector")]
    values = {tuple(row[:2]): row[2:] for row in rows}
    shown = f"{100 * (results_in(read_run(gated_copy)).metrics['mAcc'] or 0):.1f}"
    assert values["collector / rooms-semantic", "mAcc"] == [shown, shown, "equal"]
    assert values["collector / cost", "all together"][2:] == ["1.3 times"]
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 60


def test_scenes_that_are_missing_come_first_and_what_follows_from_them_is_counted(
    gated_copy: Path, gate_reference: Reference
) -> None:
    (gone,) = list(gate_reference.data_digests)[:1]
    edit(gated_copy / "run.json", lambda r: r.update(scenes=[s for s in r["scenes"] if s != gone]))
    edit(gated_copy / "run.json", lambda r: r["data_digests"].pop(gone))

    def without(metrics: Any) -> None:
        metrics["scenes"].remove(gone)
        for result in metrics["results"]:
            result["n_planned"] -= 1
            result["result"]["scenes"].remove(gone)
            result["result"]["per_scene"].pop(gone)
            result["result"]["n_scenes"] -= 1
            for row in (result["result"]["metrics"], *result["result"]["per_class"].values()):
                row.update({name: 0.25 for name, value in row.items() if isinstance(value, float)})

    edit(gated_copy / "metrics.json", without)
    verdict = check(read_run(gated_copy), gate_reference)
    lines = plain_lines(verdict)
    n_explained = sum(one.is_explained for one in verdict.findings)
    assert f"{n_explained} of them because of other scenes" in lines[0] and n_explained > 20
    assert lines[1] == f"FAIL {gone}: the run does not have this scene"
    assert lines[-1] == (
        f"FAIL over other scenes: {n_explained} differences follow from scenes that the run or the reference alone has"
    )
    assert len(lines) < 12
