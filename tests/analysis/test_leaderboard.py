"""Leaderboard of runs: what is ranked, and what is excluded with a reason."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from painted_runs import COLLECTOR, painted_run

import su3d_bench.analysis.leaderboard
from su3d_bench.analysis.leaderboard import leaderboard, ranked
from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file
from su3d_bench.metrics.scoring import pack_scores, unpack_scores


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    for name, method in (("ann/first", f"{COLLECTOR}@drop=1"), ("bob", COLLECTOR)):
        painted_run(folder / name, methods=(method,))
    return folder


@pytest.fixture
def runs(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "runs")
    return tmp_path / "runs"


def edit(path: Path, change: Callable[[Any], None]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def test_runs_with_the_same_protocol_and_data_are_ranked_by_the_first_headline(runs: Path) -> None:
    found = leaderboard(runs)
    assert [[one.run for one in board] for board in found.boards] == [["bob", "ann/first"]] * 2
    assert found.refused == ()
    values = [one.values[0] or 0.0 for one in found.boards[0]]
    assert values == sorted(values, reverse=True)


def test_rank_intervals_overlap_with_only_two_scenes(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert {one.ranks for board in leaderboard(runs).boards for one in board} == {None}
    found = leaderboard(runs, with_ranks=True)
    assert {one.ranks for board in found.boards for one in board} == {(1, 2)}
    assert main(["report", "leaderboard", str(runs), "--intervals"]) == 0
    text = capsys.readouterr().out
    assert "| rank " in text and "| 1 to 2 " in text
    assert "Intervals from fewer than 10 scenes are unreliable (here: 2)" in text


def test_ranks_come_from_scene_values_and_ceilings_have_none(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board = leaderboard(runs).boards[0]
    far = [replace(one, of_scenes=tuple((one.values[0] or 0) + k / 100 for k in range(8))) for one in board]
    answer = [replace(far[0], is_ceiling=True, method="oracle")]
    assert [one.ranks for one in ranked((*far, *answer))] == [(1, 1), (2, 2), None]
    monkeypatch.setattr(su3d_bench.analysis.leaderboard, "MAX_RANKED", 1)
    assert [one.ranks for one in ranked((*far, *answer))] == [None] * 3


REFUSED: dict[str, tuple[str, Callable[[Any], None], str]] = {
    "other rules": ("run.json", lambda r: r["protocols"][0].update(digest="f" * 64), "are not those that scored it"),
    "edited numbers": (
        "metrics.json",
        lambda m: m["results"][0]["result"]["metrics"].update(mAcc=0.123),
        "does not follow from the counts",
    ),
    "a partial run": ("run.json", lambda r: r.update(is_partial=True), "is_partial is True and False"),
    "no record": ("run.json", lambda r: r.clear(), "methods is empty"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_inconsistent_results_are_excluded_with_a_reason(name: str, runs: Path) -> None:
    file, change, reason = REFUSED[name]
    edit(runs / "bob" / file, change)
    found = leaderboard(runs)
    assert any(one.run == "bob" and reason in one.reason for one in found.refused), found.refused
    assert any([one.run for one in board] == ["ann/first"] for board in found.boards)


def worse_counts(runs: Path) -> None:
    """Negative counts in one scene of a run, which are impossible."""
    file = runs / "bob/scenes/painted.a/collector/counts.npz"
    scores = unpack_scores(file.read_bytes())
    scores["rooms-semantic"].counts.confusion[0, 0] -= 10**6  # type: ignore[attr-defined]
    file.write_bytes(pack_scores(scores))
    edit(file.with_name("done.json"), lambda d: d["steps"]["score"]["files"].update({file.name: digest_file(file)}))


def test_negative_counts_are_rejected_by_every_command(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paper = str(tmp_path / "paper.tex")
    assert main(["report", "tables", str(runs / "bob"), "--format", "latex", "--out", paper]) == 0
    assert main(["report", "verify", paper]) == 0
    worse_counts(runs)
    line = "counts: 'confusion' counts from -"
    capsys.readouterr()
    assert main(["compare", str(runs / "ann/first"), str(runs / "bob")]) == 2
    assert line in capsys.readouterr().err
    assert main(["report", "attribution", str(runs / "bob")]) == 2
    assert line in capsys.readouterr().err
    assert main(["report", "verify", paper]) == 1
    assert line in capsys.readouterr().out
    refused = leaderboard(runs).refused
    assert {one.run for one in refused} == {"bob"} and all(line in one.reason for one in refused)


def test_leaderboard_command_marks_the_best_and_lists_what_is_excluded(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(runs / "ann/first" / "run.json", lambda r: r["protocols"][0].update(version=7))
    assert main(["report", "leaderboard", str(runs), "--intervals"]) == 0
    shown = capsys.readouterr()
    assert "| collector " in shown.out and "**" in shown.out and "Excluded: ann/first" in shown.out
    assert "3 entries in 2 rankings, 1 excluded" in shown.err
    page = tmp_path / "board.html"
    assert main(["report", "leaderboard", str(runs), "--format", "html", "--out", str(page)]) == 0
    assert page.read_text().startswith("<!")
    assert main(["report", "leaderboard", str(runs), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["boards"]) == 2
