"""The list of methods with their facts, and the methods that ``all`` selects."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.config import Setting, Settings
from su3d_bench.reports.tables.paper import figures_of
from su3d_bench.runs.plan import make_plan

SYSTEMS = (
    *("opensu3d", "conceptfusion", "conceptfusion-sam", "conceptgraphs", "conceptgraphs-detector"),
    *("openmask3d", "openmask3d-segment3d", "sam3d"),
)


def result(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["methods", *words]) == 0
    return capsys.readouterr().out


def test_every_method_has_source_licence_needs_and_status(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = {row["name"]: row for row in json.loads(result(capsys, "list", "--json"))}
    assert tuple(rows)[: len(SYSTEMS)] == SYSTEMS
    for name in SYSTEMS:
        row = rows[name]
        assert all(row[field] for field in ("summary", "paper", "source", "licence", "needs", "status")), name
        assert "reproduces the paper" not in row["status"], name


def test_methods_show_lists_settings_and_published_results(capsys: pytest.CaptureFixture[str]) -> None:
    text = result(capsys, "show", "conceptgraphs-detector")
    assert "[method.conceptgraphs-detector]" in text
    assert "# mAcc 38.72, F-mIoU 35.82: ConceptGraphs (Gu et al.), Table II" in text
    assert "# published results; set-ups differ, so they may not be comparable" in text
    value = json.loads(result(capsys, "show", "conceptgraphs-detector", "--json"))
    assert len(value["published"]) == len(figures_of(method="conceptgraphs-detector"))
    assert value["settings"]


def test_shown_settings_are_a_valid_configuration_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from su3d_bench.core.config import read_file

    (tmp_path / "mine.toml").write_text(result(capsys, "show", "opensu3d"))
    assert read_file(tmp_path / "mine.toml").under(("method", "opensu3d"))


def test_all_selects_the_eight_methods_without_oracle_and_external_programs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))

    def methods(*names: str) -> tuple[str, ...]:
        entries = (Setting(("scenes",), ["rooms/living0"], "--scenes"), Setting(("methods",), list(names), "--methods"))
        return make_plan(Settings(entries), (), tmp_path / "run").methods

    assert methods("all") == SYSTEMS
    assert methods("all", "oracle", "sam3d") == (*SYSTEMS, "oracle")
